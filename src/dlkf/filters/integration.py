"""The one loosely coupled loop that every filter here runs in (R001–R006, R010–R012; paper fig. 1).

An estimator answers two questions at each epoch: what is the correction of position, velocity and attitude,
and what is the IMU error from now on? Strapdown, innovation, lever arm, masks and feedback are the same for
all, so that a comparison between filters compares their answers and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.error_model import measurement
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import Window, strapdown

RATE_AVERAGE_S = 0.1  # the lever arm's swing uses the mean rate over this last part of the window


class Epoch(NamedTuple):
    """What an estimator sees at the end of a window; nothing here comes from a reference."""

    imu: Tensor  # (B, M, 6) raw samples
    imu_error: Tensor  # (B, 6) that was taken off them
    start: NavState  # at the window's start, after the last correction
    window: Window
    z: Tensor  # (B, 6) GNSS − prediction, zero where not used
    H: Tensor  # (B, 6, 15)
    used: Tensor  # (B, 6) bool
    fix: Tensor  # (B, 6) antenna position and velocity in n, zero where not used
    fix_std: Tensor  # (B, 6)
    dt: float
    frame: TangentFrame


class Correction(NamedTuple):
    """An estimator's answer: correction (B, 9), IMU error (B, 6), and what it can tell about itself."""

    dx: Tensor
    imu_error: Tensor
    std: Tensor | None = None  # (B, 15) 1σ after the update
    gain: Tensor | None = None  # (B, 9, 6)


@runtime_checkable
class Estimator(Protocol):
    """The part of a filter that differs from filter to filter."""

    def begin(self, batch: Batch) -> tuple[Any, Tensor]:
        """Memory at the start of a batch and the IMU error (B, 6) in force until the first epoch ends."""
        ...

    def step(self, memory: Any, epoch: Epoch) -> tuple[Any, Correction]:
        """Memory and correction at the end of an epoch."""
        ...


@dataclass(frozen=True)
class Solution:
    """A filter's output over a batch, one row at the end of each epoch."""

    prior: NavState  # (B, T, …) before the update
    posterior: NavState  # (B, T, …) after it
    imu_error: Tensor  # (B, T, 6) estimate after the epoch
    innovation: Tensor  # (B, T, 6)
    used: Tensor  # (B, T) bool: a fix was used
    std: Tensor | None  # (B, T, 15)
    gain: Tensor | None  # (B, T, 9, 6)


def integrate(batch: Batch, estimator: Estimator) -> Solution:
    """Run an estimator over a batch from its start state; differentiable where the estimator is."""
    _, T, M = batch.size
    state = batch.start
    memory, imu_error = estimator.begin(batch)
    usable = batch.gnss_valid & batch.available.unsqueeze(-1)
    late = bool(batch.gnss_lag.any())
    tail = max(1, min(M, round(RATE_AVERAGE_S / batch.dt)))
    priors, posteriors, answers, innovations = [], [], [], []
    for t in range(T):
        raw = batch.imu[:, t]
        corrected = raw - imu_error.unsqueeze(1)
        window = strapdown(state, corrected, batch.dt, batch.frame)
        prior = window.end
        lag = batch.gnss_lag[:, t]
        at_fix = window.before(lag, batch.dt) if late else prior
        predicted, H = measurement(at_fix, corrected[:, -tail:, 3:].mean(1), batch.lever_arm_b, batch.frame)
        if late:  # δp at the fix = δp at the window's end − lag · δv
            H[:, 0, 3] = H[:, 1, 4] = H[:, 2, 5] = -lag
        used = usable[:, t]
        z = torch.where(used, batch.gnss[:, t] - predicted, torch.zeros_like(predicted))
        epoch = Epoch(
            imu=raw, imu_error=imu_error, start=state, window=window, z=z, H=H, used=used,
            fix=batch.gnss[:, t], fix_std=batch.gnss_std[:, t], dt=batch.dt, frame=batch.frame,
        )  # fmt: skip
        memory, answer = estimator.step(memory, epoch)
        state, imu_error = prior.corrected(answer.dx), answer.imu_error
        priors.append(prior)
        posteriors.append(state)
        answers.append(answer)
        innovations.append(z)

    def gathered(name: str) -> Tensor | None:
        rows = [getattr(a, name) for a in answers]
        return None if rows[0] is None else torch.stack(rows, 1)

    return Solution(
        prior=NavState(*(torch.stack(x, 1) for x in zip(*priors))),
        posterior=NavState(*(torch.stack(x, 1) for x in zip(*posteriors))),
        imu_error=torch.stack([a.imu_error for a in answers], 1),
        innovation=torch.stack(innovations, 1),
        used=usable.any(-1),
        std=gathered("std"),
        gain=gathered("gain"),
    )
