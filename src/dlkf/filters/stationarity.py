"""Stationarity detection, from the samples of a window and the vibration levels of this car at rest and in motion.

An idling engine shakes an IMU at 10 Hz and more, and can do so more than a smooth road; a car in motion also sways
and pitches more slowly. So the level is that of means over ``AVERAGE_S``, in which the noise of the sensors is smaller
too. IMUs and roads differ, so no fixed limit on it fits two cars: the levels are learned while GNSS shows whether the
car moves. A standstill is then a window whose level is closer to the
least of a stationary second than to the least of a moving one, without acceleration or turn (the hypothesis of
Skog et al. 2010, within the filter's 1σ), and not against the filter's estimate of the speed: within 3σ, or within 2σ
of at most 1 m/s where the two levels are not four times apart, since a smoother road may still come. A car without
vibration has the same spread in both; then a standstill needs a speed below 0.5 m/s + 1σ, of which at most 0.5 m/s
count, for minutes at constant speed show no acceleration and no turn either. So does one of a car of which nothing is
learned, and there the filter's 1σ of tilt explains little of an acceleration. A speed above 0.5 m/s needs
``DOUBTFUL_S``, for a car creeps as calmly for a second. A car that creeps shakes less than one that drives faster, so
a level that is closer to motion than a third of the way, as logarithms, is that of a standstill only below 0.2 m/s
+ 1σ. Where a car has shaken as little for ``LONG_S`` as at a
standstill, and far more in every second of motion so far, the filter's speed is wrong, within 20σ and 10 m/s: one event
that its noise does not know spoils it so much.

Carrier-phase positions show motion as velocities do. Of positions that are off by metres, two that lie ``SPAN_S`` apart
do: the filter's own 1σ shows nothing, for a wrong standstill would confirm itself. Where fixes show a standstill for
some seconds, its vibration does not matter. Where the mean of their velocities, since the last acceleration or turn, is
none of a standstill, there is none, whatever the filter takes its speed for. In a standstill the measured force is
constant: a change shows a car that pulls away, though errors of tilt might explain the acceleration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import Epoch
from dlkf.navigation.attitude import skew
from dlkf.navigation.earth import NOMINAL_GRAVITY
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, VELOCITY

SURE_STD = 0.3  # m/s: speeds with a larger 1σ do not update the levels
CARRIER_STD = 0.2  # m: positions with a larger 1σ show no motion
STANDING_SPEED, MOVING_SPEED = 0.3, 1.5  # m/s: from which side on a second counts as the one or the other
APART = 10.0  # prior ratio of the level of a moving car to that of a stationary one
LEAST_FORCE, LEAST_RATE = 1e-3, 1e-4  # m/s², rad/s: added to the spreads, which are 0 at rest where sensors round
# ratios of moving to standing: below the first the samples do not separate the two, above the second they surely do
DISTINCT, SURELY_DISTINCT = 2.0, 4.0
MEMORY_S = 100.0  # s, stationary or moving, in which a level grows by e, so that a wrong second decays
STILL_ACCEL, STILL_RATE = 0.1, 0.01  # m/s², rad/s: with less, beyond the filter's 2σ, a car may be stationary
UNLEARNED_ACCEL = 0.3  # m/s²: at most so much of the filter's 2σ counts while nothing is learned of the car
PLAUSIBLE_SPEED, PLAUSIBLE_SIGMAS = 0.5, 3.0  # m/s, 1σ: a standstill must not contradict the filter
DOUBTFUL_SPEED = 1.0  # m/s, at most so much of 2σ where the samples separate the two, but not surely
CREEPING_LEVEL_SPEED = 0.2  # m/s + 1σ, in place of 0.5 m/s + 3σ, where the level is between those of rest and motion
PROVEN_S, PROVEN_SPEED = 3.0, 0.2  # s without acceleration or turn, m/s beyond 2σ: a standstill that fixes show
# m/s: where the samples do not separate the two, a standstill needs a smaller 1σ of the speed
SILENT_STD = 0.5
LEAST_S = 1.0  # of a standstill: shorter update intervals are taken together
AVERAGE_S = 0.1  # of the samples: a car in motion sways and pitches more slowly, an engine shakes faster
DOUBTFUL_S = 2.0  # of one at which the filter's speed is above PLAUSIBLE_SPEED: a car creeps for a second as calmly
SPAN_S, SPAN_LEFT_S = 5.0, 10.0  # s between two positions that show a mean speed; longer ones show none
SPAN_SIGMAS, SPAN_STANDING = 3.0, 0.3  # 1σ that a mean speed is beyond MOVING_SPEED; m/s, that of a standstill
LONG_ACCEL = 0.2  # m/s², instead of STILL_ACCEL, of a long rest: a filter with a wrong speed has a wrong tilt
LONG_S, LONG_SIGMAS, ALIKE = 10.0, 20.0, 2.0  # s, 1σ of the speed: of a standstill at most so many times its level
CHANGING_ACCEL = 0.3  # m/s² from the force of the last second, from which on errors of tilt explain no acceleration
CHANGED_ACCEL, REST_S = 0.08, 3.0  # m/s² from the force of a standstill; s over which it is known, and kept after it
CREEPING_SPEED, CREEPING_SIGMAS = 0.05, 3.5  # of the mean velocity of fixes at a standstill: at most, m/s and 1σ
MOST_FIXES, FIX_S = 10.0, 3.0  # in that mean; s after the last of them that it counts
LONG_SPEED, FAR_APART = 10.0, 30.0  # m/s, at most; a level of rest is taken for so many times below that of motion


class IntervalMeans(NamedTuple):
    """What the samples of an update interval, or of the last second if that is longer, show."""

    level: Tensor | None  # (B,) of vibration; None: too few samples for one
    mean: Tensor  # (B, 6) over the interval, or the last 0.2 s if it is shorter
    whole: Tensor  # (B, 6) over the interval, or the second
    rate_variance: Tensor  # (B, 3) of the mean rate over the interval, were means over ``AVERAGE_S`` white


class LastSecond(NamedTuple):
    """The samples of the last second, as means over ``AVERAGE_S`` or the update intervals that are shorter."""

    means: Tensor | None  # (B, k, 6), NaN: not yet; None: an update interval has them all

    @classmethod
    def begin(cls, batch: Batch) -> LastSecond:
        """Before the first sample."""
        B, _, M = batch.size
        parts = _Parts.of(M, batch.dt)
        if parts.count <= parts.each:
            return cls(None)
        return cls(batch.imu.new_full((B, parts.count, 6), math.nan))

    def update(self, imu: Float[Tensor, "B M 6"], dt: float) -> tuple[LastSecond, IntervalMeans]:
        """After the samples of an update interval."""
        parts = _Parts.of(imu.shape[1], dt)
        means = imu[:, imu.shape[1] - parts.each * parts.samples :]
        if parts.samples > 1:
            means = means.unflatten(1, (parts.each, parts.samples)).mean(2)
        if self.means is not None:
            means = torch.cat((self.means, means), 1)
        means = means[:, -parts.count :]
        boxes = means.unflatten(1, (-1, parts.together)).mean(2) if parts.together > 1 else means
        level, variance = None, torch.zeros_like(boxes[:, 0, 3:])
        if boxes.shape[1] > 1:
            spread = _variances(boxes)
            level = _level(spread)
            variance = parts.together * parts.samples / imu.shape[1] * spread[:, 3:].nan_to_num()
        mean = means[:, -max(parts.each, 2 * parts.together) :].mean(1)
        last = LastSecond(None if self.means is None else means)
        return last, IntervalMeans(level, mean, means.mean(1), variance)


class _Parts(NamedTuple):
    """How a second is cut: ``each`` means of ``samples`` an update interval, ``together`` of which are averaged again,
    and ``count`` of which are kept. The first samples of an interval that they do not divide are left out."""

    samples: int
    each: int
    together: int
    count: int

    @classmethod
    def of(cls, M: int, dt: float) -> _Parts:
        """For M samples an update interval."""
        samples = max(1, M // max(1, round(M * dt / AVERAGE_S)))
        each, together = M // samples, max(1, round(AVERAGE_S / (samples * dt)))
        boxes = each // together
        if M * dt < LEAST_S - 0.5 * AVERAGE_S:
            boxes = max(boxes, round(LEAST_S / (together * samples * dt)), 1)
        return cls(samples, each, together, together * boxes)


class PositionSpan(NamedTuple):
    """Positions of a receiver that gives no velocity, some seconds apart: the mean speed between them."""

    place: Tensor  # (B, 2) m, of the IMU in n by the fix that the span begins with; NaN: none
    age_s: Tensor  # (B,) s since
    moving: Tensor  # (B,) least level since, in seconds in which the filter moves; inf: none
    still: Tensor  # (B,) least level since, in seconds without acceleration or turn

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> PositionSpan:
        """Before the first fix."""
        nothing = like.new_full((batch_size,), math.inf)
        return cls(like.new_full((batch_size, 2), math.nan), torch.zeros_like(nothing), nothing, nothing)

    def update(
        self, epoch: Epoch, fixed: Bool[Tensor, " B"], level: Float[Tensor, " B"], moves: Bool[Tensor, " B"],
        still: Bool[Tensor, " B"],
    ) -> tuple[PositionSpan, Float[Tensor, " B"], Float[Tensor, " B"]]:  # fmt: skip
        """After a window, ``fixed`` by a position that counts; and the levels of a stationary and of a moving second
        that the span shows, inf: none."""
        infinite = torch.full_like(level, math.inf)
        age = self.age_s + epoch.span_s
        least = torch.minimum(self.moving, torch.where(moves, level, infinite))
        least_still = torch.minimum(self.still, torch.where(still, level, infinite))
        place = epoch.at_fix.p_n[:, :2] + epoch.z[:, :2]
        speed = (place - self.place).norm(dim=-1) / age
        std = math.sqrt(2) * epoch.fix.std[:, :2].amax(-1) / age
        ends = fixed & (self.place[:, 0].isnan() | (age >= SPAN_S))
        shows = ends & (age <= SPAN_LEFT_S)
        moving = torch.where(shows & (speed - SPAN_SIGMAS * std > MOVING_SPEED), least, infinite)
        standing = torch.where(shows & (speed < SPAN_STANDING), least_still, infinite)
        span = PositionSpan(
            torch.where(ends.unsqueeze(-1), place, self.place), torch.where(ends, 0.0, age),
            torch.where(ends, infinite, least), torch.where(ends, infinite, least_still),
        )  # fmt: skip
        return span, standing, moving


class Rest(NamedTuple):
    """What a standstill has to agree with: its own specific force so far, and the fixes' velocities."""

    last_force: Tensor  # (B, 2) m/s² forward and right as measured, mean over the last second; NaN: none
    force: Tensor  # (B, 2) its mean over the last standstill; NaN: none
    left_s: Tensor  # (B,) s since it
    velocity: Tensor  # (B, 2) m/s, mean of fixes since the car shows no acceleration and no turn
    std: Tensor  # (B,) m/s, 1σ of the last of them
    fixes: Tensor  # (B,) how many
    fix_age_s: Tensor  # (B,) s since the last of them

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> Rest:
        """Nothing known."""
        zero = like.new_zeros(batch_size)
        none = like.new_full((batch_size, 2), math.nan)
        return cls(none, none.clone(), zero, torch.zeros_like(none), zero, zero, zero)

    def has_changed(self, force: Float[Tensor, "B 2"]) -> Bool[Tensor, " B"]:
        """Whether the force differs from that of the standstill that has just been: the car pulls away."""
        return (force - self.force).norm(dim=-1) > CHANGED_ACCEL

    def is_changing(self, force: Float[Tensor, "B 2"]) -> Bool[Tensor, " B"]:
        """Whether the force differs from that of the last second: the car brakes or pulls away. Errors of tilt and
        accelerometers, which may look like any acceleration, do not change within seconds."""
        return (force - self.last_force).norm(dim=-1) > CHANGING_ACCEL

    def meet_fix(self, epoch: Epoch, with_velocity: Bool[Tensor, " B"], still: Bool[Tensor, " B"]) -> Rest:
        """With the velocity of the window's fix; those before an acceleration or a turn do not count."""
        old = ~still | (self.fix_age_s > FIX_S)
        n = torch.where(old, 0.0, self.fixes) + with_velocity.to(self.fixes.dtype)
        fix = epoch.at_fix.v_n[:, :2] + epoch.z[:, 3:5]
        mean = torch.where(old.unsqueeze(-1), 0.0, self.velocity)
        gained = torch.where(with_velocity.unsqueeze(-1), (fix - mean) / n.clamp_min(1.0).unsqueeze(-1), 0.0)
        age = torch.where(with_velocity, 0.0, self.fix_age_s + epoch.span_s)
        std = torch.where(with_velocity, epoch.fix.std[:, 3:5].amax(-1), self.std)
        return self._replace(velocity=mean + gained, std=std, fixes=n.clamp_max(MOST_FIXES), fix_age_s=age)

    def creeps(self) -> Bool[Tensor, " B"]:
        """Whether the mean velocity of the fixes is none of a standstill."""
        std = self.std / self.fixes.clamp_min(1.0).sqrt()
        return (self.fixes > 0) & (self.velocity.norm(dim=-1) > CREEPING_SPEED + CREEPING_SIGMAS * std)

    def update(self, force: Float[Tensor, "B 2"], stationary: Bool[Tensor, " B"], span: float) -> Rest:
        """After a window."""
        left = torch.where(stationary, 0.0, self.left_s + span)
        known = torch.where(self.force.isnan(), force, torch.lerp(self.force, force, -math.expm1(-span / REST_S)))
        kept = torch.where((left > REST_S).unsqueeze(-1), math.nan, self.force)
        force_at_rest = torch.where(stationary.unsqueeze(-1), known, kept)
        return self._replace(last_force=force, force=force_at_rest, left_s=left)


class VibrationLevel(NamedTuple):
    """Vibration levels of a car: spread of specific force times spread of rate [m/s² rad/s], of means over
    ``AVERAGE_S``; inf: nothing yet."""

    standing: Tensor  # (B,) least level of a stationary second
    moving: Tensor  # (B,) likewise
    still_s: Tensor  # (B,) s without acceleration or turn
    calm_s: Tensor  # (B,) s of these at a level that may be a standstill, less those that were not
    rest_s: Tensor  # (B,) s of these at the level of one
    span: PositionSpan
    second: LastSecond
    rest: Rest

    @classmethod
    def begin(cls, batch: Batch) -> VibrationLevel:
        """Before the first sample."""
        like, B = batch.imu, batch.size[0]
        nothing, zero = like.new_full((B,), math.inf), like.new_zeros(B)
        return cls(
            nothing, nothing, zero, zero, zero, PositionSpan.begin(like, B), LastSecond.begin(batch),
            Rest.begin(like, B),
        )  # fmt: skip

    def thresholds(
        self, prior: Float[Tensor, " 1"]
    ) -> tuple[Float[Tensor, " B"], Bool[Tensor, " B"], Bool[Tensor, " B"]]:
        """The limit, half way as logarithms between stationary and moving, near zero where the two are alike; and
        whether the samples separate a stationary car from a moving one so far, and surely."""
        moving = torch.where(self.moving.isinf(), prior, self.moving)
        standing = torch.where(self.standing.isinf(), moving / APART, self.standing)
        distinct, surely = moving > DISTINCT * standing, moving > SURELY_DISTINCT * standing
        return torch.where(distinct, (standing * moving).sqrt(), prior / APART), distinct, surely

    def resting_limit(self) -> Float[Tensor, " B"]:
        """Level up to which a long rest counts against the filter's speed; inf: nothing learned.

        The least standing level is that of one second, perhaps without the engine. So the limit lies a
        third of the way, as logarithms, to the least level of motion.
        """
        least = ALIKE * torch.minimum(self.standing, self.moving / FAR_APART)
        between = torch.where(self.standing.isinf(), 0.0, self.standing * (self.moving / self.standing) ** (1 / 3))
        return torch.maximum(least, between)

    def update(self, standing: Tensor, moving: Tensor, span: float) -> VibrationLevel:
        """After ``span`` seconds with the levels of a second in which the car was surely stationary, or moving; inf:
        neither."""
        fade = math.exp(span / MEMORY_S)
        return self._replace(
            standing=torch.where(standing.isinf(), self.standing, torch.minimum(fade * self.standing, standing)),
            moving=torch.where(moving.isinf(), self.moving, torch.minimum(fade * self.moving, moving)),
        )


class WheelMotion(NamedTuple):
    """What a wheel that agrees with the filter says of a window; neither where it says nothing, or turns slowly."""

    rolling: Tensor  # (B,) bool
    stopped: Tensor  # (B,) bool


def vibration_level(means: Float[Tensor, "B k 6"]) -> Float[Tensor, " B"]:
    """Spread of specific force times spread of rate [m/s² rad/s]; inf where one is not known yet."""
    return _level(_variances(means))


def _level(variances: Float[Tensor, "B 6"]) -> Float[Tensor, " B"]:
    force, rate = variances.unflatten(-1, (2, 3)).sum(-1).unbind(-1)
    level = ((force + LEAST_FORCE**2) * (rate + LEAST_RATE**2)).sqrt()
    return torch.where(level.isnan(), math.inf, level)


def _variances(means: Float[Tensor, "B k 6"]) -> Float[Tensor, "B 6"]:
    """Over the means of a second; torch's var of a middle axis takes four times as long."""
    return (means - means.mean(1, keepdim=True)).square().sum(1) / (means.shape[1] - 1)


@torch.no_grad()
def detect_stationary(
    epoch: Epoch, turning: Float[Tensor, "B 3"], P: Float[Tensor, "B n n"], before: VibrationLevel,
    prior: Float[Tensor, " 1"], wheel: WheelMotion | None = None,
) -> tuple[Bool[Tensor, " B"], VibrationLevel, Float[Tensor, "B 3"]]:  # fmt: skip
    """Whether the car was stationary in the window, the levels after it, and the variance of its mean rate
    ``turning`` [rad/s] by the samples.

    Of one sample a second there is no spread: the levels stay, and no standstill is found. A ``wheel`` that rolls
    forbids a standstill, one that is stopped makes it where the samples show neither acceleration nor turn, at any
    vibration; and both give levels of this car where GNSS gives no velocity.
    """
    second, (level, mean, whole, variance) = before.second.update(epoch.corrected, epoch.dt)
    if level is None:
        return torch.zeros_like(before.standing) > 0, before, variance
    span = epoch.span_s
    v, diagonal = epoch.window.end.v_n, P.diagonal(dim1=-2, dim2=-1)
    speed, std = v[:, :2].norm(dim=-1), diagonal[:, VELOCITY][:, :2].sum(-1).sqrt()
    gained, turn = (v - epoch.start.v_n)[:, :2].norm(dim=-1) / span, turning.norm(dim=-1)
    if second.means is not None:  # short intervals show the swing of the vibration
        force_n = torch.bmm(epoch.window.end.C_nb, mean[:, :3].unsqueeze(-1)).squeeze(-1)
        gained, turn = force_n[:, :2].norm(dim=-1), mean[:, 3:].norm(dim=-1)
    doubt = 2 * acceleration_std(P, epoch.window.end.C_nb)
    unlearned = before.standing.isinf() & before.moving.isinf()
    doubt = torch.where(unlearned, doubt.clamp_max(UNLEARNED_ACCEL), doubt)
    straight = turn < STILL_RATE + 2 * diagonal[:, GYRO].sum(-1).sqrt()
    force, force_now = (x[:, :2] + epoch.imu_error[:, :2] for x in (whole, mean))
    doubt = torch.where(before.rest.is_changing(force_now), 0.0, doubt)
    straight = straight & ~before.rest.has_changed(force)
    still, still_long = (straight & (gained < limit + doubt) for limit in (STILL_ACCEL, LONG_ACCEL))
    fixed, with_velocity = epoch.used[:, :2].all(-1), epoch.used[:, 3:5].all(-1)
    exact = fixed & (epoch.fix.std[:, :2].amax(-1) < CARRIER_STD)
    sure = (with_velocity | exact) & (std < SURE_STD)
    rest = before.rest.meet_fix(epoch, with_velocity, still)
    creeps = rest.creeps()
    standing, moving = sure & (speed + std < STANDING_SPEED) & ~creeps, sure & (speed - std > MOVING_SPEED)
    if wheel is not None:
        stopped = wheel.stopped & still
        standing, moving = standing & ~wheel.rolling | stopped, (moving | wheel.rolling) & ~stopped
    still_s = torch.where(still, before.still_s + span, 0.0)
    position_alone = fixed & ~with_velocity & ~exact
    positions, at_rest, in_motion = before.span.update(epoch, position_alone, level, speed > MOVING_SPEED, still)
    at_rest = torch.where(standing, level, math.inf).minimum(at_rest)
    in_motion = torch.where(moving, level, math.inf).minimum(in_motion)
    after = before.update(at_rest, in_motion, span)._replace(still_s=still_s, span=positions, second=second)
    # like spectra: a wide 1σ would admit any speed, so only a speed that is nearly zero and known to be counts
    limit, distinct, surely = after.thresholds(prior)
    calm = level <= limit
    calm_s = torch.where(still, (before.calm_s + torch.where(calm, span, -span)).clamp_min(0.0), 0.0)
    resting = still_long & surely & (level <= after.resting_limit()) & ~after.moving.isinf()
    rest_s = torch.where(resting, before.rest_s + span, 0.0)
    after = after._replace(calm_s=calm_s, rest_s=rest_s)
    learned = ~(after.standing.isinf() & after.moving.isinf())
    between = surely & (level > after.resting_limit()) & ~after.standing.isinf()
    least = torch.where(between, CREEPING_LEVEL_SPEED, PLAUSIBLE_SPEED)
    slow = (speed < least) & (still_s > LEAST_S - 0.5 * span)
    fastest = least + torch.where(between, std, _speed_doubt(std, learned & distinct, learned & surely))
    plausible = (speed < fastest) & (calm_s > DOUBTFUL_S - 0.5 * span)
    long = (speed < (LONG_SIGMAS * std).clamp_max(LONG_SPEED)) & (rest_s > LONG_S - 0.5 * span)
    stationary = calm & still & (slow | plausible) | long
    proven = sure & still & (still_s > PROVEN_S - 0.5 * span) & (speed + 2 * std < PROVEN_SPEED)
    stationary = (stationary | proven) & ~creeps
    if wheel is not None:
        stationary = stationary & ~wheel.rolling | stopped
    return stationary, after._replace(rest=rest.update(force, stationary, span)), variance


def _speed_doubt(
    std: Float[Tensor, " B"], distinct: Bool[Tensor, " B"], surely: Bool[Tensor, " B"]
) -> Float[Tensor, " B"]:
    """What of a stationary car's speed [m/s] its 1σ may explain, by how the samples separate rest and motion."""
    doubt = torch.where(distinct, (2 * std).clamp_max(DOUBTFUL_SPEED), std.clamp_max(SILENT_STD))
    return torch.where(surely, PLAUSIBLE_SIGMAS * std, doubt)


def acceleration_std(
    P: Float[Tensor, "B n n"], C_nb: Float[Tensor, "B 3 3"], force_n: Float[Tensor, "B 3"] | None = None
) -> Float[Tensor, " B"]:
    """1σ of the horizontal acceleration [m/s²], δa = f × δh + C ε: tilt and bias may cancel each other.

    Without a specific force, that of a car that hardly accelerates.
    """
    g = NOMINAL_GRAVITY
    of_attitude = C_nb.new_tensor(((0.0, g, 0.0), (-g, 0.0, 0.0))).expand(len(C_nb), 2, 3)
    if force_n is not None:
        of_attitude = skew(force_n)[:, :2]
    J, wrong = torch.cat((of_attitude, C_nb[:, :2]), -1), slice(ATTITUDE.start, ACCEL.stop)
    return torch.einsum("bij,bjk,bik->b", J, P[:, wrong, wrong], J).clamp_min(0.0).sqrt()
