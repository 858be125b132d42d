"""A grid search as MLflow shows it: one parent run, a child per point, a table that compares them.

Hydra callback, at work in multiruns only: ``python -m dlkf.train -m optimizer.lr=1e-3,1e-4 seed=0,1``.
"""

from __future__ import annotations

import atexit
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dlkf.config import SWEPT
from dlkf.errors import InputError
from dlkf.report.compare import read_reports, write_comparison
from dlkf.tracking.registry import check_registration, registered
from dlkf.tracking.runs import (
    NOTE_TAG,
    PARENT_TAG,
    client_of,
    experiment_id,
    reachable,
    tracking_uri,
)

PARENT_RUN = "DLKF_PARENT_RUN_ID"  # environment: read by the runs of the sweep, in any process
NAMELESS = ("tracking", "hydra", "resume", "name")  # settings that say nothing about the result
PRESETS = ("experiment", "profile")
VALIDATION = "val/outage_end_m"  # what training keeps the best weights by
COMPARED = ("outage_horizontal_rms_m", "position_rms_m")  # the first that the children have


class GridParent(Callback):
    """Opens the parent run before the sweep and closes it after, however the sweep ends."""

    def __init__(self) -> None:
        self.run_id: str | None = None
        self.register: str | None = None
        self.alias: str | None = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Make store, experiment and parent run; hand its id and the swept keys on by the environment."""
        swept = swept_overrides(config)
        os.environ[SWEPT] = json.dumps(list(swept))
        if not config.tracking.get("log", True):
            return
        self.register, self.alias = (config.tracking.get(key) for key in ("register", "alias"))
        try:
            check_registration(self.register, self.alias)
            self.uri = tracking_uri(config.tracking.uri)
            with reachable(self.uri):
                client = client_of(self.uri)
                name = "grid " + " × ".join(grid_name(key, values) for key, values in swept.items())
                run = client.create_run(experiment_id(client, config.name), run_name=name[:250])
        except InputError as error:  # Hydra would make a warning of it and go on
            print(f"dlkf: error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        self.run_id = run.info.run_id
        for key, values in swept.items():
            client.log_param(self.run_id, shown(key), values)
        os.environ[PARENT_RUN] = self.run_id
        atexit.register(self.close, ended=False)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """All points ran; evaluations that lie together under ``out`` get a page that compares them."""
        self.close(ended=True)
        os.environ.pop(SWEPT, None)
        out = OmegaConf.select(config, "out")
        folders = sorted(p.parent for p in Path(out).glob("*/metrics.json")) if out else []
        if len(folders) > 1:
            write_comparison(out, read_reports(folders))
            print(f"Compared: {out}/compare.html")

    def close(self, ended: bool) -> None:
        """Final status and comparison table. ``ended=False``: the sweep broke off; runs still open failed."""
        if self.run_id is None:
            return
        atexit.unregister(self.close)
        parent, self.run_id = self.run_id, None
        os.environ.pop(PARENT_RUN, None)
        os.environ.pop(SWEPT, None)
        client = client_of(self.uri)
        for run in children(client, parent):
            if run.info.status == "RUNNING":
                client.set_terminated(run.info.run_id, "FAILED")
        runs = children(client, parent)
        table = comparison(runs, [best_validation(client, r) for r in runs])
        if len(table):
            metric, chosen = compared(table)
            text = as_text(chosen)
            client.log_text(parent, table.to_csv(index=False), "comparison.csv")
            client.log_text(parent, text, "comparison.md")
            title = f"{metric} of the test pieces; runs by their validation" if metric else "no run was scored"
            client.set_tag(parent, NOTE_TAG, f"{title}\n\n{text}")
            print(f"\n{title}\n{text}\nGrid search: MLflow run {parent} in {self.uri}")
            self._show_best(client, parent, table, runs)
        client.set_terminated(parent, parent_status([r.info.status for r in runs], ended))
        if ended and (self.register or self.alias) and (best := best_child(client, runs)):
            name = self.register or client.get_experiment(best.info.experiment_id).name
            number = registered(client, best.info.run_id, name, self.alias)
            print(f"Registered the best, {best.info.run_name}: models:/{name}/{number}, alias {self.alias or 'none'}")

    def _show_best(self, client, parent: str, table: pd.DataFrame, runs: Sequence) -> None:
        """The parent carries the scores of the point that validated best."""
        from mlflow.entities import Metric

        if VALIDATION not in table:
            return
        best = runs[int(table[VALIDATION].astype(float).idxmin())]
        scores = {k: v for k, v in best.data.metrics.items() if k.startswith("test/")}
        now = best.info.end_time or best.info.start_time
        client.log_batch(parent, metrics=[Metric(k, v, now, 0) for k, v in scores.items()])
        client.set_tag(parent, "best_run", best.info.run_name)
        client.set_tag(parent, "best_run_id", best.info.run_id)


def parent_status(statuses: Sequence[str], ended: bool) -> str:
    """FINISHED if the sweep came to its end and all runs finished, KILLED if one was, else FAILED."""
    if "KILLED" in statuses:
        return "KILLED"
    return "FINISHED" if ended and statuses and set(statuses) == {"FINISHED"} else "FAILED"


def children(client, parent: str) -> list:
    """The runs under a parent, oldest first, in all experiments (a sweep may go over their names)."""
    experiments = [e.experiment_id for e in client.search_experiments()]
    mine = f"tags.`{PARENT_TAG}` = '{parent}'"
    return list(client.search_runs(experiments, mine, order_by=["attributes.start_time"], max_results=5000))


def best_validation(client, run) -> float | None:
    """The least validation error [m] of a run: that of its kept weights."""
    history = client.get_metric_history(run.info.run_id, VALIDATION)
    return min((m.value for m in history), default=None)


def best_child(client, runs: Sequence):
    """The finished run that validated best, None where none did."""
    validated = [(best_validation(client, r), r) for r in runs if r.info.status == "FINISHED"]
    known = [(value, run) for value, run in validated if value is not None]
    return min(known, key=lambda pair: pair[0])[1] if known else None


def best_of(client, run_id: str):
    """A run, or of a grid search's parent its best child; InputError where none of them was validated."""
    runs = children(client, run_id)
    if not runs:
        return client.get_run(run_id)
    if (best := best_child(client, runs)) is None:
        raise InputError(f"run={run_id}: no point of this grid search was validated")
    return best


def comparison(runs: Sequence, validated: Sequence[float | None]) -> pd.DataFrame:
    """A row per run: name, status, the parameters that differ between runs, validation, ``test/`` metrics."""
    given = pd.DataFrame([r.data.params for r in runs], dtype=object)
    names = [key for key in sorted(given) if given[key].nunique(dropna=False) > 1]
    names = [key for key in names if key.partition(".")[0] not in NAMELESS]
    metrics = sorted({key for r in runs for key in r.data.metrics if key.startswith("test/")})
    rows = []
    for run, value in zip(runs, validated):
        row = {"run": run.info.run_name, "run_id": run.info.run_id, "status": run.info.status}
        row |= {key: run.data.params.get(key) for key in names}
        if any(v is not None for v in validated):
            row[VALIDATION] = value
        rows.append(row | {key: run.data.metrics.get(key) for key in metrics})
    return pd.DataFrame(rows)


def compared(table: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    """The metric to compare by, and run, status, validation and its value for every filter.

    Sorted by validation: test drives choose nothing (R018). Without ``test/`` metrics (all runs failed) the
    name is empty.
    """
    first = [c for c in ("run", "status", VALIDATION) if c in table]
    ordered = table.sort_values(VALIDATION, na_position="last") if VALIDATION in table else table
    for metric in COMPARED:
        columns = [c for c in table if c.startswith("test/") and c.endswith(f"/{metric}")]
        if columns:
            break
    else:
        return "", ordered[first]
    names = {c: c.removeprefix("test/").removesuffix(f"/{metric}") for c in columns}
    trained = [c for c in columns if names[c].rpartition("/")[2].startswith("dlkf")]
    columns = trained + [c for c in columns if c not in trained]
    return metric, ordered[[*first, *columns]].rename(columns=names | {VALIDATION: "validation"})


def as_text(table: pd.DataFrame) -> str:
    """A Markdown table with aligned columns; metrics with three digits, an empty cell where there is none."""

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}" if value == value else ""
        return "" if value is None else str(value).replace("|", "\\|")

    rows = [list(table), *([cell(v) for v in row] for row in table.itertuples(index=False))]
    widths = [max(len(row[i]) for row in rows) for i in range(len(table.columns))]
    rows.insert(1, ["-" * w for w in widths])
    return "\n".join("| " + " | ".join(c.ljust(w) for c, w in zip(row, widths)) + " |" for row in rows) + "\n"


def swept_overrides(config: DictConfig) -> dict[str, str]:
    """``{key: values}`` of what the sweep goes over, from the command line and ``hydra.sweeper.params``."""
    given = OmegaConf.to_container(config.hydra.sweeper.get("params") or OmegaConf.create({}))
    lines = [f"{k}={v}" for k, v in given.items()] + list(config.hydra.overrides.task)
    overrides = OverridesParser.create().parse_overrides(lines)
    swept = [o for o in overrides if o.is_sweep_override()]
    return {o.get_key_element(): o.input_line.partition("=")[2] for o in swept}


def run_name(name: str, overrides: Sequence[str]) -> str:
    """What a run is called: in a grid its own point, else ``name`` with what was changed about it.

    ``outage`` and ``["+experiment=outage", "+profile=quick", "seed=1"]`` give ``outage quick seed=1``.
    """
    swept = json.loads(os.environ.get(SWEPT, "[]")) if os.environ.get(PARENT_RUN) else []
    if swept:
        words = [f"{shown(o)}" for o in overrides if o.partition("=")[0] in swept]
    else:
        words = [name]
        for override in overrides:
            key, _, value = shown(override).partition("=")
            if key.split(".")[0] in NAMELESS or (key == "experiment" and value == name):
                continue
            words.append(value if key in PRESETS else shown(override))
    return " ".join(words)[:250] or name


def grid_name(key: str, values: str) -> str:
    """A swept key and its values, short enough to be told apart in a list: ``lstm_hidden 8,64``."""
    return f"{shown(key).rpartition('.')[2]} {values if len(values) <= 24 else values[:23] + '…'}"


def shown(override: str) -> str:
    """An override as one reads it: ``filter@model=dlkf`` → ``model=dlkf``, without Hydra's plus signs."""
    key, equals, value = override.partition("=")
    return f"{key.lstrip('+~').rpartition('@')[2]}{equals}{value}"
