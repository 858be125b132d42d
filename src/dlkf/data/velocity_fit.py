"""Velocity of the antenna at epoch boundaries: the receiver's, or one fitted to its positions.

A receiver without velocities has them fitted to the positions of :data:`FIT_S`, and so has one that gives them with no
more than half of these positions, or with a 1σ that says that they are unknown. With north + i east as one complex
number and α(t) the yaw from the boundary back to t by the gyroscopes, a car that does not slip has the velocity
v(t) = e^{iα(t)} (z − w τ), τ = t_end − t, so

    p(t) = p_end − z ∫ e^{iα} dτ + w ∫ τ e^{iα} dτ,

which is linear in position, velocity z and acceleration w at the boundary; w has a prior of :data:`ACCELERATION_STD`,
so that coarse positions are fitted by a constant speed and fine ones by an accelerated motion. A fix that lies before
its boundary is one of an earlier τ, up to which the car turns evenly.

Positions may be wrong by more than they claim. Outliers are left out by data snooping (Baarda 1968): the largest of
the residuals over their own 1σ, eᵢ / (σᵢ √(1 − hᵢ)) with h the diagonal of the hat matrix, where it is beyond
``OUTLIER_SIGMAS``, also in units of what the other residuals scatter by. The 1σ of what is found grows with that
scatter (Birge ratio).

The car moves where it does so by the velocity before too: that of a second before, of a slow receiver or where fixes
are missing the last of :data:`REACH_S`. A receiver's velocity is an outlier where it differs from the one before,
turned with the gyroscopes, by more than a car changes it. Their second
differences show how much they scatter: E|vₖ − 2 vₖ₋₁ + vₖ₋₂|² = 12 σ² for white noise of σ per axis, of which the
median is ln 2 times as large. How much the positions beside them do, differences from the way by the velocities show:
E|pₖ − pₖ₋₁ − ½ (vₖ + vₖ₋₁) Δt|² = 4 σ² + (σᵥ Δt)².
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from dlkf.data.drive import Drive

UNKNOWN_VELOCITY_STD, UNKNOWN_SLOPE_STD = 0.2, 0.05  # m/s and slope of the road, where v_d is not measured
FIT_S = 5.0  # of positions to which a velocity is fitted
ACCELERATION_STD = 1.0  # m/s², of a car
GYRO_BIAS_STD = 0.01  # rad/s, that turns the positions of a window about its end
FIT_STD = 0.1  # m: how far a car keeps from the fit's motion
OUTLIER_SIGMAS = 5.0  # of a position among those of a fit
MOST_OUTLIERS = 3  # of a fit
LEAST_SHARE = 1e-3  # of 1 − h
OVERDETERMINED = 5  # components more than unknowns, without which no outlier is looked for
MOTION_SIGMAS = 2.0  # of a velocity: less is no motion
CONFIRMED_S = 1.0  # that a motion has been one
REACH_S = FIT_S  # that a velocity may be older than the one it is compared with
CHANGE_SIGMAS, MOST_ACCELERATION = 3.0, 3.0  # σ and m/s² · time that two velocities of a receiver may differ by
NEEDED = f"velocities at most {REACH_S:g} s or positions at most {FIT_S / 2:g} s apart"  # for a start, in a message
READ_S = FIT_S + 2 * CONFIRMED_S  # before a boundary
JOLT_STD = 0.3  # m/s, that second differences of a car's velocity are taken for
LEAST_DIFFERENCES = 3  # that show a scatter
SECOND_DIFFERENCE = 12 * math.log(2)  # median of its square over the variance of an axis
LEAST_FITTED = 3  # positions that a velocity is fitted to
UNKNOWN_STD = 10.0  # m/s: a velocity of this 1σ or more is none
DIFFERENCE = 2 * math.log(2)  # the same of a difference of positions, over the variances of an axis at both ends


class AntennaVelocity(NamedTuple):
    """Velocity at the N+1 boundaries, in n; an unknown v_d is zero."""

    v_n: Float[Tensor, "rows 3"]  # m/s
    std: Float[Tensor, "rows 3"]
    given: Bool[Tensor, " rows"]  # a fix that says something of its horizontal part
    known: Bool[Tensor, " rows"]  # that part, and no outlier as far as that shows
    moving: Bool[Tensor, " rows"]  # not just noise, now and by the velocity before
    scatter: Float[Tensor, "rows 2"]  # Birge ratio ≥ 1 of positions, and the like of velocities
    off: Float[Tensor, " rows"]  # m, of the position at the boundary from the fit to the others
    lag: Float[Tensor, " rows"]  # s before the boundary: of the receiver's, that of its fix


def antenna_velocity(drive: Drive, C_en: Float[Tensor, "rows 3 3"], down_b: Float[Tensor, "rows 3"]) -> AntennaVelocity:
    """The receiver's velocity, or where it has few one fitted to positions; ``down_b``: n's down in b."""
    few = _few_velocities(drive)
    if torch.compiler.is_compiling() or not bool(few.any()):
        return _read_velocity(drive, C_en, down_b)
    fitted = _fit_velocity(drive, C_en, down_b)
    if bool(few.all()):
        return fitted
    read = _read_velocity(drive, C_en, down_b)
    return AntennaVelocity(*(torch.where(few[:, None] if x.dim() > 1 else few, x, y) for x, y in zip(fitted, read)))


def _few_velocities(drive: Drive) -> Bool[Tensor, " rows"]:
    """Boundaries before which there are enough fixes in ``FIT_S``, and no more than half of them have a velocity."""
    position = drive.gnss_valid[:, :3].all(-1)
    given = position & drive.gnss_valid[:, 3:5].all(-1) & (drive.gnss_std[:, 3:5].amax(-1) < UNKNOWN_STD)
    back = max(2, round(FIT_S / drive.epoch_s)) + 1
    counts = pad(torch.stack((position, given)).to(torch.int64).cumsum(-1), (back, 0))
    positions, velocities = counts[:, back:] - counts[:, :-back]
    return (positions >= LEAST_FITTED) & (2 * velocities <= positions)


def _read_velocity(drive: Drive, C_en: Float[Tensor, "rows 3 3"], down_b: Float[Tensor, "rows 3"]) -> AntennaVelocity:
    """The receiver's, where it is no outlier."""
    known = drive.gnss_valid[:, 3:]
    v_n = torch.where(known, (C_en.mT @ drive.gnss_v_e.unsqueeze(-1)).squeeze(-1), 0.0)
    std = torch.where(known, drive.gnss_std[:, 3:], _vertical_std(v_n).unsqueeze(-1))
    level, noise = torch.complex(v_n[:, 0], v_n[:, 1]), std[:, :2].amax(-1)
    yaw = _yaw(drive, down_b)
    turn = torch.polar(torch.ones_like(yaw), yaw)
    given = known[:, :2].all(-1) & drive.gnss_valid[:, :3].all(-1)
    before = _last_confirming(drive, given)
    change = (level / turn - (level / turn)[before]).abs()
    apart = drive.epoch_s * (torch.arange(len(given)) - before)
    most = CHANGE_SIGMAS * torch.hypot(noise, noise[before]) + MOST_ACCELERATION * apart
    agrees = given & ((change <= most) | (before < 0))
    scatter = _scatter_of_velocities(drive, level / turn, given, noise)
    std[:, :2] = scale_std(std[:, :2], scatter[:, None], JOLT_STD)
    moving = _confirm_motion(agrees & (level.abs() > MOTION_SIGMAS * std[:, :2].amax(-1)), before)
    both = torch.stack((_scatter_of_positions(drive, C_en, v_n, given, noise, scatter), scatter), -1)
    return AntennaVelocity(v_n, std, given, agrees, moving, both, torch.zeros_like(scatter), drive.gnss_lag)


def _scatter_of_velocities(
    drive: Drive, level: Tensor, given: Bool[Tensor, " rows"], noise: Float[Tensor, " rows"]
) -> Float[Tensor, " rows"]:
    """By the second differences of the ``FIT_S`` before a boundary of velocities ``level`` (rows,) turned back with the
    gyroscopes; 1 where they are few."""
    one = _count_confirming(drive)
    if len(given) <= 2 * one:
        return torch.ones_like(noise)
    square = (level[2 * one :] - 2 * level[one:-one] + level[: -2 * one]).abs().square()
    square = square / (SECOND_DIFFERENCE * (noise[2 * one :].square() + JOLT_STD**2))
    square = torch.where(given[2 * one :] & given[one:-one] & given[: -2 * one], square, torch.inf)
    return _root_of_median(_unfold_last(square, drive))


def _scatter_of_positions(
    drive: Drive, C_en: Float[Tensor, "rows 3 3"], v_n: Tensor, given: Bool[Tensor, " rows"],
    noise: Float[Tensor, " rows"], scatter: Float[Tensor, " rows"],
) -> Float[Tensor, " rows"]:  # fmt: skip
    """By the differences of the ``FIT_S`` before a boundary of positions from the way by velocities, whose 1σ ``noise``
    scatters so much there."""
    h, one = drive.epoch_s, _count_confirming(drive)
    if len(given) <= one:
        return torch.ones_like(noise)
    step = (C_en[one:].mT @ (drive.gnss_r_e[one:] - drive.gnss_r_e[:-one])[..., None])[:, :2, 0]
    late = drive.gnss_lag[:, None] * v_n[:, :2]
    between = v_n[:, :2].unfold(0, one + 1, 1)
    way = h * (between.sum(-1) - 0.5 * (between[..., 0] + between[..., -1])) + late[:-one] - late[one:]
    square = torch.where(given.unfold(0, one + 1, 1).all(-1), (step - way).square().sum(-1), torch.inf)
    of_position = drive.gnss_std[:, :2].amax(-1).square() + FIT_STD**2
    of_position, of_velocity = (_unfold_last(x[one:] + x[:-one], drive) for x in (of_position, noise.square()))
    scattered = scale_std(of_velocity.sqrt(), scatter[:, None], 2**0.5 * JOLT_STD).square()
    variance = DIFFERENCE * (of_position + (0.5 * h * one) ** 2 * scattered)
    return _root_of_median(_unfold_last(square, drive) / variance)


def _unfold_last(x: Float[Tensor, " n"], drive: Drive) -> Float[Tensor, "rows k"]:
    """Those of the ``FIT_S`` before each boundary; the last n boundaries have one."""
    count = max(2, round(FIT_S / drive.epoch_s))
    return pad(x, (count + drive.epochs + 1 - len(x), 0), value=torch.inf).unfold(0, count + 1, 1)


def _root_of_median(square: Float[Tensor, "rows k"]) -> Float[Tensor, " rows"]:
    """At least 1; 1 where few are finite."""
    values, found = square.nan_to_num(nan=torch.inf).sort(-1).values, square.isfinite().sum(-1)
    median = values.gather(-1, ((found - 1).clamp_min(0) // 2)[:, None])[:, 0]
    return torch.where(found >= LEAST_DIFFERENCES, median, 1.0).clamp_min(1.0).sqrt()


def _count_confirming(drive: Drive) -> int:
    """Epochs after which a motion is confirmed."""
    return max(1, min(round(CONFIRMED_S / drive.epoch_s), drive.epochs))


def latest_before(given: Bool[Tensor, " rows"], least: int, most: int) -> Int[Tensor, " rows"]:
    """The latest given boundary from ``least`` to ``most`` before each, −1 where there is none."""
    rows = torch.arange(len(given))
    last = pad(torch.where(given, rows, -1).cummax(0).values, (least, 0), value=-1)[: len(given)]
    return torch.where(last >= rows - max(least, most), last, -1)


def _last_confirming(drive: Drive, given: Bool[Tensor, " rows"]) -> Int[Tensor, " rows"]:
    return latest_before(given, _count_confirming(drive), round(REACH_S / drive.epoch_s))


def _confirm_motion(moves: Bool[Tensor, " rows"], before: Int[Tensor, " rows"]) -> Bool[Tensor, " rows"]:
    return moves & moves[before] & (before >= 0)


def _yaw(drive: Drive, down_b: Float[Tensor, "rows 3"]) -> Float[Tensor, " rows"]:
    """Yaw at the boundaries since the first, by the gyroscopes."""
    turned = (drive.imu[..., 3:].double().mean(1) * down_b[1:]).sum(-1) * drive.epoch_s
    return pad(turned.cumsum(0), (1, 0))


def scale_std(
    std: Float[Tensor, "*rows k"], scatter: Float[Tensor, "*rows #k"], floor: float | Sequence[float] = FIT_STD
) -> Float[Tensor, "*rows k"]:
    """1σ of positions [m], with ``JOLT_STD`` of velocities, that scatter so much; the claimed one where that is 1."""
    return (std.square() + (scatter.square() - 1) * (std.square() + std.new_tensor(floor).square())).sqrt()


def _vertical_std(v_n: Tensor) -> Tensor:
    """1σ of a vertical velocity that nothing measures."""
    return UNKNOWN_VELOCITY_STD + UNKNOWN_SLOPE_STD * v_n[:, :2].norm(dim=-1)


def _fit_velocity(drive: Drive, C_en: Float[Tensor, "rows 3 3"], down_b: Float[Tensor, "rows 3"]) -> AntennaVelocity:
    """Fitted to the positions of ``FIT_S`` before a boundary, three at least; its std grows with what an unknown
    gyroscope bias turns the fit by."""
    h, rows = drive.epoch_s, drive.epochs + 1
    usable = drive.gnss_valid[:, :3].all(-1)
    count = max(2, min(round(FIT_S / h), rows - 1))
    before = torch.arange(rows)[:, None] - torch.arange(count + 1)  # boundary, epochs back
    fixed = usable[before.clamp_min(0)] & (before >= 0) & usable[:, None]
    course, lag = _yaw(drive, down_b), drive.gnss_lag[before.clamp_min(0)]
    yaw, turned = course[before.clamp_min(0)] - course[:, None], pad(course.diff(), (1, 0))[before.clamp_min(0)]
    heading, then = torch.polar(torch.ones_like(yaw), yaw), torch.polar(torch.ones_like(yaw), yaw - turned * lag / h)
    tau = h * torch.arange(count + 1, dtype=torch.float64)
    middle, late = 0.5 * (heading[:, 1:] + heading[:, :-1]) * h, 0.5 * (heading + then) * lag
    way = pad(middle.cumsum(-1), (1, 0)) + late
    slowed = pad((middle * 0.5 * (tau[1:] + tau[:-1])).cumsum(-1), (1, 0)) + late * (tau + 0.5 * lag)
    tau = tau + lag
    r_e = drive.gnss_r_e[before.clamp_min(0)] - drive.gnss_r_e.unsqueeze(1)
    r_n = torch.where(fixed[..., None], (C_en.mT.unsqueeze(1) @ r_e.unsqueeze(-1))[..., 0], 0.0)
    std = torch.hypot(drive.gnss_std[:, :3].amax(-1), torch.tensor(FIT_STD))[before.clamp_min(0)]
    weight = torch.where(fixed, std.square().reciprocal(), 0.0)

    # 1e-9: boundaries without fixes, whose matrix would be singular
    prior = torch.tensor([1e-9, 1e-9, ACCELERATION_STD**-2], dtype=torch.float64).expand(rows, -1)
    x, y = torch.stack((torch.ones_like(way), -way, slowed), -1), torch.complex(r_n[..., 0], r_n[..., 1])
    for _ in range(MOST_OUTLIERS):
        weight = _reject_outlier(x, y, weight, prior)
    fixed = weight > 0
    fit = _fit(x, y, weight, prior)
    # − 2: the fewer they are, the less certain is what they scatter by
    scatter = (fit.squares.sum(-1) / (_redundancy(weight) - 2).clamp_min(1)).clamp_min(1.0).sqrt()
    velocity, spread = fit.found[:, 1], scatter * fit.covariance[:, 1, 1].real.sqrt()
    spread = torch.hypot(spread, 0.5 * GYRO_BIAS_STD * (tau * fixed).amax(-1) * velocity.abs())
    v_n = torch.stack((velocity.real, velocity.imag, torch.zeros_like(spread)), -1)
    slope, level = _vertical_std(v_n), torch.stack((torch.ones_like(tau), -tau), -1)
    down = _fit(level, r_n[..., 2], weight, torch.stack((torch.full_like(slope, 1e-9), slope**-2), -1))
    v_n[:, 2] = down.found[:, 1]

    moves = fixed[:, 0] & (fixed.sum(-1) >= LEAST_FITTED) & (velocity.abs() > MOTION_SIGMAS * spread)
    moving = _confirm_motion(moves, _last_confirming(drive, usable))
    one = torch.ones_like(scatter)
    off = (x[:, :1] @ fit.found.unsqueeze(-1))[:, 0, 0].abs() / (1 - fit.own[:, 0]).clamp_min(LEAST_SHARE)
    return AntennaVelocity(
        v_n,
        torch.stack((spread, spread, down.covariance[:, 1, 1].sqrt()), -1),
        usable,
        moving,
        moving,
        torch.stack((scatter, one), -1),
        off,
        torch.zeros_like(off),
    )


class _Fit(NamedTuple):
    """Weighted least squares of y (rows, n) by x (rows, n, k)."""

    found: Tensor  # (rows, k)
    covariance: Tensor  # (rows, k, k)
    squares: Tensor  # (rows, n) of the residuals over their 1σ
    own: Tensor  # (rows, n) h, diagonal of the hat matrix


def _fit(x: Tensor, y: Tensor, weight: Tensor, prior: Tensor) -> _Fit:
    weighted = x.mH * weight.unsqueeze(1)
    covariance = torch.linalg.inv(weighted @ x + torch.diag_embed(prior).to(x.dtype))
    found = (covariance @ (weighted @ y.unsqueeze(-1)))[..., 0]
    squares = weight * (y - (x @ found.unsqueeze(-1))[..., 0]).abs().square()
    return _Fit(found, covariance, squares, weight * ((x @ covariance) * x.conj()).sum(-1).real)


def _redundancy(weight: Tensor) -> Tensor:
    """Components more than unknowns; of the acceleration's two, whose prior counts, one."""
    return 2 * (weight > 0).sum(-1) - 5


def _reject_outlier(x: Tensor, y: Tensor, weight: Tensor, prior: Tensor) -> Tensor:
    """Weights without the worst of the outliers."""
    fit, redundancy = _fit(x, y, weight, prior), _redundancy(weight)
    most, worst = (fit.squares / (1 - fit.own).clamp_min(LEAST_SHARE)).max(-1)
    others = ((fit.squares.sum(-1) - most) / (redundancy - 2).clamp_min(1)).clamp_min(1.0)
    outlier = (redundancy >= OVERDETERMINED) & (most > OUTLIER_SIGMAS**2 * others)
    return weight.masked_fill(outlier[:, None] & (torch.arange(weight.shape[1]) == worst[:, None]), 0.0)
