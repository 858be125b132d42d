"""Noise factors of a Kalman filter found by gradient through the whole filter, all at once.

The same gradient trains ``plus``; here every factor is one number for all epochs, as in ``dlkf.tune``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from dlkf.data.drive import Batch
from dlkf.filters.integration import Correction, Epoch, integrate
from dlkf.filters.model_based import Mbkf
from dlkf.filters.noise_factors import NoiseFactors
from dlkf.filters.tuning import Tuning
from dlkf.navigation.calibration import ImuError

FACTORS = (
    "accel_noise", "gyro_noise", "accel_walk", "gyro_walk", "position_std", "velocity_std", "lateral_std",
    "vertical_std",
)  # fmt: skip
RATE = 0.15  # of Adam, at the start
NEAR_M = 0.1  # errors below count as this, so that the logarithm has no pole


class ScaledFilter(nn.Module):
    """A Kalman filter whose factors are parameters, as logarithms; 0: as the filter has them."""

    def __init__(self, kalman: Mbkf) -> None:
        super().__init__()
        self.kalman = replace(kalman, cut_transition=True)
        self.logarithms = nn.Parameter(torch.zeros(len(FACTORS), dtype=torch.float64))

    def begin(self, batch: Batch) -> tuple[Any, Tensor | ImuError]:
        """Of the Kalman filter."""
        return self.kalman.begin(batch)

    def step(self, memory: Any, epoch: Epoch) -> tuple[Any, Correction]:
        """Of the Kalman filter with the factors in force."""
        of = self.logarithms.exp().expand(len(epoch.z), -1)
        fix = of[:, [4, 4, 5, 5]]
        noise = NoiseFactors(of[:, :4, None].expand(-1, 4, 3), fix, of[:, 6:8])
        return self.kalman.step(memory, epoch._replace(noise=noise))

    def tuning(self) -> Tuning:
        """Settings with which a filter without factors is the same."""
        values = dict(zip(FACTORS, self.logarithms.detach().exp().tolist(), strict=True))
        start = self.kalman.tuning
        return replace(start, **{k: v * getattr(start, k) for k, v in values.items()})


def tune_by_gradient(kalman: Mbkf, batch: Batch, end: int, *, steps: int = 60) -> Tuning:
    """Factors with the least geometric mean of the horizontal error at epoch ``end``, on the way down (Adam)."""
    filter = ScaledFilter(kalman)
    optimizer = torch.optim.Adam(filter.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, RATE / 20)
    best, found = float("inf"), filter.tuning()
    for _ in range(steps):
        solution = integrate(batch, filter)
        error = (solution.posterior.p_n - batch.truth.p_n)[:, end, :2]
        loss = 0.5 * torch.log(error.square().sum(-1) + NEAR_M**2).mean()
        value = float(loss.detach())
        if value < best:
            best, found = value, filter.tuning()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return found
