"""The offset between the clocks of an IMU and of GNSS, of any size: yaw rate and horizontal force against GNSS.

The yaw rate about the vertical against the change of course, and the horizontal force as a complex number (whose
argument in the sensor's axes is not known) against the acceleration along and across the course, are correlated over
all lags at which the logs overlap, by FFT. Neither needs units or pose. Then Λ = −n/2 ln(1 − ρ²) of the one
plus −n ln(1 − |ρ|²) of the other is the gain in log-likelihood over no connection at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlkf.base.angles import wrap_angle
from dlkf.data.discovery.motion import MOVING, RESTING, Complex, Floats, Motion
from dlkf.data.readers.units import WEEK_S
from dlkf.data.schema import ACCEL, GYRO, stack_columns
from dlkf.data.tables import Columns
from dlkf.navigation.earth import STANDARD_GRAVITY

STEP_S = 0.25
LEAST_S = 20.0  # of common time in intervals with a known course
NEIGHBOUR_S = 3.0  # lags this close belong to one peak
LEAST_VARIANCE = 1e-3  # of the whole, that a stretch in which a signal hardly changes is taken to have
FARTHEST_ZONE_H = 14.1  # Kiribati's
YEAR_S = 31_557_600.0
KNOWN_OFFSETS = {18.0: "leap seconds of GPS against UTC", 37.0: "TAI against UTC", 19.0: "TAI against GPS"}
KNOWN_OFFSETS |= {315_964_782.0: "seconds since 1970 in UTC against GPS seconds since 1980"}


@dataclass(frozen=True)
class Lag:
    """``lag_s`` is added to GNSS stamps to give those of the IMU; ``gain`` its Λ, ``rival`` the next best peak's.

    ``peak_s`` is the same between the steps of the search, by a parabola through the peak of Λ.
    """

    lag_s: float
    gain: float
    rival: float
    yaw: float  # correlation of the yaw rate with the course at the lag
    force: float  # of the horizontal force with the acceleration
    angle: float  # rad, by which the sensor's x axis points to the right of the direction of travel
    peak_s: float

    @property
    def clear(self) -> bool:
        """No other lag explains nearly as much."""
        strong = self.gain > 25.0 and (self.yaw > 0.5 or self.force > 0.5)
        return strong and self.rival < 0.6 * self.gain and self.gain - self.rival > 15.0

    @property
    def certain(self) -> bool:
        """Clear, and both correlations agree, one of them well."""
        return self.clear and min(self.yaw, self.force) >= 0.6 and max(self.yaw, self.force) >= 0.85


@dataclass(frozen=True)
class ImuSums:
    """Running integrals over an IMU log, from which the means over any stretch of it follow: (n, 7) at the stamps
    ``t`` of time without gaps, specific force and rate, in any units and axes."""

    t: Floats
    sums: Floats

    @staticmethod
    def of(t: Floats, accel: Floats, gyro: Floats) -> ImuSums:
        """Of samples (n, 3)."""
        step = np.diff(t, prepend=t[:1])
        step = np.where(step > 1.0, 0.0, step)
        sums = np.empty((len(t), 7))
        np.cumsum(step, out=sums[:, 0])
        for k, axis in enumerate((*accel.T, *gyro.T), 1):
            np.cumsum(axis * step, out=sums[:, k])
        return ImuSums(t, sums)

    @staticmethod
    def of_table(imu: Columns) -> ImuSums:
        """Of the samples of a drive."""
        return ImuSums.of(imu["t"], stack_columns(imu, ACCEL), stack_columns(imu, GYRO))

    def between(self, first_s: float, last_s: float) -> ImuSums:
        """The part within these times."""
        part = slice(*np.searchsorted(self.t, (first_s, last_s)))
        return ImuSums(self.t[part], self.sums[part])

    def interpolate(self, at: Floats) -> Floats:
        """The integrals (m, 7) at given times, linear between samples."""
        i = np.clip(np.searchsorted(self.t, at, side="right") - 1, 0, len(self.t) - 2)
        share = np.clip((at - self.t[i]) / (self.t[i + 1] - self.t[i]), 0.0, 1.0)
        before = self.sums.take(i, 0)
        return before + share[:, None] * (self.sums.take(i + 1, 0) - before)


def find_lag(imu: ImuSums, gnss: Motion, within_s: float | None = None) -> Lag | None:
    """The lag of the best agreement, at most ``within_s`` from zero; None where the drive is too short or too even.

    The vertical is the mean of the specific force.
    """
    first, last = gnss.intervals()
    if len(first) < 5 or len(imu.t) < 10:
        return None
    known, rate, pull = _gnss_signals(gnss, first, last)
    if known.sum() < 5:
        return None
    usual = float(np.median(gnss.t[last] - gnss.t[first]))
    yaw, force, there, start = _imu_signals(imu, usual)
    middle = 0.5 * (gnss.t[first] + gnss.t[last])[known]
    cell = np.round((middle - middle[0]) / STEP_S).astype(int)
    n = int(cell[-1]) + 1
    weight, r, a = np.zeros(n), np.zeros(n), np.zeros(n, complex)
    weight[cell], r[cell], a[cell] = 1.0, rate[known], pull[known]
    yaws, count = correlate(r, weight, yaw, there)
    alike, _ = correlate(a, weight, force, there)
    yaws, forces = np.clip(yaws, -0.9999, 0.9999), np.clip(np.abs(alike), 0.0, 0.9999)
    gain = -0.5 * count * np.log1p(-(np.maximum(yaws, 0.0) ** 2)) - count * np.log1p(-(forces**2))
    gain = np.where(count > 3, gain, 0.0)
    lags = (np.arange(len(gain)) - (n - 1)) * STEP_S + start - middle[0]
    allowed = count * usual >= LEAST_S
    if within_s is not None:
        allowed &= np.abs(lags) <= within_s
    if not allowed.any():
        return None
    gain = np.where(allowed, gain, -np.inf)
    best = int(gain.argmax())
    others = np.where(np.abs(lags - lags[best]) > NEIGHBOUR_S, gain, -np.inf)
    rival = int(others.argmax())
    other = float(others[rival]) if np.isfinite(others[rival]) else 0.0
    peak = lags[best] + STEP_S * find_peak(gain[best - 1 : best + 2])
    numbers = (lags[best], gain[best], other, yaws[best], forces[best], -np.angle(alike[best]), peak)
    return Lag(*(float(x) for x in numbers))


def compute_misfits(imu: ImuSums, gnss: Motion, lags: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """The middles of the fixes' intervals, and the squares of what yaw rate and horizontal force miss of GNSS there,
    each of its mean square, with ``lags`` of the middles added to the stamps of GNSS."""
    first, last = gnss.intervals()
    known, rate, pull = _gnss_signals(gnss, first, last)
    yaw, force, there, start = _imu_signals(imu, float(np.median(gnss.t[last] - gnss.t[first])))
    middle = 0.5 * (gnss.t[first] + gnss.t[last])[known]
    cell = (middle + lags(middle) - start) / STEP_S
    grid = np.arange(len(there))
    inside = np.interp(cell, grid, there, left=0.0, right=0.0) > 0.99
    out = np.zeros(len(middle))
    for own, other in ((yaw, rate[known]), (force, pull[known])):
        x, y = np.asarray(np.interp(cell, grid, own))[inside], other[inside]
        gain = np.vdot(x, y) / max(float(np.vdot(x, x).real), 1e-12)
        out[inside] += np.abs(y - gain * x) ** 2 / max(float(np.mean(np.abs(y) ** 2)), 1e-12)
    return middle, out


def find_peak(three: Floats) -> float:
    """Where the parabola through three values has its peak, in steps from the middle one."""
    if len(three) < 3 or not np.isfinite(three).all():
        return 0.0
    bend = three[0] - 2 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def describe_offset(lag_s: float) -> str:
    """What an offset is known for."""
    weeks = round(lag_s / WEEK_S)
    rest = lag_s - weeks * WEEK_S
    if weeks and abs(rest) < 40:
        return f"; {weeks} GPS weeks" + (f" and {rest:.1f} s" if abs(rest) > 0.5 else "")
    for known, name in KNOWN_OFFSETS.items():
        if abs(abs(lag_s) - known) < 0.5:
            return f"; {name}"
    hours = lag_s / 3600
    if abs(lag_s) > YEAR_S:
        return "; one of the clocks has no date"
    if 0.9 < abs(hours) < FARTHEST_ZONE_H and abs(hours - round(hours * 4) / 4) * 3600 < 40:
        return f"; a time zone of {round(hours * 4) / 4:+g} h"
    return ""


def _gnss_signals(gnss: Motion, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, Floats, Complex]:
    """Which intervals count, their rate of turn [rad/s], and acceleration forward + i right [m/s²]."""
    span = gnss.t[last] - gnss.t[first]
    slow = np.minimum(gnss.speed[first], gnss.speed[last])
    moving, resting = slow > MOVING, np.maximum(gnss.speed[first], gnss.speed[last]) < RESTING
    turned = wrap_angle(gnss.course[last] - gnss.course[first])
    rate = np.where(moving, turned / span, 0.0)
    mean = gnss.v[first] + gnss.v[last]
    along = np.where(np.abs(mean) > 0.5, mean / np.maximum(np.abs(mean), 1e-9), 1.0)
    slope = 0.5 * (gnss.climb[first] + gnss.climb[last])
    pull = (gnss.v[last] - gnss.v[first]) / span * np.conj(along) + STANDARD_GRAVITY * slope
    return moving | resting, rate, np.where(moving, pull, 0.0)


def _imu_signals(imu: ImuSums, width_s: float) -> tuple[Floats, Complex, Floats, float]:
    """Yaw rate and horizontal force as means over ``width_s`` on a grid, where there are any, and the grid's start."""
    up = imu.sums[-1, 1:4] - imu.sums[0, 1:4]
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    helper = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]  # x, so that angles count from it
    e1 = helper - up * (helper @ up)
    e1 /= np.linalg.norm(e1)
    grid = np.arange(imu.t[0] + width_s / 2, imu.t[-1] - width_s / 2, STEP_S)
    if len(grid) < 2:
        grid = np.array([imu.t[0], imu.t[0] + STEP_S])
    means = ((imu.interpolate(grid + width_s / 2) - imu.interpolate(grid - width_s / 2)) / width_s).T
    force: Complex = e1 @ means[1:4] + 1j * (np.cross(-up, e1) @ means[1:4])
    return -up @ means[4:], force, (means[0] > 0.9).astype(float), float(grid[0])


def correlate(
    a: Floats | Complex, a_there: Floats, b: Floats | Complex, b_there: Floats
) -> tuple[NDArray[Any], Floats]:
    """Normalised correlation of b with a over all lags, and how many values there are of both (Padfield 2012: sums of
    products by FFT, with masks of ones where there are values).

    At index 0 the last value of a lies on the first one of b. Where one hardly changes its variance is taken for
    ``LEAST_VARIANCE`` of that of the whole.
    """
    from scipy.fft import next_fast_len  # every start of navigate would load it

    size = next_fast_len(len(a) + len(b) - 1, real=True)
    forward, back = (np.fft.fft, np.fft.ifft) if np.iscomplexobj(a) else (np.fft.rfft, np.fft.irfft)
    a, b = (there * (x - (there @ x) / max(there.sum(), 1.0)) for x, there in ((a, a_there), (b, b_there)))
    a2, b2 = (np.abs(x) ** 2 for x in (a, b))
    one, first, square = forward((a_there, a, a2), size).conj()
    other, second, power = forward((b_there, b, b2), size)
    sums = back((one * other, first * other, one * second, first * second, square * other, one * power), size)
    count, *sums = np.concatenate((sums[:, size - len(a) + 1 :], sums[:, : len(b)]), 1)
    count = np.maximum(np.round(count.real), 1.0)
    mean_a, mean_b, product, square, power = (x / count for x in sums)
    spreads = (square.real - np.abs(mean_a) ** 2, power.real - np.abs(mean_b) ** 2)
    least = (LEAST_VARIANCE * float(x.sum()) / max(float(n.sum()), 1.0) for x, n in ((a2, a_there), (b2, b_there)))
    spread_a, spread_b = (np.maximum(x, max(floor, 1e-12)) for x, floor in zip(spreads, least))
    return (product - mean_a * mean_b) / np.sqrt(spread_a * spread_b), count
