"""Length curriculum: short sub-trajectories first (R071)."""

from __future__ import annotations

import lightning as L
from lightning.pytorch.callbacks import Callback

from dlkf.base.errors import InputError


class LengthCurriculum(Callback):
    """``warm_s`` seconds until epoch ``warm_until``, then linear growth to ``full_s`` at ``full_from``."""

    def __init__(self, warm_s: float = 20.0, full_s: float = 60.0, warm_until: int = 20, full_from: int = 40) -> None:
        if not (0 < warm_s <= full_s and 0 <= warm_until <= full_from):
            raise InputError(
                "callbacks.curriculum: need 0 < warm_s ≤ full_s and 0 ≤ warm_until ≤ full_from, got "
                f"{warm_s}, {full_s}, {warm_until}, {full_from}"
            )
        self.warm_s, self.full_s, self.warm_until, self.full_from = warm_s, full_s, warm_until, full_from

    def length_s(self, epoch: int) -> float:
        """Length of the sub-trajectories in an epoch [s], whole seconds."""
        if epoch >= self.full_from:
            return float(self.full_s)
        if epoch < self.warm_until:
            return float(self.warm_s)
        share = (epoch - self.warm_until) / (self.full_from - self.warm_until)
        return float(round(self.warm_s + share * (self.full_s - self.warm_s)))

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Log the length in force."""
        module.log("train/length_s", self.length_s(trainer.current_epoch))

    def setup(self, trainer: L.Trainer, module: L.LightningModule, stage: str) -> None:
        """Hand the law to the data module, which asks it when it cuts an epoch's segments."""
        if stage == "fit":
            trainer.datamodule.length_law = self.length_s  # pyright: ignore[reportAttributeAccessIssue]  set by fit
