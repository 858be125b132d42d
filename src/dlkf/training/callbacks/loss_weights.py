"""Adaptive weights of the position, velocity and attitude losses (R065, R066; paper.md 2.8)."""

from __future__ import annotations

import lightning as L
from lightning.pytorch.callbacks import Callback

from dlkf.errors import InputError


class AdaptiveLossWeights(Callback):
    """w_p = 1, w_v = clip(L̄_p / L̄_v, 1, w_max), w_h likewise, from moving averages of past epochs.

    Velocity and attitude count more while the position loss is large and fall by themselves as the filter
    converges (R066). ``memory`` is the share that an epoch leaves of the old average.
    """

    def __init__(self, w_max: float = 10.0, memory: float = 0.8) -> None:
        if w_max < 1 or not 0 <= memory < 1:
            raise InputError(f"callbacks.loss_weights: w_max ≥ 1 and 0 ≤ memory < 1, got {w_max}, {memory}")
        self.w_max, self.memory = w_max, memory
        self.average: dict[str, float] = {}

    def update(self, losses: dict[str, float]) -> dict[str, float]:
        """Take in the unweighted losses of an epoch and return the weights for the next."""
        for term, value in losses.items():
            if value == value and value != float("inf"):
                old = self.average.get(term, value)
                self.average[term] = self.memory * old + (1 - self.memory) * value
        return self.weights()

    def weights(self) -> dict[str, float]:
        """Weights in force."""
        position = self.average.get("position")
        weights = {"position": 1.0}
        for term in ("velocity", "attitude"):
            loss = self.average.get(term)
            ratio = position / loss if position is not None and loss else 1.0
            weights[term] = min(max(ratio, 1.0), self.w_max)
        return weights

    def on_train_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Set and log the weights of this epoch."""
        module.loss_weights = self.weights()
        module.log_dict({f"train/{k}_weight": v for k, v in module.loss_weights.items()})

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Take in this epoch's losses."""
        seen = trainer.callback_metrics
        self.update({t: float(seen[f"train/{t}_loss"]) for t in ("position", "velocity", "attitude")})

    def state_dict(self) -> dict:
        """Moving averages."""
        return {"average": dict(self.average)}

    def load_state_dict(self, state: dict) -> None:
        """Moving averages of a checkpoint."""
        self.average = dict(state["average"])
