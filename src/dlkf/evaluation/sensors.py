"""Further sensors in an evaluation: which filter used them, their innovations, their estimated parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dlkf.evaluation.metrics import Array
from dlkf.evaluation.results import last_finite
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.table import ResultTable

TITLE = "Further sensors"
COLUMNS = ["Filter", "Sensor", "Updates", "Used\n[%]", "Innovation\n/ σ", "Found, median over the runs"]


def sensor_table(scores: Scores, columns: Mapping[str, Sequence[str]]) -> ResultTable | None:
    """A row for each filter and sensor; None where no filter has one.

    ``columns`` are those of each filter's :attr:`FilterRun.aids` (:func:`dlkf.filters.aids.attach.aid_columns`).
    """
    rows = []
    for name, run in scores.filters.items():
        of = dict(zip(columns[name], np.moveaxis(run.aids, -1, 0)))
        for sensor in (column.removesuffix("_used") for column in of if column.endswith("_used")):
            ratio = of[f"{sensor}_innovation"] / of[f"{sensor}_innovation_std"]
            seen, used = np.isfinite(ratio), of[f"{sensor}_used"] > 0.5
            counted = seen & used
            spread = f"{np.sqrt(np.mean(ratio[counted] ** 2)):.2f}" if counted.any() else "–"
            share = f"{100 * counted.sum() / seen.sum():.1f}" if seen.any() else "–"
            prefix = "wheel_" if sensor == "speed" else f"{sensor}_"
            names = [n for n in of if n.startswith(prefix) and f"std_{n}" in of]
            found = [f"{n} {_last(of[n]):.4g} ± {_last(of[f'std_{n}']):.2g}" for n in names if np.isfinite(of[n]).any()]
            rows.append([name, sensor, str(int(seen.sum())), share, spread, ", ".join(found) or "–"])
    if not rows:
        return None
    note = "Innovation / σ: RMS over the updates that used the sensor, expected 1. Found: estimates at a run's end."
    return ResultTable(title=TITLE, note=note, columns=COLUMNS, rows=rows)


def _last(values: Array) -> float:
    """Median over the runs of the last known values of (P, T)."""
    return float(np.nanmedian(last_finite(values[..., None])))
