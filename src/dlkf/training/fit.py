"""Fit a filter: Lightning's trainer with callbacks over a data module."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import DDPStrategy

from dlkf.base.errors import InputError
from dlkf.data.datamodule import DriveDataModule
from dlkf.filters.learned import LearnedFilter
from dlkf.filters.learned_kalman import LearnedKalmanFilter
from dlkf.filters.shipped import trained_filter
from dlkf.training.callbacks.checkpoints import BEST, LAST, BestWeights, ResumePoint
from dlkf.training.callbacks.curriculum import LengthCurriculum
from dlkf.training.callbacks.history import LossHistory
from dlkf.training.callbacks.masking import OutageInjection
from dlkf.training.callbacks.progress import TrainingProgress
from dlkf.training.module import FilterTraining
from dlkf.training.processes import is_worker, join, with_workers
from dlkf.training.settings import FitSettings

WARM_SEGMENTS = 60


def fit(
    settings: FitSettings,
    data: DriveDataModule,
    folder: Path,
    logger: Logger | bool,
    *,
    mean_imu_error: Sequence[float] | None = None,
    notes: Mapping[str, Any] | None = None,
    further: Sequence[str] | None = None,
) -> Path:
    """Train, going on from ``folder/last.ckpt`` if it is there; returns the folder of the best weights.

    With ``trainer.devices`` above 1 the command ``further`` is run for every further process; it calls this too.

    ``mean_imu_error`` (6) of the training segments is where a model with ``known_from=training`` starts; ``notes`` are
    stored beside the weights. Raises InputError where no epoch had a finite ``monitor``.
    """
    plan, best = settings.trainer, folder / BEST
    monitor = plan.monitor or ("val/loss" if data.eval_outage is None else "val/outage_end_m")
    module = FilterTraining(settings.model, settings.loss, settings.descent, settings.seed)
    last = folder / LAST
    if settings.finetune:
        module.filter = trained_filter(settings.finetune).train()
    elif isinstance(module.filter, LearnedFilter) and not last.is_file():
        warm_start(module.filter, data, mean_imu_error)
    _hush()
    with warnings.catch_warnings(), with_workers(further, plan.devices):
        warnings.filterwarnings("ignore", module="lightning")
        trainer = L.Trainer(
            max_epochs=plan.max_epochs,
            accelerator=plan.accelerator,
            devices=plan.devices,
            strategy="auto"
            if plan.devices == 1
            else DDPStrategy(find_unused_parameters=True, cluster_environment=LightningEnvironment()),
            logger=logger,
            callbacks=[
                *settings.callbacks,
                TrainingProgress(),
                LossHistory(str(folder)),
                BestWeights(str(folder), monitor, plan.best_from_epoch, notes),
                ResumePoint(str(folder), plan.checkpoint_every),
            ],
            gradient_clip_val=plan.gradient_clip,
            check_val_every_n_epoch=plan.validate_every,
            num_sanity_val_steps=0,
            log_every_n_steps=1,
            reload_dataloaders_every_n_epochs=1,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=folder,
        )
        join()
        try:
            trainer.fit(module, datamodule=data, ckpt_path=str(last) if last.is_file() else None)
        except SystemExit as end:  # what Lightning makes of Ctrl-C and SIGTERM
            raise (end.__context__ if isinstance(end.__context__, KeyboardInterrupt) else end) from None
    if trainer.interrupted:
        raise KeyboardInterrupt
    if is_worker() or best.is_dir():
        return best
    loss, score = (float(trainer.callback_metrics.get(name, math.nan)) for name in ("train/loss", monitor))
    what = f"no weights to keep: {monitor} is {score}" if math.isfinite(loss) else f"the loss is {loss}"
    raise InputError(f"{what}: the training diverged; give a smaller optimizer.lr")


def warm_start(model: LearnedFilter, data: DriveDataModule, mean_imu_error: Sequence[float] | None) -> None:
    """Start the IMU error at ``mean_imu_error`` (m/s² x 3, rad/s x 3) and learn the sizes of the features.

    Neither uses the truth. The mean is what the tuned 15-state filter estimates with GNSS, as ``mbkf15_prior`` is given
    to it; without it the cheapest descent moves the mean of everything inside the network, and what is learned is a
    constant (paper.md 4.11). Nothing happens to a model whose ``known_from`` is not ``training``. Round a Kalman filter
    the network's own error starts at zero: the filter has the mean, if it is one with ``_prior``.
    """
    if model.config.known_from != "training":
        return
    if mean_imu_error is not None and not isinstance(model, LearnedKalmanFilter):
        model.imu_error.start_at(mean_imu_error)
    batches, seen = [], 0
    for step in range(len(data.train_segments(0))):
        batches.append(data.train_batch(0, step))
        seen += batches[-1].size[0]
        if seen >= WARM_SEGMENTS:
            break
    was = model.training
    model.eval().learn_sizes(batches)
    model.train(was)


def longest_segment_s(settings: FitSettings, data: DriveDataModule) -> float:
    """Length of the training segments, at the end of a curriculum where there is one [s]."""
    grown = [c.full_s for c in settings.callbacks if isinstance(c, LengthCurriculum)]
    return max(grown, default=data.train_length_s)


def check_fit(settings: FitSettings, data: DriveDataModule) -> None:
    """What a training would come upon after the tuning, before any work is done for it.

    InputError for weights to begin with or a class that are not there, other settings than it takes, epochs of
    which none is validated, and outages longer than the segments; Lightning's error for an accelerator that is unknown
    or not there.
    """
    for callback in settings.callbacks:
        if isinstance(callback, OutageInjection):
            callback.check_fits(longest_segment_s(settings, data))
    plan = settings.trainer
    last = plan.max_epochs // plan.validate_every * plan.validate_every
    if last < 1 or last - 1 < plan.best_from_epoch:
        least = (plan.best_from_epoch // plan.validate_every + 1) * plan.validate_every
        raise InputError(
            f"no epoch would be validated with trainer.max_epochs={plan.max_epochs}, best_from_epoch="
            f"{plan.best_from_epoch} and validate_every={plan.validate_every}; trainer.max_epochs={least} is the least"
        )
    if settings.finetune:
        trained_filter(settings.finetune)
    FilterTraining(settings.model, settings.loss, settings.descent).configure_optimizers()
    _hush()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        L.Trainer(
            accelerator=plan.accelerator, devices=1, logger=False, enable_checkpointing=False,
            enable_progress_bar=False, enable_model_summary=False,
        )  # fmt: skip


def _hush() -> None:
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
