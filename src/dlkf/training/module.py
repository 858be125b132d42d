"""The LightningModule round the differentiable filter."""

from __future__ import annotations

import time
from collections.abc import Callable

import lightning as L
import numpy as np
import torch
from torch import Tensor

from dlkf.data.aid_tables import standard_tables
from dlkf.data.draws import step_seed
from dlkf.data.drive import Batch
from dlkf.evaluation.metrics import end_errors, mean_error
from dlkf.filters.aids.attach import with_aids
from dlkf.filters.integration import BatchSolution, integrate
from dlkf.filters.saved import LearnedSettings, build_learned_filter
from dlkf.networks.heads import IMU_ERROR_SIZE, INNOVATION_SIZE, STATE_SIZE
from dlkf.training.loss import Loss, LossConfig, unit_weights, weighted_loss
from dlkf.training.optimization import OptimizationPlan
from dlkf.training.processes import gather_all

STATE, INNOVATION = torch.tensor(STATE_SIZE), torch.tensor(INNOVATION_SIZE)


class FilterTraining(L.LightningModule):
    """Trains a learned filter (``model.kind``) end to end on reference position, velocity and attitude (R060–R062).

    A callback hands its rule over in ``setup``: changes of the batch to ``transforms``, weights of the losses to
    ``loss_weights``, lengths of the segments to the data module's ``length_law``. Randomness of a step depends on
    (seed, step) alone, so that a resumed run repeats an uninterrupted one.
    """

    def __init__(
        self,
        model: LearnedSettings,
        loss: Loss,
        descent: OptimizationPlan,
        seed: int = 0,
    ) -> None:
        super().__init__()
        torch.manual_seed(seed)
        self.filter = build_learned_filter(model)
        self.loss = loss
        self.factors = loss.factors if isinstance(loss, LossConfig) else {}
        self.descent = descent
        self.covariances = getattr(loss, "likelihood", 0.0) > 0
        self.loss_weights: Callable[[], dict[str, float]] = unit_weights
        self.transforms: list[Callable[[Batch, int, torch.Generator], Batch]] = []
        self.seed = seed

    def configure_optimizers(self):
        """Those of the settings, a step of the schedule an epoch."""
        heads = list(self.filter.heads())
        body = [p for p in self.filter.parameters() if all(p is not h for h in heads)]
        optimizer, scheduler = self.descent.build(body, heads)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "epoch"}}

    def training_step(self, batch: Batch, step: int) -> Tensor:
        """Masked filter run and weighted loss of one batch, or of this process's segments of it."""
        rank, processes = self.trainer.global_rank, self.trainer.world_size
        generator = torch.Generator().manual_seed(step_seed(self.seed, self.current_epoch, step))
        for transform in self.transforms:
            batch = transform(batch, self.current_epoch, generator)
        segments = batch.size[0]
        if processes > 1:
            batch = batch.select(torch.arange(rank, segments, processes))
        batch = batch.to(self.device)
        torch.manual_seed(step_seed(self.seed, self.global_step, *([rank] if rank else ())))  # dropout
        losses = self.loss(self._run(batch), batch)
        total = weighted_loss(losses, self.loss_weights(), self.factors)
        values = {f"train/{k}_loss": v.detach() for k, v in losses.items()}
        values["train/loss"] = total.detach()
        self.log_dict(values, on_step=False, on_epoch=True, batch_size=segments, sync_dist=processes > 1)
        return total

    def on_train_epoch_start(self) -> None:
        """Rate and clock of the epoch."""
        self._began = time.perf_counter()
        self.log("train/learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_epoch_end(self) -> None:
        """How long the epoch took."""
        self.log("time/epoch_s", time.perf_counter() - self._began)

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """As it is: a step moves it, after what is drawn on the CPU."""
        return batch

    def _run(self, batch: Batch) -> BatchSolution:
        there = [name for name, rows in batch.aids.items() if bool((rows[..., -1] > 0).any())]
        return integrate(batch, with_aids(self.filter, standard_tables(there)), keep_covariances=self.covariances)

    def validation_step(self, batch: Batch, step: int) -> None:
        """Errors at the ends of fixed outages, as they will be scored on test drives, and what the filter answers."""
        batch = batch.to(self.device)
        solution = self._run(batch)
        self._ends.append(end_errors(batch, solution.posterior))
        used = solution.used.any(-1)
        self._errors.append(solution.imu_error[:, -1].double().cpu())
        if solution.gain is not None and bool(used.any()):
            last = solution.used.long().cumsum(1).argmax(1)
            self._gains.append(solution.gain[torch.arange(len(last), device=last.device), last][used].double().cpu())
        losses = self.loss(solution, batch)
        plain = weighted_loss(losses, self.factors)
        shared = self.trainer.world_size > 1
        self.log("val/loss", plain, on_epoch=True, batch_size=batch.size[0], sync_dist=shared)

    def on_validation_epoch_start(self) -> None:
        """Collect over the validation segments."""
        self._ends, self._gains, self._errors = [], [], []

    def on_validation_epoch_end(self) -> None:
        """Outage errors over all validation segments, and the spread over segments of the last gain and IMU error.

        ``val/gain_std`` and ``val/imu_error_std`` are relative to the heads' physical sizes: near zero they show that
        the network is a constant, for any errors.
        """
        ends, gains, errors = np.concatenate(gather_all(self._ends)), gather_all(self._gains), gather_all(self._errors)
        if len(ends):
            self.log("val/outage_end_m", mean_error(ends, "log"))
            self.log("val/outage_end_rms_m", mean_error(ends, "rms"))
        if gains:
            gain = torch.cat(gains).std(0, correction=0) * INNOVATION / STATE[:, None]
            self.log("val/gain_std", float(gain.square().mean().sqrt()))
        error = torch.cat(errors).std(0, correction=0) / torch.tensor(IMU_ERROR_SIZE)
        self.log("val/imu_error_std", float(error.square().mean().sqrt()))
