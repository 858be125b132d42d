"""A grid search as MLflow shows it: one parent run, a child per point, a table that compares them.

Hydra callback, at work in multiruns only: ``python -m dlkf.train -m optimizer.lr=1e-3,1e-4 seed=0,1``.
"""

from __future__ import annotations

import atexit
import json
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import pandas as pd
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from dlkf.base.errors import InputError
from dlkf.base.files import resolve_place
from dlkf.base.points import SWEPT, Failure, failures
from dlkf.base.processes import process_label
from dlkf.report.compare import read_reports, write_comparison
from dlkf.tracking.comparison import NAMELESS, as_text, best_child, children, compare_children, comparison
from dlkf.tracking.endings import PROCESS_TAG, close_killed_runs
from dlkf.tracking.registry import check_registration, register_model
from dlkf.tracking.runs import (
    NOTE_TAG,
    PARENT_TAG,
    TrackedRun,
    check_store,
    experiment_id,
    open_client,
    reachable,
    run_exists,
    start_run,
    tracking_uri,
)

PARENT_RUN = "DLKF_PARENT_RUN_ID"  # environment: read by the runs of the sweep, in any process
PRESETS = ("experiment", "profile")


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
            check_store(self.uri)
            with reachable(self.uri):
                client = open_client(self.uri)
                name = "grid " + (" × ".join(grid_name(*pair) for pair in swept.items()) or "of one point")
                close_killed_runs(client, group := experiment_id(client, config.name))
                run = client.create_run(group, run_name=name[:250], tags={PROCESS_TAG: process_label()})
        except InputError as error:  # Hydra would make a warning of it and go on
            print(f"dlkf: error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        self.run_id = run.info.run_id
        for key, values in swept.items():
            client.log_param(self.run_id, format_value(key), values)
        os.environ[PARENT_RUN] = self.run_id
        atexit.register(self.close, ended=False)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """All points ran; evaluations that lie together under ``out`` get a page that compares them."""
        self.close(ended=True)
        os.environ.pop(SWEPT, None)
        out = OmegaConf.select(config, "out")
        folders = sorted(p.parent for p in resolve_place(out).glob("*/metrics.json")) if out else []
        if len(folders) > 1:
            write_comparison(out, read_reports(folders))
            print(f"Compared: {out}/compare.html")

    def close(self, ended: bool) -> None:
        """Final status, comparison and champion. ``ended=False``: the sweep broke off; runs still open failed."""
        if self.run_id is None:
            return
        atexit.unregister(self.close)
        parent, self.run_id = self.run_id, None
        os.environ.pop(PARENT_RUN, None)
        os.environ.pop(SWEPT, None)
        client = open_client(self.uri)
        for run in children(client, parent):
            if run.info.status == "RUNNING":
                client.set_terminated(run.info.run_id, "FAILED")
        runs, failed = children(client, parent), failures()
        best = best_child(client, runs)
        table = comparison(client, runs)
        if len(table):
            self._compare(client, parent, table, failed)
        if best:
            self._show_best(client, parent, best)
        client.set_terminated(parent, parent_status([r.info.status for r in runs], ended and not failed))
        if ended and (self.register or self.alias):
            if best is None:
                print("Registered nothing: no point was validated")
                return
            name = self.register or client.get_experiment(best.info.experiment_id).name
            number = register_model(client, best.info.run_id, name, self.alias)
            print(f"Registered the best, {best.info.run_name}: models:/{name}/{number}, alias {self.alias or 'none'}")

    def _compare(self, client, parent: str, table: pd.DataFrame, failed: Sequence[Failure]) -> None:
        """The table of all points as text, CSV and note of the parent."""
        title, chosen = compare_children(table)
        text = as_text(chosen) + "".join(f"\nfailed: {f.point}: {f.why}\n" for f in failed)
        client.log_text(parent, table.to_csv(index=False), "comparison.csv")
        client.log_text(parent, text, "comparison.md")
        client.set_tag(parent, NOTE_TAG, f"{title}\n\n{text}")
        print(f"\n{title}\n{text}\nGrid search: MLflow run {parent} in {self.uri}")

    def _show_best(self, client, parent: str, best) -> None:
        """The parent carries the scores of the point that validated best."""
        from mlflow.entities import Metric

        scores = {k: v for k, v in best.data.metrics.items() if k.startswith("test/")}
        now = best.info.end_time or best.info.start_time
        client.log_batch(parent, metrics=[Metric(k, v, now, 0) for k, v in scores.items()])
        client.set_tag(parent, "best_run", best.info.run_name)
        client.set_tag(parent, "best_run_id", best.info.run_id)


def keep_point(uri: str, run_id: str) -> bool:
    """Put a finished run under the grid search that runs here if its own one failed or was killed; whether it did."""
    if (parent := os.environ.get(PARENT_RUN)) is None:
        return False
    with reachable(uri):
        client = open_client(uri)
        if not run_exists(client, run_id):
            return False
        run = client.get_run(run_id)
        before = run.data.tags.get(PARENT_TAG)
        if run.info.status != "FINISHED" or before is None or not run_exists(client, before):
            return False
        if client.get_run(before).info.status not in ("FAILED", "KILLED"):
            return False
        client.set_tag(run_id, PARENT_TAG, parent)
    return True


def parent_status(statuses: Sequence[str], ended: bool) -> str:
    """FINISHED if the sweep came to its end and all runs finished, KILLED if one was, else FAILED."""
    if "KILLED" in statuses:
        return "KILLED"
    return "FINISHED" if ended and statuses and set(statuses) == {"FINISHED"} else "FAILED"


def swept_overrides(config: DictConfig) -> dict[str, str]:
    """``{key: values}`` of what the sweep goes over, from the command line and ``hydra.sweeper.params``."""
    given: Any = OmegaConf.to_container(config.hydra.sweeper.get("params") or OmegaConf.create({}))
    lines = [f"{k}={v}" for k, v in given.items()] + list(config.hydra.overrides.task)
    overrides = OverridesParser.create().parse_overrides(lines)
    swept = [o for o in overrides if o.is_sweep_override()]
    return {o.get_key_element(): (o.input_line or "").partition("=")[2] for o in swept}


def run_name(name: str, overrides: Sequence[str]) -> str:
    """What a run is called: in a grid its own point, else what was changed about it, then its ``name`` and profile.

    ``outage`` and ``["+experiment=outage", "+profile=quick", "seed=1"]`` give ``seed=1 outage quick``: lists of runs
    cut names at their ends, and two runs differ by what was changed.
    """
    swept = json.loads(os.environ.get(SWEPT, "[]")) if os.environ.get(PARENT_RUN) else []
    if swept:
        words = points_words([o for o in overrides if o.partition("=")[0] in swept])
    else:
        pairs = [format_value(o).partition("=")[::2] for o in overrides]
        changed = [o for o, (key, _) in zip(overrides, pairs) if key.split(".")[0] not in (*NAMELESS, *PRESETS)]
        chosen = [value for key, value in pairs if key in PRESETS and (key, value) != ("experiment", name)]
        words = [*points_words(changed), name, *chosen]
    return " ".join(words)[:250] or name


def points_words(overrides: Sequence[str]) -> list[str]:
    """Short, for a list: ``optimizer.lr=1e-3`` → ``lr=1e-3``, unless two keys end alike; ``loss._target_=own.Huber`` →
    ``loss=Huber``."""
    pairs = [_strip_target(*format_value(o).partition("=")[::2]) for o in overrides]
    ends = [key.rpartition(".")[2] for key, _ in pairs]
    return [f"{end if ends.count(end) == 1 else key}={value}" for end, (key, value) in zip(ends, pairs)]


def _strip_target(key: str, value: str) -> tuple[str, str]:
    """``loss._target_``, ``my_loss.Huber`` → ``loss``, ``Huber``."""
    owner, dot, last = key.rpartition(".")
    return (owner, value.rpartition(".")[2]) if dot and last == "_target_" else (key, value)


def grid_name(key: str, values: str) -> str:
    """A swept key and its values, short enough for a list: ``lstm_hidden 8,64``."""
    return f"{format_value(key).rpartition('.')[2]} {values if len(values) <= 24 else values[:23] + '…'}"


def format_value(override: str) -> str:
    """An override as one reads it: ``filter@model=dlkf`` → ``model=dlkf``, without Hydra's plus signs."""
    key, equals, value = override.partition("=")
    return f"{key.lstrip('+~').rpartition('@')[2]}{equals}{value}"


def start_point(uri: str, experiment: str, name: str) -> AbstractContextManager[TrackedRun]:
    """A run of its own, or in a sweep one of the points."""
    parent = os.environ.get(PARENT_RUN)
    named = run_name(name, HydraConfig.get().overrides.task) if parent else name
    return start_run(uri, experiment, named[:250], parent_run_id=parent)
