"""A training study from data to scores: tune the baselines, train, run all filters over the test drives."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger

from dlkf.console import counting
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Batch
from dlkf.data.kinds import drive_kinds
from dlkf.errors import InputError
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.report import write_report
from dlkf.evaluation.results import BASELINE, Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.study import study
from dlkf.filters.build import build_filter, refuse_smoothed
from dlkf.filters.integration import Estimator
from dlkf.filters.saved import load_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.training.fit import fit
from dlkf.tuning.search import FACTORS, factors_of, mean_imu_error, tuned, tuning_values

Say = Callable[[str], None]


@dataclass(frozen=True)
class Outcome:
    """What a study leaves: scores, results per kind of data, the baselines' settings, the best weights."""

    scores: Scores
    results: list[Results]
    tuning: dict[str, float]
    prior: dict[str, list[float]]
    weights: Path
    seconds: dict[str, float]


def load_data(config: Mapping[str, Any], say: Say) -> DriveDataModule:
    """The data module of ``config['data']``, loaded and split."""
    data: DriveDataModule = instantiate(config["data"])
    data.setup()
    say(data.describe())
    return data


def run_study(
    config: Mapping[str, Any], data: DriveDataModule, folder: Path, logger: Logger | bool, say: Say
) -> Outcome:
    """Tune, train, score and write the report into ``folder/report``."""
    for name in config["baselines"]["models"]:
        refuse_smoothed(name, "the filters of this table do not")
    spec, seconds = imu_spec(config["imu"]), {}
    if config["trainer"]["threads"]:
        torch.set_num_threads(config["trainer"]["threads"])
    plan = OutagePlan(**{"offsets_s": (0.0,), **config["scoring"]["outage"]})
    clock = time.perf_counter()
    tuning, own, prior = _baseline_knowledge(config, spec, data, plan, say)
    seconds["tuning"] = time.perf_counter() - clock
    clock = time.perf_counter()
    weights = fit(config, data, folder, logger)
    seconds["training"] = time.perf_counter() - clock
    clock = time.perf_counter()
    filters: dict[str, Estimator] = {}
    for name in config["baselines"]["models"]:
        given = {"prior_mean": prior["mean"], "prior_std": prior["std"]} if "_prior" in name else {}
        filters[name] = build_filter(name, spec, tuning=own.get(name, tuning), **given)
    learned = str(config["model"]["kind"])
    if learned in filters:
        raise InputError(f"baselines.models has {learned}, the name of the trained filter; take it out")
    filters[learned] = load_filter(weights)
    scenes = Scenes.of_split(data, "test", plan, config["scoring"]["seed"])
    kinds: dict[str, str] = {}
    for dataset in data.datasets:
        kinds |= drive_kinds(dataset)
    scores, made = study(
        filters,
        scenes,
        kinds=kinds,
        groups={d.name: d.group for d in data.stack},
        settle_s=config["scoring"]["settle_s"],
        injected_bias=config["scoring"]["slope"],
        seed=config["scoring"]["seed"],
    )
    seconds["scoring"] = time.perf_counter() - clock
    write_report(
        folder / "report",
        ", ".join(Path(d).name for d in data.datasets),
        scores,
        made,
        protocol={"imu": spec.name, "tuning": tuning, "own_tuning": own, "prior": prior, **scenes.described()},
        by_time=True,
        baseline=BASELINE if BASELINE in filters else None,
    )
    return Outcome(scores, made, tuning, prior, weights, seconds)


def _tuned(
    spec: ImuSpec, pieces: Sequence[Batch], name: str, rounds: int, start: Tuning | None = None
) -> tuple[Tuning, float]:
    """The search under a bar of its own: it takes minutes on much data."""
    most, done = rounds * sum(map(len, factors_of(name).values())), count(1)
    with counting(f"Tuning {name}") as progress:
        return tuned(spec, pieces, name=name, start=start, rounds=rounds, progress=lambda _: progress(next(done), most))


def _baseline_knowledge(
    config: Mapping[str, Any], spec: ImuSpec, data: DriveDataModule, plan: OutagePlan, say: Say
) -> tuple[dict[str, float], dict[str, dict[str, float]], dict[str, list[float]]]:
    """Over-bounding factors and mean IMU error, from training pieces alone.

    The factors are those of ``mbkf15``, which all filters share, and beside them by name those of filters that have
    more to tune, such as the noise of a constraint.
    """
    settings = config["baselines"]
    pieces = Scenes.of_split(data, "train", plan, config["scoring"]["seed"], settings["pieces"]).withheld()
    rounds = settings["rounds"] if settings["tune"] else 0
    best, rms = _tuned(spec, pieces, "mbkf15", rounds)
    how = "tuned" if settings["tune"] else "untuned"
    say(f"mbkf15 {how}: {rms:.2f} m RMS in the outages of training pieces")
    own = {}
    for name in settings["models"]:
        if set(factors_of(name)) > set(FACTORS) and "_prior" not in name:
            found, rms = _tuned(spec, pieces, name, rounds, best)
            own[name] = tuning_values(found)
            say(f"{name} {how}: {rms:.2f} m")
    mean, std = mean_imu_error(spec, best, pieces)
    return tuning_values(best), own, {"mean": list(mean), "std": list(std)}
