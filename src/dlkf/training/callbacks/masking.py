"""Callbacks that hide measurements in training: GNSS decimation (R069), outages (R070), loss of further sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback

from dlkf.base.errors import InputError
from dlkf.base.settings import is_number
from dlkf.data.drive import Batch
from dlkf.data.masks import mask_outage, withhold_fixes

if TYPE_CHECKING:
    from dlkf.training.module import FilterTraining


class BatchCallback(Callback):
    """A callback that changes the batch before the filter runs; random numbers come from the step."""

    def setup(self, trainer: L.Trainer, module: FilterTraining, stage: str) -> None:  # type: ignore[override]
        """Hand :meth:`transform` to the module."""
        if stage == "fit":
            module.transforms.append(self.transform)

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """The batch of this epoch and step."""
        raise NotImplementedError  # abstract


class GnssDecimation(BatchCallback):
    """Updates only ``every_s`` (low, high) whole seconds, drawn per sub-trajectory (R069)."""

    def __init__(self, every_s: Sequence[int] = (2, 5), start_epoch: int = 0) -> None:
        low, high = _bounds("callbacks.decimation: every_s", every_s)
        if low < 1 or low % 1 or high % 1:
            raise InputError(f"callbacks.decimation: every_s is {list(every_s)}, must be whole seconds ≥ 1")
        self.every_s, self.start_epoch = (int(low), int(high)), start_epoch

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """Keep every n-th fix, n per segment."""
        if epoch < self.start_epoch:
            return batch
        B, T, _ = batch.size
        interval = torch.randint(self.every_s[0], self.every_s[1] + 1, (B, 1), generator=generator)
        spacing = (interval / batch.epoch_s).round().long().clamp_min(1)  # epochs
        return withhold_fixes(batch, torch.arange(1, T + 1) % spacing != 0)


class OutageInjection(BatchCallback):
    """One outage of ``duration_s`` (low, high) in every sub-trajectory, after the warm-up (R070, R072; paper.md 4.14).

    The outage leaves ``before_s`` seconds with GNSS at the start and ``after_s`` at the end, so that
    re-convergence is trained too; no longer one is drawn than fits, and segments too short for the shortest get none.
    """

    def __init__(
        self,
        duration_s: Sequence[float] = (10.0, 30.0),
        before_s: float = 10.0,
        after_s: float = 5.0,
        start_epoch: int = 40,
    ) -> None:
        self.duration_s = _bounds("callbacks.outage: duration_s", duration_s)
        self.before_s, self.after_s, self.start_epoch = before_s, after_s, start_epoch

    def check_fits(self, length_s: float) -> None:
        """InputError where not even the longest training segments have room for the shortest outage."""
        if self.before_s + self.duration_s[0] + self.after_s > length_s + 1e-6:
            raise InputError(
                f"callbacks.outage: {self.duration_s[0]:g} s without GNSS, before_s={self.before_s:g} and after_s="
                f"{self.after_s:g} do not fit into training segments of {length_s:g} s; give shorter ones, or longer "
                "segments (callbacks.curriculum.full_s, without a curriculum data.length_s)"
            )

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """Hide the fixes inside the outage."""
        B, T, _ = batch.size
        room = T * batch.epoch_s - self.before_s - self.after_s
        shortest, longest = self.duration_s[0], min(self.duration_s[1], room)
        if epoch < self.start_epoch or longest < shortest:
            return batch
        length = shortest + (longest - shortest) * torch.rand(B, 1, generator=generator)
        start = self.before_s + (room - length) * torch.rand(B, 1, generator=generator)
        return withhold_fixes(batch, mask_outage(batch, start[:, 0], length[:, 0]))


class SensorLoss(BatchCallback):
    """Further sensors of the car (wheel speed, …) that a segment lacks, or that fall silent at some moment of it.

    Of the segments a share of ``without`` has none of them, and a share of ``lost`` until a moment that is uniform in
    the segment; the rest keeps what its drive has. So one set of weights serves cars with a wheel, without, and with
    one that fails.
    """

    def __init__(self, without: float = 1 / 3, lost: float = 1 / 3) -> None:
        shares = (without, lost)
        if not (all(map(is_number, shares)) and min(shares) >= 0 and sum(shares) <= 1 + 1e-9):
            raise InputError(
                f"callbacks.sensor_loss: without is {without!r} and lost {lost!r}, must be shares with a sum ≤ 1"
            )
        self.without, self.lost = without, lost

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """Blank rows of the batch's sensors."""
        if not batch.aids:
            return batch
        B, T, _ = batch.size
        kind, moment = torch.rand(2, B, 1, generator=generator)
        end = torch.where(kind < self.without, 0.0, torch.where(kind < self.without + self.lost, moment, 1.0)) * T
        there = (torch.arange(T) < end).unsqueeze(-1)
        return replace(batch, aids={name: rows * there for name, rows in batch.aids.items()})


def _bounds(name: str, values: Sequence[float]) -> tuple[float, float]:
    """Two numbers; InputError where they are none, or do not rise from above 0."""
    if not (isinstance(values, Sequence) and len(values) == 2 and all(map(is_number, values))):
        raise InputError(f"{name} is {values!r}, must be [low, high] in seconds")
    low, high = values
    if not 0 < low <= high:
        raise InputError(f"{name} is {values!r}, must rise from above 0")
    return low, high
