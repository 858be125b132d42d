"""Guard against non-finite and exploding steps (R077; paper.md 4.13)."""

from __future__ import annotations

import statistics

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from dlkf.errors import InputError


class StepGuard(Callback):
    """Skips a step whose gradient norm is non-finite or beyond ``factor`` times the running median.

    Skipped steps are counted and logged; ``limit`` skips in a row end the training with a clear error.
    """

    def __init__(self, factor: float = 100.0, window: int = 100, limit: int = 50) -> None:
        if factor <= 1 or window < 1 or limit < 1:
            raise InputError("callbacks.guard: need factor > 1, window ≥ 1, limit ≥ 1")
        self.factor, self.window, self.limit = factor, window, limit
        self.norms: list[float] = []
        self.skipped = 0
        self.in_a_row = 0

    def accepts(self, norm: float) -> bool:
        """Whether a step with this gradient norm may be taken; remembers what it saw."""
        finite = norm == norm and norm != float("inf")
        good = finite and (len(self.norms) < 10 or norm <= self.factor * statistics.median(self.norms))
        if good:
            self.norms = [*self.norms, norm][-self.window :]
            self.in_a_row = 0
        else:
            self.skipped += 1
            self.in_a_row += 1
        return good

    def on_before_optimizer_step(self, trainer: L.Trainer, module: L.LightningModule, optimizer) -> None:
        """Drop the gradients of a bad step, before clipping."""
        gradients = [p.grad for p in module.parameters() if p.grad is not None]
        norm = float(torch.nn.utils.get_total_norm(gradients)) if gradients else 0.0
        if not self.accepts(norm):
            optimizer.zero_grad(set_to_none=True)
        if self.in_a_row >= self.limit:
            raise InputError(
                f"training stopped: {self.in_a_row} steps in a row had non-finite or exploding gradients; "
                "lower optimizer.lr or check the data"
            )
        module.log("train/skipped_steps", float(self.skipped))

    def state_dict(self) -> dict:
        """Running norms and counts."""
        return {"norms": list(self.norms), "skipped": self.skipped, "in_a_row": self.in_a_row}

    def load_state_dict(self, state: dict) -> None:
        """Running norms and counts of a checkpoint."""
        self.norms, self.skipped, self.in_a_row = list(state["norms"]), state["skipped"], state["in_a_row"]
