"""Checkpoints: the last state for resuming, the best weights for use. Files appear whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning as L
from lightning.pytorch.callbacks import Callback, Checkpoint

from dlkf.base.errors import InputError
from dlkf.base.files import replace_file, replace_folder
from dlkf.filters.saved import save_filter

if TYPE_CHECKING:
    from dlkf.training.module import FilterTraining

LAST = "last.ckpt"
BEST = "best"


class ResumePoint(Checkpoint):
    """Writes ``last.ckpt`` at the end of every ``every`` epochs, beside and renamed: safe against kill -9."""

    def __init__(self, folder: str, every: int) -> None:
        self.folder, self.every = Path(folder), every

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Save after all other callbacks (Lightning runs checkpoints last)."""
        epoch = trainer.current_epoch + 1
        if epoch % self.every and epoch != trainer.max_epochs:
            return
        if not trainer.is_global_zero:
            trainer.save_checkpoint(self.folder / LAST)  # all processes take part, the first writes
            return
        with replace_file(self.folder / LAST) as beside:
            trainer.save_checkpoint(beside)


class BestWeights(Callback):
    """Keeps the weights of the epoch with the lowest ``monitor`` in ``best/`` (paper.md 4.14).

    A value that is not finite keeps nothing; InputError where the monitor is not among what was logged.
    """

    def __init__(self, folder: str, monitor: str, start_epoch: int, notes: Mapping[str, Any] | None) -> None:
        self.folder, self.monitor, self.start_epoch, self.notes = Path(folder), monitor, start_epoch, notes
        self.score, self.epoch = float("inf"), -1

    def on_validation_end(self, trainer: L.Trainer, module: FilterTraining) -> None:
        """Save when the validation improved."""
        if trainer.sanity_checking or trainer.current_epoch < self.start_epoch:
            return
        if self.monitor not in trainer.callback_metrics:
            known = ", ".join(sorted(k for k in trainer.callback_metrics if k.startswith("val/")))
            raise InputError(f"trainer.monitor={self.monitor} is not logged; choose one of {known}")
        score = float(trainer.callback_metrics[self.monitor])
        if score < self.score:
            self.score, self.epoch = score, trainer.current_epoch
            if not trainer.is_global_zero:
                return
            with replace_folder(self.folder / BEST) as beside:
                save_filter(module.filter, beside, self.notes)

    def state_dict(self) -> dict:
        """Best score so far."""
        return {"score": self.score, "epoch": self.epoch}

    def load_state_dict(self, state: dict) -> None:
        """Best score of a checkpoint."""
        self.score, self.epoch = state["score"], state["epoch"]
