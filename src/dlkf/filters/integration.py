"""The one loosely coupled loop that every filter here runs in (R001–R006, R010–R012; paper fig. 1).

An estimator answers two questions at each epoch: what is the correction of position, velocity and attitude,
and what is the IMU error from now on? Strapdown, innovation, lever arm, masks and feedback are the same for
all, so that a comparison between filters compares their answers and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.noise_factors import NoiseFactors
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.error_model import ARM_RATE_S, RATE_AVERAGE_S, antenna
from dlkf.navigation.state import VELOCITY, NavState
from dlkf.navigation.strapdown import Window, strapdown

HELD_STD = 0.3  # m/s: 1σ of a speed below that at which a receiver begins to hold its fix, 0.5 m/s as a rule


class Fix(NamedTuple):
    """GNSS of one epoch: values, which of them may be used, and the rows of further sensors."""

    value: Tensor  # (B, 6) antenna position and velocity in n
    std: Tensor  # (B, 6)
    used: Tensor  # (B, 6) bool
    lag: Tensor | None  # (B,) s before the epoch's end; None: all on it
    aids: Mapping[str, Tensor] | None = None  # (B, 5) of further sensors by name, see dlkf.data.aids.ROW
    velocity_lag: Tensor | None = None  # (B,) as lag, of the velocity; of an epoch of filters that estimate it

    def widen_held_velocity(self) -> Fix:
        """With a 1σ of at least ``HELD_STD`` for a velocity of exactly zero, which is none that a receiver measures:
        with static hold it gives zero for any speed below some limit, and a car may creep."""
        held = self.used[:, 3:5].all(-1, keepdim=True) & (self.value[:, 3:5] == 0).all(-1, keepdim=True)
        velocity = torch.where(held, self.std[:, VELOCITY].clamp_min(HELD_STD), self.std[:, VELOCITY])
        return self._replace(std=torch.cat((self.std[:, : VELOCITY.start], velocity), -1))


class Epoch(NamedTuple):
    """Input of an estimator at the end of a window; nothing here comes from a reference."""

    imu: Tensor  # (B, M, 6) raw samples
    corrected: Tensor  # (B, M, 6) without the IMU error
    error: ImuError  # that was taken off them
    start: NavState  # at the window's start, after the last correction
    window: Window
    at_fix: NavState  # the window's end, or where a late fix was taken
    rate_b: Tensor  # (B, 3) corrected angular rate at the window's end, mean of 0.1 s
    rate_at_fix_b: Tensor  # (B, 3) and where the fix was taken, mean of 0.02 s
    z: Tensor  # (B, 6) GNSS − prediction, zero where not used
    fix: Fix
    lever_arm_b: Tensor | None  # (B, 3); None: the antenna is at the IMU
    dt: float
    frame: TangentFrame
    noise: NoiseFactors | None = None  # from outside the filter

    @property
    def imu_error(self) -> Tensor:
        """(B, 6) bias that was taken off the samples."""
        return self.error.bias

    @property
    def used(self) -> Tensor:
        """(B, 6) bool: components of the fix that may be used."""
        return self.fix.used

    @property
    def span_s(self) -> float:
        """Length of the window [s]."""
        return self.dt * self.imu.shape[1]


class Covariances(NamedTuple):
    """Covariances of a Kalman filter in an epoch: for smoothing and for tests of consistency."""

    Phi: Tensor  # (B, n, n) of the window
    predicted: Tensor  # (B, n, n) P before the update
    updated: Tensor  # (B, n, n) P after it
    H: Tensor  # (B, 6, n) of GNSS, zero rows where a component may not be used
    R: Tensor  # (B, 6) its variance, one there
    dx: Tensor  # (B, n) the whole correction

    @property
    def innovation(self) -> Tensor:
        """Covariance of the innovation before gating, H P Hᵀ + R."""
        return self.H @ self.predicted @ self.H.mT + torch.diag_embed(self.R)


class Correction(NamedTuple):
    """An estimator's output: correction (B, 9), IMU error, and diagnostics where it has them."""

    dx: Tensor
    imu_error: Tensor | ImuError  # (B, 6), or with the sensor matrices
    std: Tensor | None = None  # (B, 15) 1σ after the update
    gain: Tensor | None = None  # (B, 9, 6)
    accepted: Tensor | None = None  # (B,) bool: a fix was used; None: all that might be
    covariances: Covariances | None = None
    aids: Tensor | None = None  # (B, A) of further sensors, see dlkf.filters.aids.attach.aid_columns
    innovation: Tensor | None = None  # (B, 6) as the estimator predicts the fix; None: as the loop does
    rejected: Tensor | None = None  # (B, 6) variance of the innovations that a gate has left out, zero for others


@runtime_checkable
class Estimator(Protocol):
    """The part of a filter that differs from filter to filter."""

    def begin(self, batch: Batch) -> tuple[Any, Tensor | ImuError]:
        """Memory at the start of a batch and the IMU error in force until the first epoch ends: (B, 6), or with the
        sensor matrices."""
        ...

    def step(self, memory: Any, epoch: Epoch) -> tuple[Any, Correction]:
        """Memory and correction at the end of an epoch."""
        ...


class WholeLoop:
    """An estimator that runs the loop itself, because it was compiled with it (:mod:`dlkf.onboard`)."""

    def advance(self, memory: Any, imu: Tensor, fix: Fix, frame: TangentFrame) -> tuple[Any, Step]:
        """What :func:`advance` gives; state and error are in its memory."""
        raise NotImplementedError

    def integrate(self, batch: Batch) -> BatchSolution:
        """What :func:`integrate` gives."""
        raise NotImplementedError


class Step(NamedTuple):
    """One filter step."""

    prior: NavState
    posterior: NavState
    error: ImuError
    innovation: Tensor  # (B, 6)
    complete_error: Tensor  # (B, 6) bias + M · mean of the window's samples
    answer: Correction


@dataclass(frozen=True)
class BatchSolution:
    """A filter's output over a batch, one row at the end of each epoch."""

    prior: NavState  # (B, T, …) before the update
    posterior: NavState  # (B, T, …) after it
    imu_error: Tensor  # (B, T, 6) complete estimate after the epoch
    innovation: Tensor  # (B, T, 6)
    used: Tensor  # (B, T) bool: a fix was used
    std: Tensor | None  # (B, T, 15)
    gain: Tensor | None  # (B, T, 9, 6)
    covariances: Covariances | None = None  # (B, T, …) where asked for and known
    error: ImuError | None = None  # (B, T, …) likewise: bias and sensor matrices apart
    innovation_covariance: Tensor | None = None  # (B, T, 6, 6) H P Hᵀ + R before gating, kept with the covariances
    position_covariance: Tensor | None = None  # (B, T, 2, 2) horizontal, before the update, likewise
    aids: Tensor | None = None  # (B, T, A) of further sensors, see dlkf.filters.aids.attach.aid_columns


def advance(
    estimator: Estimator,
    memory: Any,
    state: NavState,
    error: ImuError,
    imu: Tensor,
    fix: Fix,
    *,
    dt: float,
    frame: TangentFrame,
    lever_arm_b: Tensor | None,
) -> tuple[Any, Step]:
    """One epoch: strapdown over its samples (B, M, 6), innovation, the estimator's answer, feedback."""
    if isinstance(estimator, WholeLoop):
        return estimator.advance(memory, imu, fix, frame)
    fix = fix.widen_held_velocity()
    corrected = error.correct(imu)
    window = strapdown(state, corrected, dt, frame)
    prior = window.end
    tail = max(1, min(imu.shape[1], round(RATE_AVERAGE_S / dt)))
    at_fix = prior if fix.lag is None else window.interpolate_before(state, fix.lag, dt)
    rate_b = corrected[:, -tail:, 3:].sum(1) / tail
    few = max(1, min(tail, round(ARM_RATE_S / dt)))
    if fix.lag is None:
        rate_at_fix_b = corrected[:, -few:, 3:].sum(1) / few
    else:
        rate_at_fix_b = rate_before(corrected[..., 3:], fix.lag / dt, few)
    predicted = antenna(at_fix, rate_at_fix_b, lever_arm_b, frame)
    z = (fix.value - predicted) * fix.used
    epoch = Epoch(imu, corrected, error, state, window, at_fix, rate_b, rate_at_fix_b, z, fix, lever_arm_b, dt, frame)
    memory, answer = estimator.step(memory, epoch)
    after = ImuError.of(answer.imu_error)
    complete = after.bias if after[1:] == (None, None) else after.at(corrected.mean(1))
    innovation = z if answer.innovation is None else answer.innovation
    return memory, Step(prior, prior.correct(answer.dx), after, innovation, complete, answer)


def rate_before(rates: Tensor, late: Tensor, count: int) -> Tensor:
    """Mean of the ``count`` samples (B, M, 3) that end nearest to ``late`` (B,) samples before the window's end."""
    M = rates.shape[1]
    end = M - (late + 0.5).floor().clamp(0, M - count).unsqueeze(-1)
    sample = torch.arange(M, dtype=late.dtype, device=late.device)
    counts = ((sample < end) & (sample >= end - count)).to(rates.dtype)
    return torch.bmm(counts.unsqueeze(1), rates).squeeze(1) / count


def integrate(
    batch: Batch, estimator: Estimator, *, keep_covariances: bool = False, keep_innovations: bool = False
) -> BatchSolution:
    """Run an estimator over a batch from its start state; differentiable where the estimator is.

    ``keep_covariances``: all of them; ``keep_innovations``: those of the innovation and of the horizontal position.
    """
    if isinstance(estimator, WholeLoop):
        return estimator.integrate(batch)
    state, frame = batch.start, batch.frame.prepare()
    memory, imu_error = estimator.begin(batch)
    error = ImuError.of(imu_error)
    usable = batch.gnss_valid & batch.available.unsqueeze(-1)
    late = bool(batch.gnss_lag.any())
    lever_arm_b = batch.lever_arm_b if bool(batch.lever_arm_b.any()) else None
    steps: list[Step] = []
    spreads: list[tuple[Tensor, Tensor]] = []
    lags = batch.gnss_lag.unbind(1) if late else [None] * batch.size[1]
    aids: Iterable[Mapping[str, Tensor] | None] = repeat(None)
    if batch.aids:
        aids = (dict(zip(batch.aids, rows)) for rows in zip(*(x.unbind(1) for x in batch.aids.values())))
    fixes = map(Fix, batch.gnss.unbind(1), batch.gnss_std.unbind(1), usable.unbind(1), lags, aids)
    for imu, fix in zip(batch.imu.unbind(1), fixes):
        memory, step = advance(
            estimator, memory, state, error, imu, fix,
            dt=batch.dt, frame=frame, lever_arm_b=lever_arm_b,
        )  # fmt: skip
        if keep_innovations and step.answer.covariances is not None:
            kept = step.answer.covariances
            spreads.append((kept.innovation, kept.predicted[:, :2, :2].clone()))
        if not keep_covariances:
            step = step._replace(answer=step.answer._replace(covariances=None))
        state, error = step.posterior, step.error
        steps.append(step)
    solution = stack_steps(steps, usable.any(-1), keep_errors=keep_covariances)
    if not spreads:
        return solution
    of_innovation, of_position = (torch.stack(x, 1) for x in zip(*spreads))
    return replace(solution, innovation_covariance=of_innovation, position_covariance=of_position)


def stack_steps(steps: list[Step], offered: Tensor, *, keep_errors: bool) -> BatchSolution:
    """The steps of a run as one solution; ``offered`` (B, T): where a fix might have been used."""

    def stack_rows(rows: list) -> Tensor | None:
        return None if rows[0] is None else torch.stack(rows, 1)

    def stack_fields(rows: Sequence[Any], kind: type) -> Any:
        """Named tuples field by field; a field that appears with the first update is zero before."""
        fields = []
        for column in zip(*rows):
            known = next((x for x in column if x is not None), None)
            fill = None if known is None else torch.zeros_like(known)
            fields.append(stack_rows([fill if x is None else x for x in column]))
        return kind(*fields)

    answers = [s.answer for s in steps]
    accepted = stack_rows([a.accepted for a in answers])
    each_covariances = [a.covariances for a in answers]
    covariances = None if each_covariances[0] is None else stack_fields(each_covariances, Covariances)
    return BatchSolution(
        prior=stack_fields([s.prior for s in steps], NavState),
        posterior=stack_fields([s.posterior for s in steps], NavState),
        imu_error=torch.stack([s.complete_error for s in steps], 1),
        innovation=torch.stack([s.innovation for s in steps], 1),
        used=offered if accepted is None else offered & accepted,
        std=stack_rows([a.std for a in answers]),
        gain=stack_rows([a.gain for a in answers]),
        covariances=covariances,
        error=stack_fields([s.error for s in steps], ImuError) if keep_errors else None,
        innovation_covariance=None if covariances is None else covariances.innovation,
        position_covariance=None if covariances is None else covariances.predicted[..., :2, :2],
        aids=stack_rows([a.aids for a in answers]),
    )
