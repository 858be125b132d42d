"""Further sensors in an evaluation: which filter used them, their innovations, their estimated parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dlkf.evaluation.metrics import Array
from dlkf.evaluation.results import last_finite
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.table import ResultTable
from dlkf.filters.aids.estimates import format_estimate, label_estimate
from dlkf.running.innovations import rms

TITLE = "Further sensors"
COLUMNS = ["Filter", "Sensor", "Updates", "Used\n[%]", "Innovation\n/ σ"]
NOTE = "Innovation / σ: RMS over the updates that used the sensor, expected 1."
FOUND = "Estimates ± 1σ: medians over the runs, at the end of each."


def sensor_table(scores: Scores, columns: Mapping[str, Sequence[str]]) -> ResultTable | None:
    """A row for each filter and sensor; None where no filter has one.

    ``columns`` are those of each filter's :attr:`FilterRun.aids` (:func:`dlkf.filters.aids.attach.aid_columns`).
    """
    rows: list[list[str]] = []
    found: list[dict[str, str]] = []
    for name, run in scores.filters.items():
        of = dict(zip(columns[name], np.moveaxis(run.aids, -1, 0)))
        for sensor in (column.removesuffix("_used") for column in of if column.endswith("_used")):
            ratio = of[f"{sensor}_innovation"] / of[f"{sensor}_innovation_std"]
            seen, used = np.isfinite(ratio), of[f"{sensor}_used"] > 0.5
            counted = seen & used
            spread = f"{rms(ratio[counted]):.2f}" if counted.any() else "–"
            share = f"{100 * counted.sum() / seen.sum():.1f}" if seen.any() else "–"
            prefix = "wheel_" if sensor == "speed" else f"{sensor}_"
            names = [n for n in of if n.startswith(prefix) and f"std_{n}" in of and np.isfinite(of[n]).any()]
            found.append({n: format_estimate(n, _last(of[n]), _last(of[f"std_{n}"])) for n in names})
            rows.append([name, sensor.replace("_", " "), str(int(seen.sum())), share, spread])
    if not rows:
        return None
    estimates = list(dict.fromkeys(n for row in found for n in row))
    return ResultTable(
        title=TITLE,
        note=f"{NOTE} {FOUND}" if estimates else NOTE,
        columns=[*COLUMNS, *map(label_estimate, estimates)],
        rows=[[*row, *(of_row.get(n, "–") for n in estimates)] for row, of_row in zip(rows, found)],
    )


def _last(values: Array) -> float:
    """Median over the runs of the last known values of (P, T)."""
    return float(np.nanmedian(last_finite(values[..., None])))
