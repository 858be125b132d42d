"""Fit a filter: data module, callbacks and Lightning trainer from plain settings."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
from hydra.utils import instantiate
from lightning.pytorch.loggers import Logger

from dlkf.data.datamodule import DriveDataModule
from dlkf.errors import InputError
from dlkf.training.callbacks.checkpoints import BEST, LAST, BestWeights, ResumePoint
from dlkf.training.callbacks.progress import TrainingProgress
from dlkf.training.module import FilterTraining


def fit(config: Mapping[str, Any], data: DriveDataModule, folder: Path, logger: Logger | bool) -> Path:
    """Train, going on from ``folder/last.ckpt`` if it is there; returns the folder of the best weights.

    ``config`` has ``model``, ``loss``, ``optimizer``, ``scheduler``, ``trainer``, ``callbacks`` and ``seed``.
    Raises InputError where no epoch was validated.
    """
    settings = config["trainer"]
    module = FilterTraining(
        **{k: config[k] for k in ("model", "loss", "optimizer", "scheduler")}, seed=config["seed"]
    )
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="lightning")
        trainer = L.Trainer(
            max_epochs=settings["max_epochs"],
            accelerator=settings["accelerator"],
            devices=1,
            logger=logger,
            callbacks=[
                *(instantiate(c) for c in config["callbacks"].values() if c is not None),
                TrainingProgress(),
                BestWeights(str(folder), start_epoch=settings["best_from_epoch"]),
                ResumePoint(str(folder), settings["checkpoint_every"]),
            ],
            gradient_clip_val=settings["gradient_clip"],
            check_val_every_n_epoch=settings["validate_every"],
            num_sanity_val_steps=0,
            log_every_n_steps=1,
            reload_dataloaders_every_n_epochs=1,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=folder,
        )
        last = folder / LAST
        try:
            trainer.fit(module, datamodule=data, ckpt_path=str(last) if last.is_file() else None)
        except SystemExit as end:  # what Lightning makes of Ctrl-C and SIGTERM
            raise (end.__context__ if isinstance(end.__context__, KeyboardInterrupt) else end) from None
    if trainer.interrupted:
        raise KeyboardInterrupt
    loss = trainer.callback_metrics.get("train/loss")
    if not (folder / BEST).is_dir() and loss is not None and not bool(loss.isfinite()):
        raise InputError(f"the training diverged (its loss is {float(loss)}); give a smaller optimizer.lr")
    if not (folder / BEST).is_dir():
        raise InputError(
            f"no epoch was validated: trainer.max_epochs={settings['max_epochs']} ends before "
            f"trainer.best_from_epoch={settings['best_from_epoch']} and validate_every={settings['validate_every']}"
        )
    return folder / BEST
