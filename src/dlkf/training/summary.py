"""A study in few numbers and few words, for the tracking server."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dlkf.evaluation.summary import collect_metrics, describe_verdict, headline
from dlkf.evaluation.table import all_tables, as_markdown
from dlkf.training.settings import StudySettings
from dlkf.training.study import TrainingOutcome


def key_metrics(outcome: TrainingOutcome) -> dict[str, float]:
    """``test/<filter>/…`` for the MLflow comparison, and times."""
    metrics = {f"time/{k}_s": v for k, v in outcome.seconds.items()} | collect_metrics(outcome.results)
    for a in outcome.after:
        for name, row in a.filters.items():
            metrics |= {f"test/{name}/after_{a.seconds:g}_s/{k}": v for k, v in row.items()}
        for name, c in a.ratios.items():
            bounds = {"": c.ratio, "_low": c.ratio_low, "_high": c.ratio_high}
            metrics |= {f"test/{name}/after_{a.seconds:g}_s/ratio{k}": v for k, v in bounds.items()}
    for name, row in outcome.hour.items():
        metrics |= {f"test/{name}/hour/{k}": v for k, v in row.items()}
    return {k: v for k, v in metrics.items() if math.isfinite(v)}


def note(settings: StudySettings, datasets: Sequence[str], outcome: TrainingOutcome) -> str:
    """The answer and the tables as a Markdown note of the run."""
    names = ", ".join(datasets)
    tables = "\n".join(as_markdown(t) for t in (*all_tables(names, outcome.results), *outcome.tables))
    said = [*(describe_verdict(result, outcome.name) for result in outcome.results), *map(headline, outcome.results)]
    headlines = "\n\n".join(f"**{line}**" for line in said if line)
    about = f"{settings.name}: {settings.fit.model.kind} on {names}, seed {settings.fit.seed}"
    return f"{headlines}\n\n{about}\n\n{tables}"
