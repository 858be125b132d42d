"""Stationarity detection, from the samples of a window and the vibration levels of this car at rest and in motion.

Engines idle differently and IMUs are noisy differently, so no fixed limit on the samples' spread fits two cars: the
levels are learned while GNSS shows whether the car moves. A standstill is then a window whose level is closer to the
least of a stationary second than to the least of a moving one, without acceleration or turn (the hypothesis of
Skog et al. 2010, within the filter's 1σ), and not against the filter's estimate of the speed: within 3σ, or within 2σ
of at most 1 m/s where the two levels are not four times apart, since a smoother road may still come. A car without
vibration has the same spread in both; then a standstill needs a speed below 0.5 m/s + 1σ, of which at most 0.5 m/s
count, for minutes at constant speed show no acceleration and no turn either. While nothing is learned of a car, the
filter's 1σ of tilt may not explain an acceleration.

Carrier-phase positions show motion as velocities do; positions with an error of metres do not, since the small 1σ after
a wrong standstill would confirm it. Where fixes show a standstill for some seconds, its vibration does not matter: an
idling engine can shake the IMU more than a smooth road does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.integration import Epoch
from dlkf.navigation.earth import NOMINAL_GRAVITY
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, VELOCITY

SURE_STD = 0.3  # m/s: speeds with a larger 1σ do not update the levels
CARRIER_STD = 0.2  # m: positions with a larger 1σ show no motion
STANDING_SPEED, MOVING_SPEED = 0.3, 1.5  # m/s: from which side on a second counts as the one or the other
APART = 10.0  # prior ratio of the level of a moving car to that of a stationary one
# ratios of moving to standing: below the first the samples do not separate the two, above the second they surely do
DISTINCT, SURELY_DISTINCT = 2.0, 4.0
MEMORY_S = 100.0  # s, stationary or moving, in which a level grows by e, so that a wrong second decays
STILL_ACCEL, STILL_RATE = 0.2, 0.01  # m/s², rad/s: with less, beyond the filter's 2σ, a car may be stationary
UNLEARNED_ACCEL = 0.3  # m/s²: at most so much of the filter's 2σ counts while nothing is learned of the car
PLAUSIBLE_SPEED, PLAUSIBLE_SIGMAS = 0.5, 3.0  # m/s, 1σ: a standstill must not contradict the filter
DOUBTFUL_SPEED = 1.0  # m/s, at most so much of 2σ where the samples separate the two, but not surely
PROVEN_S, PROVEN_SPEED = 3.0, 0.2  # s without acceleration or turn, m/s beyond 2σ: a standstill that fixes show
# m/s: where the samples do not separate the two, a standstill needs a smaller 1σ of the speed
SILENT_STD = 0.5
LEAST_S = 1.0  # of a standstill: shorter update intervals are taken together


class VibrationLevel(NamedTuple):
    """Vibration levels of a car: spread of specific force times spread of rate [m/s² rad/s]; inf: nothing yet."""

    standing: Tensor  # (B,) least level of a stationary second
    moving: Tensor  # (B,) likewise
    still_s: Tensor  # (B,) s without acceleration or turn

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> VibrationLevel:
        """Before the first sample."""
        nothing = like.new_full((batch_size,), math.inf)
        return cls(nothing, nothing, like.new_zeros(batch_size))

    def thresholds(
        self, prior: Float[Tensor, " 1"]
    ) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"], Bool[Tensor, " B"]]:
        """The limit, half way as logarithms between stationary and moving, near zero where the two are alike; and
        whether the samples separate a stationary car from a moving one so far, and surely."""
        moving = torch.where(self.moving.isinf(), prior, self.moving)
        standing = torch.where(self.standing.isinf(), moving / APART, self.standing)
        distinct, surely = moving > DISTINCT * standing, moving > SURELY_DISTINCT * standing
        return torch.where(distinct, (standing * moving).sqrt(), prior / APART), distinct, surely

    def update(self, now: Tensor, standing: Tensor, moving: Tensor, span: float) -> VibrationLevel:
        """After a window of ``span`` seconds in which the car was surely stationary, or moving, or neither."""
        fade = math.exp(span / MEMORY_S)
        return self._replace(
            standing=torch.where(standing, torch.minimum(fade * self.standing, now), self.standing),
            moving=torch.where(moving, torch.minimum(fade * self.moving, now), self.moving),
        )


class WheelMotion(NamedTuple):
    """What a wheel that agrees with the filter says of a window; neither where it says nothing, or turns slowly."""

    rolling: Tensor  # (B,) bool
    stopped: Tensor  # (B,) bool


def vibration_level(imu: Float[Tensor, "B M 6"]) -> Float[Tensor, " B"]:
    """Spread of specific force times spread of rate in a window [m/s² rad/s]; of one sample there is none."""
    if imu.shape[1] < 2:
        return torch.zeros_like(imu[:, 0, 0])
    swing = imu - imu.mean(1, keepdim=True)  # torch's var of a middle axis takes four times as long
    force, rate = (swing.square().sum(1) / (imu.shape[1] - 1)).unflatten(-1, (2, 3)).sum(-1).unbind(-1)
    return (force * rate).sqrt()


@torch.no_grad()
def detect_stationary(
    epoch: Epoch, turning: Float[Tensor, "B 3"], P: Float[Tensor, "B n n"], before: VibrationLevel,
    prior: Float[Tensor, " 1"], wheel: WheelMotion | None = None,
) -> tuple[Bool[Tensor, " B"], VibrationLevel]:  # fmt: skip
    """Whether the car was stationary in the window, and the levels after it; ``turning`` is its mean rate [rad/s].

    Of one sample there is no spread: the levels stay, and no standstill is found. A ``wheel`` that rolls forbids a
    standstill, one that is stopped makes it where the samples show neither acceleration nor turn, at any vibration;
    and both give levels of this car where GNSS gives no velocity.
    """
    if epoch.imu.shape[1] < 2:
        return torch.zeros_like(before.standing) > 0, before
    level = vibration_level(epoch.imu)
    span = epoch.dt * epoch.imu.shape[1]
    v, diagonal = epoch.window.end.v_n, P.diagonal(dim1=-2, dim2=-1)
    speed, std = v[:, :2].norm(dim=-1), diagonal[:, VELOCITY][:, :2].sum(-1).sqrt()
    tilt, accel = diagonal[:, ATTITUDE][:, :2].sum(-1), diagonal[:, ACCEL].sum(-1)
    gained = (v - epoch.start.v_n)[:, :2].norm(dim=-1) / span
    doubt = 2 * (NOMINAL_GRAVITY**2 * tilt + accel).sqrt()  # of the acceleration
    unlearned = before.standing.isinf() & before.moving.isinf()
    still = (gained < STILL_ACCEL + torch.where(unlearned, doubt.clamp_max(UNLEARNED_ACCEL), doubt)) & (
        turning.norm(dim=-1) < STILL_RATE + 2 * diagonal[:, GYRO].sum(-1).sqrt()
    )
    exact = epoch.used[:, :2].all(-1) & (epoch.fix.std[:, :2].amax(-1) < CARRIER_STD)
    sure = (epoch.used[:, 3:5].all(-1) | exact) & (std < SURE_STD)
    standing, moving = sure & (speed + std < STANDING_SPEED), sure & (speed - std > MOVING_SPEED)
    if wheel is not None:
        stopped = wheel.stopped & still
        standing, moving = standing & ~wheel.rolling | stopped, (moving | wheel.rolling) & ~stopped
    still_s = torch.where(still, before.still_s + span, 0.0)
    after = before.update(level, standing, moving, span)._replace(still_s=still_s)
    # like spectra: a wide 1σ would admit any speed, so only a speed that is nearly zero and known to be counts
    limit, distinct, surely = after.thresholds(prior)
    doubt = torch.where(distinct, (2 * std).clamp_max(DOUBTFUL_SPEED), std.clamp_max(SILENT_STD))
    doubt = torch.where(surely, PLAUSIBLE_SIGMAS * std, doubt)
    plausible = speed < PLAUSIBLE_SPEED + doubt
    stationary = (level <= limit) & still & (still_s > LEAST_S - 0.5 * span) & plausible
    proven = sure & still & (still_s > PROVEN_S - 0.5 * span) & (speed + 2 * std < PROVEN_SPEED)
    stationary = stationary | proven
    if wheel is not None:
        stationary = stationary & ~wheel.rolling | stopped
    return stationary, after
