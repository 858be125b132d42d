"""The LightningModule round the differentiable filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import lightning as L
import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import integrate
from dlkf.filters.saved import learned_filter
from dlkf.training.callbacks.masking import BatchCallback
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted


class FilterTraining(L.LightningModule):
    """Trains a learned filter (``model.kind``) end to end on reference position, velocity and attitude (R060–R062).

    ``model``, ``loss``, ``optimizer``, ``scheduler`` are plain mappings; ``loss_weights`` is set by the
    adaptive-weights callback. Randomness of a step depends on (seed, step) alone, so that a resumed run
    repeats an uninterrupted one.
    """

    def __init__(
        self,
        model: Mapping[str, Any],
        loss: Mapping[str, float],
        optimizer: Mapping[str, float],
        scheduler: Mapping[str, float],
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.save_hyperparameters()
        torch.manual_seed(seed)
        self.filter = learned_filter(model)
        self.loss_config = LossConfig(**loss)
        self.loss_weights = dict.fromkeys(TERMS, 1.0)
        self.seed = seed

    def configure_optimizers(self):
        """AdamW, heads at their own rate, cosine annealing with warm restarts (R073; paper.md 4.13)."""
        o, s = self.hparams["optimizer"], self.hparams["scheduler"]
        heads = list(self.filter.heads())
        body = [p for p in self.filter.parameters() if all(p is not h for h in heads)]
        groups = [{"params": body, "lr": o["lr"]}, {"params": heads, "lr": o["lr"] * o["head_lr_factor"]}]
        optimizer = torch.optim.AdamW(groups, weight_decay=o["weight_decay"])
        scheduler = torch.optim.lr_scheduler.CosineAnnealingWarmRestarts(
            optimizer, T_0=s["restart_epochs"], T_mult=s["restart_factor"], eta_min=s["lr_min"]
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "epoch"}}

    def training_step(self, batch: Batch, step: int) -> Tensor:
        """Masked filter run and weighted loss of one batch."""
        torch.manual_seed(hash((self.seed, self.global_step)) % 2**63)  # dropout
        generator = torch.Generator().manual_seed(hash((self.seed, self.current_epoch, step)) % 2**63)
        for callback in self.trainer.callbacks:
            if isinstance(callback, BatchCallback):
                batch = callback.transform(batch, self.current_epoch, generator)
        losses = pva_losses(integrate(batch, self.filter), batch, self.loss_config)
        total = weighted(losses, self.loss_weights)
        values = {f"train/{k}_loss": v.detach() for k, v in losses.items()}
        self.log_dict({"train/loss": total.detach(), **values}, on_step=False, on_epoch=True, batch_size=batch.size[0])
        return total

    def validation_step(self, batch: Batch, step: int) -> None:
        """RMS over fixed outages, as it will be scored on test drives."""
        solution = integrate(batch, self.filter)
        hidden = ~batch.available & batch.truth_valid & batch.present
        square = ((solution.posterior.p_n - batch.truth.p_n) ** 2).sum(-1)
        square = torch.where(hidden, square, torch.zeros_like(square))
        horizontal = ((solution.posterior.p_n - batch.truth.p_n)[..., :2] ** 2).sum(-1)
        horizontal = torch.where(hidden, horizontal, torch.zeros_like(horizontal))
        self._sums += torch.stack((square.sum(), horizontal.sum(), hidden.sum())).double().cpu()
        losses = pva_losses(solution, batch, self.loss_config)
        plain = weighted(losses, dict.fromkeys(TERMS, 1.0))
        self.log("val/loss", plain, on_epoch=True, batch_size=batch.size[0])

    def on_validation_epoch_start(self) -> None:
        """Reset the sums over the validation pieces."""
        self._sums = torch.zeros(3, dtype=torch.float64)

    def on_validation_epoch_end(self) -> None:
        """Log the outage RMS over all validation pieces."""
        full, horizontal, count = self._sums.tolist()
        self.log("val/outage_position_rms", (full / max(count, 1)) ** 0.5)
        self.log("val/outage_horizontal_rms", (horizontal / max(count, 1)) ** 0.5)
