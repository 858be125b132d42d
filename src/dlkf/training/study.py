"""A training study from data to scores: tune the baselines, train, run all filters over the test drives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from lightning.pytorch.loggers import Logger

import dlkf
from dlkf.base.documents import read_yaml
from dlkf.base.provenance import describe_provenance, repository_commit
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.kinds import drive_imus, drive_kinds
from dlkf.data.splits import SIDES
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.evaluation.endurance import (
    OutageErrors,
    after_tables,
    hour_table,
    scenes_after_gnss,
    score_after_gnss,
    score_without_outage,
)
from dlkf.evaluation.gains import measure_gains, write_gains
from dlkf.evaluation.metrics import PVA
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.results import BASELINE, Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.study import make_results, run_scenes
from dlkf.evaluation.summary import collect_metrics, describe_verdict, headline
from dlkf.evaluation.table import ResultTable, all_tables, as_markdown
from dlkf.filters.build import refuse_smoothed
from dlkf.filters.card import describe_seen_recordings
from dlkf.filters.integration import Estimator
from dlkf.filters.learned_kalman import LearnedKalmanConfig
from dlkf.filters.saved import load_filter, parse_learned_settings
from dlkf.filters.shipped import shipped_folder, trained_filter
from dlkf.report.evaluation import write_report
from dlkf.training.callbacks.history import read_losses
from dlkf.training.fit import fit, longest_segment_s
from dlkf.training.settings import FitSettings, ScoringSettings, StudySettings
from dlkf.tuning.baselines import Baselines, tune_baselines

Say = Callable[[str], None]
MODEL = "model.yaml"  # settings of the model of a training, in its folder


@dataclass(frozen=True)
class TrainingOutcome:
    """What a study leaves: the filter's name, scores, results per kind of data, the baselines, the best weights, times,
    further tables."""

    name: str  # of the trained filter in the tables
    scores: Scores
    results: list[Results]
    baselines: Baselines
    after: list[OutageErrors]
    hour: dict[str, dict[str, float]]
    weights: Path
    seconds: dict[str, float]
    tables: list[ResultTable]


def run_study(
    settings: StudySettings,
    data: DriveDataModule,
    folder: Path,
    logger: Logger | bool,
    say: Say,
    further: Sequence[str] | None,
) -> TrainingOutcome:
    """Tune, train, score and write the report into ``folder/report``; ``further`` as in :func:`fit`."""
    scoring, seconds = settings.scoring, {}
    learned, names, plan = settings.fit.model.kind, settings.baselines.models, scoring.outage
    for name in names:
        refuse_smoothed(name, "the filters of this table do not")
    set_threads(settings.fit)
    with _time(seconds, "tuning"):
        baselines = _baselines(settings, data, say)
    with _time(seconds, "training"):
        card = model_card(settings, data, getattr(logger, "run_id", None))
        model = settings.fit.model
        if isinstance(model, LearnedKalmanConfig):  # it has noise and prior of the filter that it is round
            model = model.with_base(baselines.imu, baselines.tunings[model.base], baselines.priors.get(model.base))
        (folder / MODEL).write_text(yaml.safe_dump(model.as_dict(), sort_keys=False))  # for further processes
        on_baseline, mean = replace(settings.fit, model=model), baselines.prior.mean
        weights = fit(on_baseline, data, folder, logger, mean_imu_error=mean, notes=card, further=further)
    with _time(seconds, "scoring"):
        shipped = {name: trained_filter(name) for name in names if shipped_folder(name)}
        filters = {**baselines.build(), **shipped, learned: load_filter(weights)}
        scenes = Scenes.of_split(data, "test", plan, scoring.seed)
        kinds = data.describe_drives(drive_kinds)
        baseline = BASELINE if BASELINE in filters else None
        groups = {d.name: d.group for d in data.stack}
        scores = run_scenes(filters, scenes, kinds=kinds, groups=groups, law=scoring.injected_bias, seed=scoring.seed)
        made = make_results(scores, settle_s=scoring.settle_s, seed=scoring.seed)
        title = ", ".join(Path(d).name for d in data.datasets)
        after, hour, tables = _endurance(filters, data, scoring, title, say)
        gains = measure_gains(filters, scenes, settle_s=scoring.settle_s) if scoring.gains else {}
    noise = None if data.gnss_noise is None else asdict(data.gnss_noise)
    write_report(
        folder / "report",
        title,
        scores,
        made,
        protocol={
            **describe_provenance(),
            **baselines.describe(),
            **scenes.describe(),
            "trained on": card,
            "gnss_noise": noise,
            "left out": list_left_out_drives(settings, data),
        },
        by_time=True,
        baseline=baseline,
        more=tables,
        figures=True,
        trained=learned,
        warnings=list_seen_recordings(settings, data),
        losses=read_losses(folder),
    )
    if gains:
        write_gains(folder / "report", gains, title)
    return TrainingOutcome(learned, scores, made, baselines, after, hour, weights, seconds, tables)


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


def train_with_baselines(settings: StudySettings, data: DriveDataModule, folder: Path) -> None:
    """The part of a further process of the same training: it writes, logs and scores nothing."""
    data.setup()
    set_threads(settings.fit)
    model = parse_learned_settings(read_yaml(folder / MODEL))
    fit(replace(settings.fit, model=model), data, folder, False)


def list_left_out_drives(settings: StudySettings, data: DriveDataModule) -> list[str]:
    """A line for every side on drives that are too short for its segments, at the full length of a curriculum."""
    return data.list_left_out(longest_segment_s(settings.fit, data))


def list_seen_recordings(settings: StudySettings, data: DriveDataModule) -> list[str]:
    """A line where recordings of the test were in training or validation too, as with ``data.split=random``."""
    train, val, test = ({d.group for d in data.drives(side)} for side in SIDES)
    remedy = "data.split=group holds whole recordings out"
    seen = len(test & (train | val))
    return [describe_seen_recordings(settings.fit.model.kind, seen, len(test), remedy)] if seen else []


def set_threads(settings: FitSettings) -> None:
    """CPU threads of this process, where they are set."""
    if settings.trainer.threads:
        torch.set_num_threads(settings.trainer.threads)


def _baselines(settings: StudySettings, data: DriveDataModule, say: Say) -> Baselines:
    """The classical filters, tuned on training segments for what is scored: ends of outages, after longer GNSS too
    where that is scored, or whole segments."""
    given, scoring = settings.baselines, settings.scoring
    segments = Scenes.of_split(data, "train", scoring.outage, scoring.seed, given.segments).withhold()
    for first_s in scoring.after_s:
        limit = given.segments and max(1, given.segments // len(scoring.after_s))
        if scenes := scenes_after_gnss(data, "train", first_s, scoring.seed, limit):
            segments += scenes.withhold()
    longer = Scenes.of_long_segments(data, "train", scoring.seed).withhold()
    classical = [name for name in given.models if not shipped_folder(name)]
    rounds = given.rounds if given.tune else 0
    objective = "log" if scoring.outage else PVA
    tuning = {"rounds": rounds, "start": given.tuning, "objective": objective, "longer": longer}
    return tune_baselines(classical, settings.imu, segments, **tuning, say=say)


def _endurance(
    filters: Mapping[str, Estimator], data: DriveDataModule, scoring: ScoringSettings, title: str, say: Say
) -> tuple[list[OutageErrors], dict[str, dict[str, float]], list[ResultTable]]:
    """Errors after longer GNSS, and over an hour without outage, where asked for."""
    known = {n: f for n, f in filters.items() if n != "ins"}
    after: list[OutageErrors] = []
    hour: dict[str, dict[str, float]] = {}
    tables: list[ResultTable] = []
    if scoring.after_s:
        after = score_after_gnss(known, data, scoring.after_s, baseline=BASELINE, seed=scoring.seed)
        if after:
            tables += after_tables(title, after, BASELINE)
        if left := sorted(set(map(float, scoring.after_s)) - {a.seconds for a in after}):
            say(f"no test drive has room for an outage after {', '.join(f'{s:g}' for s in left)} s of GNSS")
    if scoring.hour:
        drives = load_dataset(scoring.hour, rate_hz=data.rate_hz, epoch_s=data.epoch_s, dtype=torch.float64)
        hour = score_without_outage(known, drives, data.start, seed=scoring.seed)
        tables.append(hour_table(Path(scoring.hour).name, hour))
    return after, hour, tables


def model_card(settings: StudySettings, data: DriveDataModule, run: str | None) -> dict[str, Any]:
    """What a model was made of: recordings trained and chosen on, data digests, IMU, run, seeds, version, commit.

    ``imus`` are those that it was trained on, of a filter that overfits to them (paper.md 4.8; not ``plus``).
    """
    drives, called = data.drives("train"), data.describe_drives(drive_imus)
    overfitted = settings.fit.model.kind != "plus" and not settings.fit.finetune
    return {
        "trained_on": sorted({d.group for d in drives}),
        "chosen_on": sorted({d.group for d in data.drives("val")}),
        "datasets": {Path(d).name: dataset_digest(d) for d in data.datasets},
        "imu": settings.imu.name,
        "imus": sorted({called.get(d.name, settings.imu.name) for d in drives}) if overfitted else [],
        "run": run,
        "experiment": settings.name,
        "seed": settings.fit.seed,
        "max_epochs": settings.fit.trainer.max_epochs,
        "dlkf": dlkf.__version__,
        "commit": repository_commit(),
    }


@contextmanager
def _time(seconds: dict[str, float], what: str) -> Iterator[None]:
    clock = time.perf_counter()
    yield
    seconds[what] = time.perf_counter() - clock
