"""Callbacks that hide GNSS fixes from the filter in training: decimation (R069) and outages (R070)."""

from __future__ import annotations

import torch
from lightning.pytorch.callbacks import Callback

from dlkf.data.drive import Batch
from dlkf.data.masks import withhold, within
from dlkf.errors import InputError


class BatchCallback(Callback):
    """A callback that changes the batch before the filter sees it; random numbers come from the step."""

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """The batch of this epoch and step."""
        raise NotImplementedError  # abstract


class GnssDecimation(BatchCallback):
    """Updates only every ``shortest`` … ``longest`` seconds, drawn per sub-trajectory (R069)."""

    def __init__(self, shortest_s: int = 2, longest_s: int = 5, start_epoch: int = 0) -> None:
        if not 1 <= shortest_s <= longest_s:
            raise InputError(f"callbacks.decimation: 1 ≤ shortest_s ≤ longest_s, got {shortest_s}, {longest_s}")
        self.shortest_s, self.longest_s, self.start_epoch = shortest_s, longest_s, start_epoch

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """Keep every n-th fix, n per piece."""
        if epoch < self.start_epoch:
            return batch
        B, T, _ = batch.size
        interval = torch.randint(self.shortest_s, self.longest_s + 1, (B, 1), generator=generator)
        step = (torch.arange(1, T + 1) * batch.epoch_s).round().long()
        return withhold(batch, step % interval != 0)

    def state_dict(self) -> dict:
        """Settings, so that a checkpoint tells what it was trained with."""
        return {"shortest_s": self.shortest_s, "longest_s": self.longest_s, "start_epoch": self.start_epoch}


class OutageInjection(BatchCallback):
    """One outage of random length in every sub-trajectory, once warm-up is over (R070, R072; paper.md 4.14).

    The outage leaves ``before_s`` seconds with GNSS at the start and ``after_s`` at the end, so that
    re-convergence is trained too; pieces too short for the shortest outage get none.
    """

    def __init__(
        self,
        shortest_s: float = 10.0,
        longest_s: float = 30.0,
        before_s: float = 10.0,
        after_s: float = 5.0,
        start_epoch: int = 40,
    ) -> None:
        if not 0 < shortest_s <= longest_s:
            raise InputError(f"callbacks.outage: 0 < shortest_s ≤ longest_s, got {shortest_s}, {longest_s}")
        self.shortest_s, self.longest_s = shortest_s, longest_s
        self.before_s, self.after_s, self.start_epoch = before_s, after_s, start_epoch

    def transform(self, batch: Batch, epoch: int, generator: torch.Generator) -> Batch:
        """Hide the fixes inside the outage."""
        B, T, _ = batch.size
        room = T * batch.epoch_s - self.before_s - self.after_s
        longest = min(self.longest_s, room)
        if epoch < self.start_epoch or longest < self.shortest_s:
            return batch
        length = self.shortest_s + (longest - self.shortest_s) * torch.rand(B, 1, generator=generator)
        start = self.before_s + (room - length) * torch.rand(B, 1, generator=generator)
        return withhold(batch, within(batch, start[:, 0], length[:, 0]))

    def state_dict(self) -> dict:
        """Settings, so that a checkpoint tells what it was trained with."""
        return {k: getattr(self, k) for k in ("shortest_s", "longest_s", "before_s", "after_s", "start_epoch")}
