"""An evaluation as a run in MLflow, a child where it is a point of a sweep."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig

from dlkf.evaluation.table import Table, as_markdown
from dlkf.tracking.grid import PARENT_RUN, run_name
from dlkf.tracking.runs import start_run


def log_evaluation(
    config: Mapping[str, Any], uri: str, name: str, digest: str, metrics: Mapping[str, float], tables: Sequence[Table]
) -> str:
    """Config, dataset, metrics and everything in ``config["out"]``; returns the id of the run."""
    parent = os.environ.get(PARENT_RUN)
    named = run_name(name, HydraConfig.get().overrides.task) if parent else name
    with start_run(uri, config["name"], named[:250], parent_run_id=parent) as run:
        run.log_config(config)
        run.log_dataset(config["dataset"], digest, "evaluation")
        run.log_metrics(metrics)
        run.log_files(config["out"])
        run.note("\n".join(as_markdown(t) for t in tables))
    return run.id
