"""The offset between the clocks of an IMU and of GNSS, of any size: yaw rate and horizontal force against GNSS.

The yaw rate about the vertical against the change of course, and the horizontal force as a complex number (whose
argument in the sensor's axes is not known) against the acceleration along and across the course, are correlated over
all lags at which the logs overlap, by FFT. Neither needs units or pose. Then Λ = −n/2 ln(1 − ρ²) of the one
plus −n ln(1 − |ρ|²) of the other is the gain in log-likelihood over no connection at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.data.discovery.motion import MOVING, RESTING, Complex, Floats, Motion
from dlkf.data.readers.units import WEEK_S
from dlkf.navigation.earth import STANDARD_GRAVITY

STEP_S = 0.25
LEAST_S = 20.0  # of common time in intervals with a known course
NEIGHBOUR_S = 3.0  # lags this close belong to one peak
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
    gain, yaws, forces, angles, count = _scores(weight, r, a, there, yaw, force)
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
    numbers = (lags[best], gain[best], other, yaws[best], forces[best], angles[best], peak)
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


def _scores(
    weight: Floats, r: Floats, a: Complex, there: Floats, yaw: Floats, force: Complex
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Λ, both correlations, the sensor's yaw and the number of intervals of every lag.

    At index 0 the last fix lies on the first sample.
    """
    from scipy.fft import next_fast_len  # every start of navigate would load it

    size = next_fast_len(len(weight) + len(there) - 1, real=True)
    here = there > 0
    scale, pull = (max(float(np.std(x[here])) if here.any() else 0.0, 1e-12) for x in (yaw, force))
    r, a, g, f = r * weight, a * weight, yaw / scale * there, force / pull * there
    r2, a2, g2, f2 = (np.abs(x) ** 2 for x in (r, a, g, f))

    def correlate(spectra: np.ndarray) -> np.ndarray:
        """Sums of products over all lags, rows from those of their spectra; half a spectrum is a real signal's."""
        out = np.fft.ifft(spectra) if spectra.shape[1] == size else np.fft.irfft(spectra, size)
        return np.concatenate((out[:, size - len(weight) + 1 :], out[:, : len(there)]), 1)

    W, R, R2, A2 = np.fft.rfft((weight, r, r2, a2), size).conj()
    M, G, G2, F2 = np.fft.rfft((there, g, g2, f2), size)
    n, *real = correlate(np.stack((W * M, R * M, W * G, R * G, R2 * M, W * G2, A2 * M, W * F2)))
    W, A = np.fft.fft((weight, a), size).conj()
    M, F = np.fft.fft((there, f), size)
    count, n = np.round(np.maximum(n, 1e-9)), np.maximum(n, 1.0)
    mean_r, mean_g, rg, mean_r2, mean_g2, mean_a2, mean_f2 = (x / n for x in real)
    mean_a, mean_f, af = correlate(np.stack((A * M, W * F, A * F))) / n

    def spread(mean: np.ndarray, mean2: Floats, least: float) -> Floats:
        return np.maximum(mean2 - np.abs(mean) ** 2, least)

    least_r, least_a = (1e-3 * max(float(x.sum()), 1e-9) / max(float(weight.sum()), 1.0) for x in (r2, a2))
    yaws = (rg - mean_r * mean_g) / np.sqrt(spread(mean_r, mean_r2, least_r) * spread(mean_g, mean_g2, 1e-4))
    alike = (af - mean_a * mean_f) / np.sqrt(spread(mean_a, mean_a2, least_a) * spread(mean_f, mean_f2, 1e-4))
    yaws = np.clip(yaws, -0.9999, 0.9999)
    forces = np.clip(np.abs(alike), 0.0, 0.9999)
    gain = -0.5 * n * np.log1p(-(np.maximum(yaws, 0.0) ** 2)) - n * np.log1p(-(forces**2))
    return np.where(count > 3, gain, 0.0), yaws, forces, -np.angle(alike), count
