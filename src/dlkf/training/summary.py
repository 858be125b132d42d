"""A study in few numbers and few words, for the tracking server."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dlkf.evaluation.report import all_tables
from dlkf.evaluation.summary import metrics_of
from dlkf.evaluation.table import as_markdown
from dlkf.training.study import Outcome


def key_metrics(outcome: Outcome) -> dict[str, float]:
    """``test/<filter>/…`` for the MLflow comparison: outage errors, RMS over the pieces, bias slopes, times."""
    return {f"time/{k}_s": v for k, v in outcome.seconds.items()} | metrics_of(outcome.results)


def note(config: Mapping[str, Any], outcome: Outcome) -> str:
    """The tables as a Markdown note of the run."""
    datasets = ", ".join(config["data"]["datasets"])
    tables = "\n".join(as_markdown(t) for t in all_tables(datasets, outcome.results))
    return f"{config['name']}: {config['model']['kind']} on {datasets}, seed {config['seed']}\n\n{tables}"
