"""Adaptive weights of the position, velocity and attitude losses (R065–R067; paper.md 2.8)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import lightning as L
from lightning.pytorch.callbacks import Callback

from dlkf.base.errors import InputError
from dlkf.training.loss import TERMS, unit_weights

if TYPE_CHECKING:
    from dlkf.training.module import FilterTraining


class AdaptiveLossWeights(Callback):
    """Weights of an epoch from the unweighted losses L̄ of those before, moving averages with ``memory``.

    The first ``pilot_epochs`` run unweighted and show what the losses of velocity and attitude, L₀ (R065, R066); from
    then on w_v = L̄_p / L₀_v and w_h = L̄_p / L₀_h, w_p = 1. They are large while the position loss is, and fall as the
    filter converges. Every weight stays within 1/``w_max`` … ``w_max``.
    """

    def __init__(self, pilot_epochs: int = 1, w_max: float = 10.0, memory: float = 0.8) -> None:
        if w_max < 1 or not 0 <= memory < 1 or pilot_epochs < 1:
            raise InputError(
                "callbacks.loss_weights: w_max ≥ 1, 0 ≤ memory < 1 and pilot_epochs ≥ 1, got "
                f"{w_max}, {memory}, {pilot_epochs}"
            )
        self.pilot_epochs, self.w_max, self.memory = pilot_epochs, w_max, memory
        self.average: dict[str, float] = {}
        self.pilot: dict[str, float] = {}
        self.epochs = 0

    def update(self, losses: dict[str, float]) -> dict[str, float]:
        """Take in the unweighted losses of an epoch and return the weights for the next."""
        for term, value in losses.items():
            if math.isfinite(value):
                old = self.average.get(term, value)
                self.average[term] = self.memory * old + (1 - self.memory) * value
        self.epochs += 1
        if self.epochs == self.pilot_epochs:
            self.pilot = dict(self.average)
        return self.weights()

    def weights(self) -> dict[str, float]:
        """Weights in force; 1 while the pilot lasts."""
        if not self.pilot:
            return unit_weights()
        position = self.average.get("position")
        others = {t: self._bound(position, self.pilot.get(t)) for t in TERMS if t != "position"}
        return {"position": 1.0} | others

    def _bound(self, above: float | None, below: float | None) -> float:
        ratio = above / below if above is not None and below else 1.0
        return min(max(ratio, 1 / self.w_max), self.w_max)

    def setup(self, trainer: L.Trainer, module: FilterTraining, stage: str) -> None:  # type: ignore[override]
        """Hand the rule to the module, which asks it at every step."""
        if stage == "fit":
            module.loss_weights = self.weights

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Log the weights of this epoch."""
        module.log_dict({f"train/{k}_weight": v for k, v in self.weights().items()})

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Take in this epoch's losses; a loss of one's own may leave some out."""
        seen = {t: trainer.callback_metrics.get(f"train/{t}_loss") for t in TERMS}
        self.update({t: float(value) for t, value in seen.items() if value is not None})

    def state_dict(self) -> dict:
        """Moving averages, and those of the pilot."""
        return {"average": dict(self.average), "pilot": dict(self.pilot), "epochs": self.epochs}

    def load_state_dict(self, state: dict) -> None:
        """Moving averages of a checkpoint."""
        self.average, self.pilot, self.epochs = dict(state["average"]), dict(state["pilot"]), state["epochs"]
