"""Settings of a training, typed: ``conf/train.yaml`` as dataclasses, and the study that they describe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lightning.pytorch.callbacks import Callback

from dlkf.base.classes import drop_spare, instantiate
from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
from dlkf.data.masks import BiasLaw
from dlkf.evaluation.outages import OutagePlan
from dlkf.filters.build import is_filter
from dlkf.filters.learned_kalman import LearnedKalmanConfig
from dlkf.filters.saved import LearnedSettings, parse_learned_settings
from dlkf.filters.shipped import shipped_folder
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.networks.own import NETWORK
from dlkf.networks.own import PAPER_FIELDS as NETWORK_FIELDS
from dlkf.training.loss import LOSS, Loss, build_loss
from dlkf.training.loss import PAPER_FIELDS as LOSS_FIELDS
from dlkf.training.optimization import MANY, OptimizationPlan

CALLBACK = ("setup", "on_train_epoch_start", "state_dict")  # of Lightning's methods those that every callback has


@dataclass(frozen=True)
class TrainerSettings(Ranged, where="trainer"):
    """Epochs, validation and checkpoints, explained in the comments of ``conf/train.yaml``."""

    max_epochs: int = bounded_field(500, 1, MANY)
    gradient_clip: float | None = bounded_field(1.0, 0, MANY)
    validate_every: int = bounded_field(5, 1, MANY)
    checkpoint_every: int = bounded_field(1, 1, MANY)
    monitor: str | None = None
    best_from_epoch: int = bounded_field(0, 0, MANY)
    threads: int | None = bounded_field(1, 1, MANY)
    accelerator: str = "auto"
    devices: int = bounded_field(1, 1, MANY)


@dataclass(frozen=True)
class TrackingSettings:
    """Where the run is kept, and under which name the model is registered."""

    uri: str | None
    register: str | None
    alias: str | None


@dataclass(frozen=True)
class BaselineSettings(Ranged, where="baselines"):
    """Which filters are scored beside, on how many training segments they are tuned, and from which factors on."""

    models: Sequence[str]
    tune: bool
    segments: int | None = bounded_field(60, 1, math.inf)
    rounds: int = bounded_field(2, 0, 1000)
    tuning: Tuning = field(default_factory=Tuning)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.models:
            if not (is_filter(name) or shipped_folder(name)):
                raise InputError(f"baselines.models: unknown filter {name!r}; a Kalman filter's name, ins or plus")


@dataclass(frozen=True)
class ScoringSettings(Ranged, where="scoring"):
    """The test: outages, rows after longer GNSS and over an hour, the bias that is injected."""

    seed: int
    outage: OutagePlan | None
    after_s: Sequence[float]
    hour: str | None
    gains: bool
    injected_bias: BiasLaw | None
    settle_s: float = bounded_field(10.0, 0, math.inf)


@dataclass(frozen=True)
class FitSettings:
    """What decides the weights, beside the data; ``finetune``: weights to begin with instead of ``model``."""

    model: LearnedSettings
    loss: Loss
    descent: OptimizationPlan
    trainer: TrainerSettings
    callbacks: Sequence[Callback]
    seed: int = 0
    finetune: str | None = None


@dataclass(frozen=True)
class StudySettings:
    """A study: fit, the baselines, the test."""

    name: str
    imu: ImuSpec
    fit: FitSettings
    baselines: BaselineSettings
    scoring: ScoringSettings


@dataclass(frozen=True)
class TrainSettings:
    """``conf/train.yaml``; a mapping stands where a class may be named."""

    name: str
    seed: int
    finetune: str | None
    resume: bool
    imu: Mapping[str, Any]
    data: Mapping[str, Any]
    model: Mapping[str, Any]
    loss: Mapping[str, Any]
    callbacks: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    scheduler: Mapping[str, Any]
    trainer: TrainerSettings
    baselines: BaselineSettings
    scoring: ScoringSettings
    tracking: TrackingSettings

    @property
    def fit(self) -> FitSettings:
        """What decides the weights; InputError for a class that is not there or takes other settings."""
        return FitSettings(
            model=parse_learned_settings(self.model),
            loss=build_loss(self.loss),
            descent=OptimizationPlan.of(self.optimizer, self.scheduler),
            trainer=self.trainer,
            callbacks=[
                instantiate(c, f"callbacks.{name}", CALLBACK) for name, c in self.callbacks.items() if c is not None
            ],
            seed=self.seed,
            finetune=self.finetune,
        )

    @property
    def study(self) -> StudySettings:
        """The whole study, as :attr:`fit`."""
        fit = self.fit
        if fit.model.kind in self.baselines.models:
            raise InputError(f"baselines.models has {fit.model.kind}, the name of the trained filter; take it out")
        baselines = self.baselines
        if isinstance(fit.model, LearnedKalmanConfig) and fit.model.base not in baselines.models:
            baselines = replace(baselines, models=[*baselines.models, fit.model.base])  # its noise is tuned with them
        return StudySettings(self.name, imu_spec(self.imu), fit, baselines, self.scoring)


def drop_unused(config: Mapping[str, Any]) -> dict[str, Any]:
    """``conf/train.yaml`` without what stands beside a network or loss of one's own and its class does not take."""
    model, loss = dict(config["model"]), drop_spare(config["loss"], "loss", LOSS, LOSS_FIELDS)
    if "network" in model:
        model["network"] = drop_spare(model["network"], "model.network", NETWORK, NETWORK_FIELDS)
    return {**config, "model": model, "loss": loss}
