"""How a sensor sits in a car, and what goes with it: fine clock offset, scale of the gyroscopes, lever arm.

With the sensor levelled by gravity, h(t) the car's heading (integrated yaw rate, held to the course of GNSS) and
complex horizontal vectors, every interval between two fixes has

    Δv + g ∫ s e^{ih} dt = α ∫ e^{ih} (f + b) dt + λ Δ(i ω e^{ih}),

s the slope of the way, f the horizontal force in the sensor's axes: the argument of α turns these into forward and
right, |α| is one, b is what levelling by the mean left over, and λ the lever arm from IMU to antenna. This is linear
in (α, α b, λ); the clock offset is scanned for the least residuals. The course shows it too, yet it is no
heading:

    course = h + ω (l / v + K v),

l from the rear axle to the antenna and K the sideslip (−0.32 m and −0.0075 s²/m on a real car), which looks like a
delay of l/v + K v, some 0.1 s. So l and K are fitted, and taken out of the course that holds h. Pitch and
roll of a second or ten come from the gyroscopes; what is slower (drift of the tilt) is taken off both sides as a
moving mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.data.discovery.motion import MOVING, Complex, Floats, Levelled, Motion, integrate_level
from dlkf.navigation.earth import STANDARD_GRAVITY as G

SPAN_S, STEP_S = 0.6, 0.04  # of the first scan round the coarse lag; the next ones are in quarters of a step
BLOCKS = 8  # of the drive, left out one at a time (jackknife)
SMOOTH_S = 4.0  # over which course minus turn is averaged: sideslip and noise, not the drift of a gyroscope
FEWEST = 20  # intervals in motion
SLOW_ROWS = 4.0  # intervals (of about a second), 1σ of the mean that is taken off
LEVEL_STD = np.radians(0.8)  # of levelling: an accelerometer's bias of 0.1 m/s², the road's crown
AXIS_STD = np.radians(3.0)  # of the axis of turning, over the root of the turn [rad]: slopes, bumps, rolling in bends
YAW_FLOOR, LAG_FLOOR = np.radians(0.3), 0.003  # what leaving segments out does not show: rolling in bends, sideslip
SLIP_NOISE = 0.1  # m/s, of a change of course times speed: the weight of what is known of l and K


@dataclass(frozen=True)
class Pose:
    """``matrix`` takes the sensor's axes to Forward-Right-Down; stds by a jackknife over segments of the drive."""

    matrix: Floats
    yaw_std: float  # rad
    tilt_std: float
    scale: float  # |α|: one, or units do not agree
    lag_s: float
    lag_std: float
    gyro_scale: float  # rad per unit of the gyroscopes
    gyro_scale_std: float
    lever_arm: complex  # m, forward + i right
    lever_arm_std: float
    explained: float  # share of the variance of Δv
    turned: float  # rad, sum of what the car turned
    down_apart: float  # rad between gravity and the axis about which the car turns; NaN where it turns too little
    drift: float  # by which the IMU's clock runs faster than that of GNSS (1e-6: ppm), NaN where it is not observable
    drift_std: float
    doubt: float = 0.0  # a drift that may be there, though it is not certain enough to be taken off


@dataclass(frozen=True)
class _Intervals:
    t0: Floats
    t1: Floats
    dv: Complex
    slope: Complex
    turned: Floats  # change of course
    weight: Floats  # of the change of course
    v0: Floats
    v1: Floats
    moving: np.ndarray
    block: np.ndarray
    stride: int  # rows that overlap


@dataclass(frozen=True)
class _Fit:
    lag_s: float
    alpha: complex
    bias: complex  # of the horizontal force, in the levelled sensor's axes
    arm: complex
    scale: float
    rest: float
    total: float
    arm_std: float
    slip: tuple[float, float]  # l [m], K [s²/m]


class _Equations:
    """Those of a levelled sensor at any lag. Every block that is left out asks for the same lags: what they have in
    common is made once."""

    def __init__(self, level: Levelled, gnss: Motion, parts: _Intervals, slip: tuple[float, float]) -> None:
        self.level, self.gnss, self.parts, self.slip = level, gnss, parts, slip
        self._made: dict[float, tuple[Complex, Complex]] = {}

    def scan(self, lag_s: float, span: float, keep: np.ndarray) -> _Fit | None:
        """The fit of the lag with the least residuals, by a parabola round the best."""
        step = STEP_S if span > 0.3 else STEP_S / 4
        lags = lag_s + np.arange(-round(span / step), round(span / step) + 1) * step
        use = keep & self._is_covered(lags[0], lags[-1])
        if (use & self.parts.moving).sum() < FEWEST // 2:
            return None
        costs = np.array([self._residuals(lag, use)[-1] for lag in lags])
        lag = float(lags[costs.argmin()])
        near = np.abs(lags - lag) < (2.5 * STEP_S if span > 0.3 else 0.035)
        a, b, _ = np.polyfit(lags[near] - lag, costs[near], 2)  # shaking makes the residuals' minimum a ragged one
        if near.sum() > 3 and a > 0:
            lag += float(np.clip(-0.5 * b / a, -span, span))
        return self._fit(lag, use)

    def reject_outliers(self, lag: float) -> np.ndarray:
        """Intervals without outliers of GNSS: residuals at most five medians, of a fit to all."""
        use = self._is_covered(lag, lag)
        if not use.any():
            return use
        A, y, x, _ = self._residuals(lag, use)
        off = np.abs(y - A @ x)
        return off <= 5 * max(float(np.median(off[use])), 1e-3)

    def _is_covered(self, least: float, most: float) -> np.ndarray:
        """Intervals that lie inside the IMU's time at all lags from ``least`` to ``most``."""
        return (self.parts.t0 + least >= self.level.t[0]) & (self.parts.t1 + most <= self.level.t[-1])

    def _differences(self, values: np.ndarray, lag: float) -> np.ndarray:
        """What values at the limits of the samples gain in each interval."""
        t = self.level.t
        return np.interp(self.parts.t1 + lag, t, values) - np.interp(self.parts.t0 + lag, t, values)

    def _rates(self, at: Floats) -> Floats:
        """Yaw rate [rad/s] round times of the IMU, mean of 0.2 s."""
        t, turn = self.level.t, self.level.turn
        return (np.interp(at + 0.1, t, turn) - np.interp(at - 0.1, t, turn)) / 0.2

    def _design(self, lag: float, force: Complex, slope: float) -> tuple[Complex, Complex]:
        """Columns (α, α b, λ) and left side; ``slope`` 1 to take the way's slope from GNSS."""
        hold = np.exp(1j * self._heading_offset(lag))
        design = np.stack([hold * self._differences(x, lag) for x in (force, self.level.ones, self.level.swing)], -1)
        return design, self.parts.dv + slope * self.parts.slope

    def _heading_offset(self, lag: float) -> Floats:
        """Heading minus turn in the middle of the intervals: averaged over seconds, weighted by speed."""
        gnss, level = self.gnss, self.level
        rows = np.arange(len(gnss.t))[:: gnss.stride]
        rows = rows[gnss.speed[rows] > MOVING]
        t, speed = gnss.t[rows], gnss.speed[rows]
        beside = self._rates(t + lag) * (self.slip[0] / speed + self.slip[1] * speed)
        apart = np.exp(1j * (gnss.course[rows] - beside - np.interp(t + lag, level.t, level.turn)))
        weight = np.minimum(speed, 15.0) ** 2
        reach = max(1, round(2 * SMOOTH_S / max(float(np.median(np.diff(t))) if len(t) > 1 else 1.0, 0.1)))
        total = np.zeros(len(t), complex)
        for shift in range(min(reach + 1, len(t))):  # each row and the one so many behind it, of the same distance
            first, second = slice(len(t) - shift), slice(shift, None)
            near = np.exp(-0.5 * ((t[second] - t[first]) / SMOOTH_S) ** 2)
            total[first] += near * weight[second] * apart[second]
            if shift:
                total[second] += near * weight[first] * apart[first]
        return np.interp(0.5 * (self.parts.t0 + self.parts.t1), t, np.unwrap(np.angle(total)))

    def _residuals(self, lag: float, use: np.ndarray) -> tuple[Complex, Complex, Complex, float]:
        """Least squares at a lag, without the way's slope: design and left side of all rows, the solution, the squared
        sum of the rows in use."""
        if lag not in self._made:
            self._made[lag] = self._design(lag, self.level.tilted, 0.0)
        quick = _remove_slow(np.column_stack(self._made[lag]), use, self.parts.stride)
        A, y = quick[:, :-1], quick[:, -1]
        x, *_ = np.linalg.lstsq(A[use], y[use], rcond=None)
        return A, y, x, float(np.sum(np.abs(y[use] - A[use] @ x) ** 2)) + 1e-9

    def _bias(self, lag: float, use: np.ndarray) -> complex:
        """Mean horizontal force that is not the car's: what levelling left over, and the accelerometers' bias."""
        design, left = self._design(lag, self.level.force, 1.0)
        x, *_ = np.linalg.lstsq(design[use], left[use], rcond=None)
        return complex(x[1] / x[0]) if x[0] else 0j

    def _fit(self, lag: float, use: np.ndarray) -> _Fit:
        """All that is fitted at a lag."""
        parts = self.parts
        A, y, x, rest = self._residuals(lag, use)
        A, y = A[use], y[use]
        inverse = np.linalg.pinv(A.conj().T @ A)
        arm_std = float(np.sqrt(parts.stride * abs(inverse[2, 2]) * rest / max(len(y) - 3, 1)))
        turning = use & parts.moving
        rate0, rate1 = self._rates(parts.t0 + lag), self._rates(parts.t1 + lag)
        v0, v1 = np.maximum(parts.v0, MOVING), np.maximum(parts.v1, MOVING)
        turn = self._differences(self.level.turn, lag)
        columns = (turn, parts.t1 - parts.t0, rate1 / v1 - rate0 / v0, rate1 * v1 - rate0 * v0)
        B = np.column_stack(columns)[turning] * parts.weight[turning, None]
        z = parts.turned[turning] * parts.weight[turning]
        # what is known of cars: an antenna 2 m or so from the axle, sideslip of 0.01 s²/m
        prior = np.diag([0.0, 0.0, 1 / 2.0, 1 / 0.01]) * SLIP_NOISE
        s, *_ = np.linalg.lstsq(np.concatenate((B, prior)), np.concatenate((z, np.zeros(4))), rcond=None)
        return _Fit(
            lag, complex(x[0]), self._bias(lag, use), complex(x[2]), float(s[0]), rest,
            float(np.sum(np.abs(y) ** 2)), arm_std, (float(s[2]), float(s[3])),
        )  # fmt: skip


def find_pose(t: Floats, accel: Floats, gyro: Floats, gnss: Motion, lag_s: float) -> Pose | None:
    """Pose of a sensor with ``accel`` in m/s², ``gyro`` in any unit (n, 3), near a clock offset ``lag_s`` [s].

    None where the drive has too little motion.
    """
    parts = _intervals(gnss)
    if parts.moving.sum() < FEWEST * parts.stride:
        return None
    down = -accel.mean(0)
    down = down / np.linalg.norm(down)
    unit = _gyro_scale(t, gyro @ down, parts, lag_s)
    if unit is None:
        return None
    lag, fit, level, slip = lag_s, None, None, (0.0, 0.0)
    good = np.ones(len(parts.t0), bool)
    for span in (SPAN_S, 0.1, 0.06):
        level = integrate_level(t, accel, gyro * unit, down)
        equations = _Equations(level, gnss, parts, slip)
        good = equations.reject_outliers(lag)
        fit = equations.scan(lag, span, good)
        if fit is None:
            return None
        lag, unit, slip = fit.lag_s, unit * fit.scale, fit.slip
        tilt = fit.bias.real * level.axes[0] + fit.bias.imag * level.axes[1]
        down = level.axes[2] + np.clip(tilt / G, -0.2, 0.2)
        down /= np.linalg.norm(down)
    assert fit is not None and level is not None
    axis, turned = _axis(t, gyro, parts, lag)
    weight = turned / (turned + (AXIS_STD / LEVEL_STD) ** 2) if axis is not None else 0.0
    apart = float(np.arccos(np.clip(axis @ down, -1, 1))) if axis is not None else float("nan")
    if axis is not None and apart < np.radians(5.0):
        down = (1 - weight) * down + weight * axis
        down /= np.linalg.norm(down)
    final = _matrix(level, fit, down)
    leave, middles, equations = [], [], _Equations(level, gnss, parts, slip)
    for block in range(BLOCKS):
        keep = parts.block != block
        keep &= good
        if (keep & parts.moving).sum() >= FEWEST // 2 and (one := equations.scan(lag, 0.07, keep)):
            leave.append(one)
            middles.append(float(np.mean(parts.t0[~keep & good])) if (~keep & good).any() else np.nan)
    if len(leave) < BLOCKS // 2:
        return None
    drift, drift_std = _drift(np.array(middles), np.array([one.lag_s for one in leave]), lag)
    yaw_std = _jackknife(np.angle([one.alpha / fit.alpha for one in leave]))
    tilts = np.array([one.bias for one in leave], complex) / G
    tilt_std = float(np.hypot(_jackknife(tilts.real), _jackknife(tilts.imag)))
    arms: Complex = np.array([one.arm for one in leave], complex)
    arm_std = max(float(np.hypot(_jackknife(arms.real), _jackknife(arms.imag))), fit.arm_std)
    scale_std = unit * _jackknife(np.array([one.scale for one in leave]))
    explained = 1 - fit.rest / max(fit.total, 1e-9)
    floor = LEVEL_STD * np.sqrt(1 - weight)
    return Pose(
        matrix=final,
        yaw_std=float(np.hypot(yaw_std, YAW_FLOOR)),
        tilt_std=float(np.hypot((1 - weight) * tilt_std, floor)),
        scale=abs(fit.alpha),
        lag_s=lag,
        lag_std=float(np.hypot(_jackknife(np.array([one.lag_s for one in leave])), LAG_FLOOR)),
        gyro_scale=float(unit),
        gyro_scale_std=float(scale_std),
        lever_arm=fit.arm,
        lever_arm_std=arm_std,
        explained=float(explained),
        turned=turned,
        down_apart=apart,
        drift=drift,
        drift_std=drift_std,
    )


def _drift(middles: Floats, left_out: Floats, lag_s: float) -> tuple[float, float]:
    """Slope of the lag over time and its 1σ, by the jackknife's pseudo-values n θ − (n − 1) θ₋ₖ: each a block's."""
    own = (len(left_out) - 1) * (lag_s - left_out)  # from the whole's: a lag of decades has lost its microseconds
    seen = np.isfinite(middles)
    if seen.sum() < BLOCKS // 2:
        return float("nan"), float("nan")
    t = middles[seen] - middles[seen].mean()
    slope = float(t @ own[seen] / (t @ t))
    off = own[seen] - own[seen].mean() - slope * t
    return slope, float(np.sqrt(off @ off / (len(t) - 2) / (t @ t)))


def _intervals(gnss: Motion) -> _Intervals:
    first, last = gnss.intervals(overlapping=True)  # of fast fixes each one's noise is averaged over all phases
    t0, t1 = gnss.t[first], gnss.t[last]
    slow = np.minimum(gnss.speed[first], gnss.speed[last])
    moving = slow > MOVING
    mean = gnss.v[first] + gnss.v[last]
    along = mean / np.maximum(np.abs(mean), 1e-9)
    slope = G * 0.5 * (gnss.climb[first] + gnss.climb[last]) * (t1 - t0) * along
    turned = wrap_angle(gnss.course[last] - gnss.course[first])
    block = np.minimum((BLOCKS * np.arange(len(t0))) // max(len(t0), 1), BLOCKS - 1)
    dv = gnss.v[last] - gnss.v[first]
    v0, v1 = gnss.speed[first], gnss.speed[last]
    slopes = np.where(moving, slope, 0.0)
    weight, overlap = np.minimum(slow, 15.0), round(gnss.stride / gnss.phase)
    return _Intervals(t0, t1, dv, slopes, turned, weight, v0, v1, moving, block, overlap)


def _gyro_scale(t: Floats, rate: Floats, parts: _Intervals, lag_s: float) -> float | None:
    """Radians per unit of the gyroscopes: slope of change of course over integrated rate, at the coarse lag."""
    use, (turn,) = _turns(t, rate[:, None], parts, lag_s)
    if use.sum() < FEWEST // 2:
        return None
    span = (parts.t1 - parts.t0)[use]
    w = parts.weight[use]
    design = np.column_stack((turn, span)) * w[:, None]
    keep = np.ones(len(w), bool)
    slope = 0.0
    for _ in range(3):
        if np.ptp(design[keep, 0]) == 0:
            return None
        (slope, bias), *_ = np.linalg.lstsq(design[keep], (parts.turned[use] * w)[keep], rcond=None)
        off = np.abs(parts.turned[use] * w - design @ [slope, bias])
        keep = off <= 4 * max(float(np.median(off[keep])), 1e-4)
    return float(slope) if slope > 0 else None


def _turns(t: Floats, rates: Floats, parts: _Intervals, lag_s: float) -> tuple[np.ndarray, list[Floats]]:
    """Intervals in motion within the IMU's time, and what the integral of each of the rates (n, k) gains in them."""
    use = parts.moving & (parts.t0 + lag_s >= t[0]) & (parts.t1 + lag_s <= t[-1])
    first, last = parts.t0[use] + lag_s, parts.t1[use] + lag_s
    angles = [np.concatenate(([0.0], np.cumsum(rate[1:] * np.diff(t)))) for rate in rates.T]
    return use, [np.interp(last, t, angle) - np.interp(first, t, angle) for angle in angles]


def _remove_slow(columns: Complex, use: np.ndarray, stride: int) -> Complex:
    """Columns less their mean over ``SLOW_ROWS`` round each row, of the rows in use: tilt drifts, cars do not wait."""
    from scipy.ndimage import gaussian_filter1d

    weight, rows = use.astype(float), SLOW_ROWS * stride
    share = np.maximum(gaussian_filter1d(weight, rows, mode="constant"), 1e-6)
    masked = (columns * weight[:, None]).view(float)  # real and imaginary parts side by side
    slow = gaussian_filter1d(masked, rows, axis=0, mode="constant").view(complex)
    return columns - slow / share[:, None]


def _matrix(level: Levelled, fit: _Fit, down: Floats) -> Floats:
    a = fit.alpha / abs(fit.alpha)
    e1, e2, _ = level.axes
    forward = a.real * e1 - a.imag * e2
    forward = forward - down * (forward @ down)
    forward /= np.linalg.norm(forward)
    return np.stack((forward, np.cross(down, forward), down))


def _axis(t: Floats, gyro: Floats, parts: _Intervals, lag: float) -> tuple[Floats | None, float]:
    """The axis about which the gyroscopes turn with the course, and by how much they did [rad]; None below 1.5."""
    use, turns = _turns(t, gyro, parts, lag)
    turned, span = parts.turned[use], (parts.t1 - parts.t0)[use]
    much = float(np.sum(np.abs(turned[np.abs(turned) > 0.05])))
    x, *_ = np.linalg.lstsq(np.column_stack((turned, span)), np.stack(turns, -1), rcond=None)
    size = float(np.linalg.norm(x[0]))
    return (x[0] / size, much) if much > 1.5 and size > 0 else (None, much)


def _jackknife(values: np.ndarray) -> float:
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.sum((values - values.mean()) ** 2))) if n > 1 else float("inf")
