"""Guard against non-finite and diverging steps (R077; paper.md 4.13)."""

from __future__ import annotations

import copy
import math
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from dlkf.base.errors import InputError

RISEN = 2.0  # an epoch whose mean loss is above the least by more than so many times its size did not end well


OF_GROUP = ("lr", "initial_lr", "max_lr", "min_lr")  # rates in a group of the parameters
OF_SCHEDULE = ("base_lrs", "max_lrs", "eta_min")  # rates in a schedule


class StepGuard(Callback):
    """Skips steps with a non-finite gradient; a large but finite one is harmless once its norm is clipped.

    After ``patience`` skips in a row the weights go back to those of the last epoch that ended well, finite and with a
    loss near the least, and the rate is multiplied by ``slower``; after ``returns`` such returns training ends with a
    clear error. A skip, a return and the gradient norm are logged.
    """

    def __init__(self, patience: int = 5, slower: float = 0.5, returns: int = 5) -> None:
        if patience < 1 or not 0 < slower <= 1 or returns < 0:
            raise InputError("callbacks.guard: need patience ≥ 1, 0 < slower ≤ 1, returns ≥ 0")
        self.patience, self.slower, self.returns = patience, slower, returns
        self.skipped = self.in_a_row = self.returned = 0
        self.good: dict[str, torch.Tensor] | None = None
        self.losses: list[torch.Tensor] = []  # of the epoch
        self.least = math.inf

    def on_before_optimizer_step(self, trainer: L.Trainer, module: L.LightningModule, optimizer) -> None:
        """Drop the gradients of a bad step, before clipping; go back where nothing else helps."""
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        norm = float(torch.nn.utils.get_total_norm(gradients)) if gradients else 0.0
        if math.isfinite(norm):
            self.in_a_row = 0
            module.log("train/gradient_norm", norm, on_step=False, on_epoch=True)
        else:
            optimizer.zero_grad(set_to_none=True)
            self.skipped += 1
            self.in_a_row += 1
            if self.in_a_row >= self.patience:
                self._go_back(trainer, module, optimizer)
        module.log("train/skipped_steps", float(self.skipped), on_step=False, on_epoch=True, reduce_fx="max")

    def _go_back(self, trainer: L.Trainer, module: L.LightningModule, optimizer) -> None:
        if self.good is None or self.returned >= self.returns:
            raise InputError(
                f"training stopped: {self.in_a_row} steps in a row had non-finite gradients"
                + (f", after {self.returned} returns to earlier weights" if self.returned else " in the first epoch")
                + "; lower optimizer.lr or check the data"
            )
        module.load_state_dict(self.good)
        self.returned, self.in_a_row = self.returned + 1, 0
        optimizer.state.clear()
        scale_rates(optimizer, self.slower)
        for config in trainer.lr_scheduler_configs:
            scale_schedule(config.scheduler, self.slower)

    def on_train_batch_end(self, trainer: L.Trainer, module: L.LightningModule, outputs, batch, step: int) -> None:
        """Remember the loss."""
        self.losses.append(outputs["loss"].detach())

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Keep weights that are finite and whose loss has not risen."""
        state = module.state_dict()
        loss = float(torch.stack(self.losses).mean()) if self.losses else 0.0
        self.losses = []
        self.least = min(self.least, loss) if math.isfinite(loss) else self.least
        finite = all(bool(x.isfinite().all()) for x in state.values())
        if self.in_a_row == 0 and loss <= self.least + RISEN * abs(self.least) and finite:
            self.good = copy.deepcopy(state)

    def state_dict(self) -> dict:
        """Counts and the least loss; the weights to go back to are those of the checkpoint itself."""
        return {
            "skipped": self.skipped, "in_a_row": self.in_a_row, "returned": self.returned, "least": self.least,
        }  # fmt: skip

    def load_state_dict(self, state: dict) -> None:
        """Those of a checkpoint."""
        self.skipped, self.in_a_row, self.returned = state["skipped"], state["in_a_row"], state["returned"]
        self.least = state["least"]

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """A run that goes on starts from good weights."""
        if trainer.current_epoch:
            self.good = copy.deepcopy(module.state_dict())


def scale_rates(optimizer: torch.optim.Optimizer, factor: float) -> None:
    """Multiply the rates of every group of an optimizer."""
    for group in optimizer.param_groups:
        group |= {name: factor * group[name] for name in OF_GROUP if name in group}


def scale_schedule(schedule: Any, factor: float) -> None:
    """Multiply the rates that a schedule comes back to, also those of one that is made of others."""
    for part in (schedule, *getattr(schedule, "_schedulers", ())):
        for name in OF_SCHEDULE:
            if rate := getattr(part, name, None):
                setattr(part, name, [factor * x for x in rate] if isinstance(rate, list) else factor * rate)
