"""The runs of a grid search beside each other: what differs between them, which validated best, how all score."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from dlkf.base.errors import InputError
from dlkf.evaluation.table import format_number
from dlkf.tracking.runs import MONITORS, PARENT_TAG

NAMELESS = ("tracking", "hydra", "resume", "name", "out")  # settings that do not affect the result
COMPARED = {  # the first that the children have
    "outage_end_horizontal_m": "Horizontal error at the end of the outages, RMS [m]",
    "position_rms_m": "Position error, RMS [m]",
}


def children(client, parent: str) -> list:
    """The runs under a parent, oldest first, in all experiments (a sweep may go over their names)."""
    experiments = [e.experiment_id for e in client.search_experiments()]
    mine = f"tags.`{PARENT_TAG}` = '{parent}'"
    return list(client.search_runs(experiments, mine, order_by=["attributes.start_time"], max_results=5000))


def monitored_metric(runs: Sequence) -> str | None:
    """The metric by which the runs kept their best weights; None where nothing was validated."""
    chosen = [r.data.params.get("trainer.monitor", "null") for r in runs]
    known = [*(name for name in chosen if name != "null"), *MONITORS]
    return next((name for name in known if any(name in r.data.metrics for r in runs)), None)


def best_validation(client, run, monitor: str | None) -> float | None:
    """The least value of a run's monitor since the epoch from which weights are kept: that of its weights."""
    if monitor is None or monitor not in run.data.metrics:
        return None
    first = int(run.data.params.get("trainer.best_from_epoch", "0"))
    history = client.get_metric_history(run.info.run_id, monitor)
    return min((m.value for m in history if m.step >= first), default=None)


def best_child(client, runs: Sequence):
    """The finished run that validated best, None where none did."""
    monitor = monitored_metric(runs)
    validated = [(best_validation(client, r, monitor), r) for r in runs if r.info.status == "FINISHED"]
    known = [(value, run) for value, run in validated if value is not None]
    return min(known, key=lambda pair: pair[0])[1] if known else None


def choose_best(client, run_id: str):
    """A run, or of a grid search's parent its best child; InputError where none of them was validated."""
    runs = children(client, run_id)
    if not runs:
        return client.get_run(run_id)
    if (best := best_child(client, runs)) is None:
        raise InputError(f"run={run_id}: no point of this grid search was validated")
    return best


def comparison(client, runs: Sequence) -> pd.DataFrame:
    """A row per run: name, status, the parameters that differ between runs, validation, ``test/`` metrics."""
    given = pd.DataFrame([r.data.params for r in runs], dtype=object)
    names = [key for key in sorted(map(str, given)) if given[key].nunique(dropna=False) > 1]
    names = [key for key in names if key.partition(".")[0] not in NAMELESS]
    metrics = sorted({key for r in runs for key in r.data.metrics if key.startswith("test/")})
    monitor = monitored_metric(runs)
    rows = []
    for run in runs:
        row = {"run": run.info.run_name, "run_id": run.info.run_id, "status": run.info.status}
        row |= {key: run.data.params.get(key) for key in names}
        if monitor:
            row[monitor] = best_validation(client, run, monitor)
        rows.append(row | {key: run.data.metrics.get(key) for key in metrics})
    return pd.DataFrame(rows)


def compare_children(table: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    """The title, and run, status, validation and the metric that is compared for every filter.

    Sorted by validation, of trainings: test drives choose nothing (R018). Without ``test/`` metrics (all runs failed)
    the title says so.
    """
    monitor = next((c for c in map(str, table) if c.startswith("val/")), None)
    first = [c for c in ("run", "status", monitor) if c in table]
    ordered = table.sort_values(monitor, na_position="last") if monitor else table
    for metric in COMPARED:
        columns = [c for c in map(str, table) if c.startswith("test/") and c.endswith(f"/{metric}")]
        if columns:
            break
    else:
        return "No run was scored", ordered[first]
    names = {c: c.removeprefix("test/").removesuffix(f"/{metric}") for c in columns}
    trained = [c for c in columns if names[c].rpartition("/")[2].startswith("dlkf")]
    columns = trained + [c for c in columns if c not in trained]
    title = COMPARED[metric] + ("; test segments, runs by their validation" if monitor else "")
    return title, ordered[[*first, *columns]].rename(columns=names)


def as_text(table: pd.DataFrame) -> str:
    """A Markdown table with aligned columns; metrics with three digits, an empty cell where there is none."""
    rows = [list(table), *([_cell(v) for v in row] for row in table.itertuples(index=False))]
    widths = [max(len(row[i]) for row in rows) for i in range(len(table.columns))]
    rows.insert(1, ["-" * w for w in widths])
    return "\n".join("| " + " | ".join(c.ljust(w) for c, w in zip(row, widths)) + " |" for row in rows) + "\n"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return format_number(value) if value == value else ""
    return "" if value is None else str(value).replace("|", "\\|")
