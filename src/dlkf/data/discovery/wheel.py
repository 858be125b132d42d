"""Unit and clock offset of a wheel speed, from the speed of GNSS.

Both speeds lie on a grid of half a second and are correlated over all lags at which the logs overlap; then the offset
between the steps is that of the least sum of squares of scale · wheel(t − lag) − GNSS(t), without outliers (slip,
damaged speeds) and where the wheel has samples near, its 1σ from the residuals over the accelerations:
σ² = s² / Σ (dv/dt)².

A receiver's speed may be seconds late. The IMU shows that: the changes of the wheel's speed in a second are correlated
with the integral of the forward acceleration, both without what varies slowly (hills).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dlkf.data.discovery.clock import correlate, find_peak
from dlkf.data.discovery.motion import Floats, Motion

STEP_S = 0.5
LEAST_S = 30.0  # of common time
NEIGHBOUR_S = 5.0  # lags this close belong to one peak
FINE_S, REACH_S = 0.02, 1.0  # of the search between the steps
MOVING = 2.0  # m/s
LEAST_ALIKE, LEAST_GAIN = 0.9, 15.0
IMPOSSIBLE = 3.0  # times the largest speed of GNSS, by what both have in their faster fifth: marks, damage
OUTLYING, LEAST_RESIDUAL = 5.0, 0.05  # median residuals; of the mean speed at least
FORCE_STEP_S, FORCE_REACH_S = 0.1, 4.0  # of the search against the IMU
CHANGE_S, SLOW_S = 1.0, 20.0  # of a change of speed; of the mean that is taken off
FORCE_ALIKE = 0.8  # correlation
WHITE_S = 1.0  # residuals of a receiver's speed are alike over so long


class Wheel(NamedTuple):
    """``lag_s`` ± ``lag_std`` is added to the wheel's stamps to give those of GNSS; ``scale`` is m/s per unit."""

    lag_s: float
    lag_std: float
    scale: float
    scale_std: float
    alike: float  # correlation of the two speeds at the lag
    clear: bool  # no other lag explains nearly as much


def find_wheel(t: Floats, speed: Floats, gnss: Motion) -> Wheel | None:
    """The lag and scale of the best agreement, of speeds without their sign; None where the logs have too little in
    common, or the car keeps its speed."""
    good = np.isfinite(speed)
    t, speed = t[good], np.abs(speed[good])
    if len(t) and len(gnss.t):
        usual, ground = float(np.quantile(speed, 0.8)), float(np.quantile(gnss.speed, 0.8))
        good = speed * ground <= IMPOSSIBLE * usual * gnss.speed.max() if usual > 0 else np.ones(len(t), bool)
        t, speed = t[good], speed[good]
    if len(t) < 20 or len(gnss.t) < 20 or np.ptp(speed) == 0 or np.ptp(gnss.speed) < MOVING:
        return None
    wheel, here = _resample(t, speed)
    ground, there = _resample(gnss.t, gnss.speed)
    alike, count = correlate(wheel, here, ground, there)
    lags = (np.arange(len(alike)) - (len(wheel) - 1)) * STEP_S + gnss.t[0] - t[0]
    allowed = count * STEP_S >= min(LEAST_S, 0.5 * min(np.ptp(t), np.ptp(gnss.t)))
    if not allowed.any():
        return None
    gain = np.where(allowed, -0.5 * count * np.log1p(-(np.clip(alike, 0.0, 0.9999) ** 2)), -np.inf)
    best = int(gain.argmax())
    rival = np.where(np.abs(lags - lags[best]) > NEIGHBOUR_S, gain, -np.inf).max()
    clear = alike[best] > LEAST_ALIKE and gain[best] - rival > LEAST_GAIN
    return _between(t, speed, gnss, float(lags[best]), bool(clear))


def find_force_lag(t: Floats, speed: Floats, imu_t: Floats, forward: Floats) -> tuple[float, float] | None:
    """Seconds to be added to the wheel's stamps ``t`` to give those of the IMU's ``forward`` acceleration [m/s²], and
    the correlation there; None where nothing agrees."""
    good = np.isfinite(speed)
    t, speed = t[good], np.abs(speed[good])
    if len(t) < 20 or len(imu_t) < 20:
        return None
    margin = FORCE_REACH_S + CHANGE_S
    grid = np.arange(max(t[0], imu_t[0]) + margin, min(t[-1], imu_t[-1]) - margin, FORCE_STEP_S)
    if len(grid) * FORCE_STEP_S < LEAST_S:
        return None
    gained = np.cumsum(forward * np.diff(imu_t, prepend=imu_t[0]))
    near = _is_near(t, grid) & _is_near(imu_t, grid)
    force = _change(imu_t, gained, grid, near)
    lags = np.arange(-FORCE_REACH_S, FORCE_REACH_S + FORCE_STEP_S / 2, FORCE_STEP_S)
    alike = np.array([_correlate(_change(t + lag, speed, grid, near), force) for lag in lags])
    best = int(alike.argmax())
    if alike[best] < FORCE_ALIKE or not 0 < best < len(lags) - 1:
        return None
    return float(lags[best] + FORCE_STEP_S * find_peak(alike[best - 1 : best + 2])), float(alike[best])


def _change(t: Floats, v: Floats, grid: Floats, known: np.ndarray) -> Floats:
    """Changes of a speed around each time of the grid, without their mean over ``SLOW_S``; 0 where not ``known``."""
    change = np.interp(grid + CHANGE_S / 2, t, v) - np.interp(grid - CHANGE_S / 2, t, v)
    change = np.where(known, change, 0.0)
    width = round(SLOW_S / FORCE_STEP_S)
    return np.where(known, change - np.convolve(change, np.ones(width) / width, mode="same"), 0.0)


def _correlate(one: Floats, other: Floats) -> float:
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size > 0 else 0.0


def _resample(t: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Speeds on the grid from the first stamp on, and 1 where there are samples near."""
    grid = np.arange(t[0], t[-1] + STEP_S / 2, STEP_S)
    return np.interp(grid, t, v), _is_near(t, grid).astype(float)


def _is_near(t: Floats, at: Floats) -> np.ndarray:
    """Whether there is a sample near each time, on either side."""
    after = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
    apart = np.maximum(np.abs(t[after] - at), np.abs(at - t[np.maximum(after - 1, 0)]))
    return apart <= max(2 * float(np.median(np.diff(t))), STEP_S)


def _between(t: Floats, speed: Floats, gnss: Motion, lag_s: float, clear: bool) -> Wheel | None:
    """The offset between the steps of the search."""
    lags = lag_s + np.arange(-REACH_S, REACH_S + FINE_S / 2, FINE_S)
    inside = (gnss.t > t[0] + lags[-1]) & (gnss.t < t[-1] + lags[0]) & np.isfinite(gnss.speed)
    if inside.sum() < 10:
        return None
    at, ground = gnss.t[inside], gnss.speed[inside]
    near = _is_near(t, at[:, None] - lags).all(1)
    at, ground = at[near], ground[near]
    shifted = np.interp(at[:, None] - lags, t, speed)
    keep = _reject_outliers(shifted, ground)
    if keep.sum() < 10:
        return None
    at, ground, shifted = at[keep], ground[keep], shifted[keep]
    scale = (shifted * ground[:, None]).sum(0) / np.maximum((shifted * shifted).sum(0), 1e-12)
    left = np.mean((scale * shifted - ground[:, None]) ** 2, 0)
    best = int(left.argmin())
    clear = clear and 0 < best < len(lags) - 1
    lag = lags[best] + FINE_S * find_peak(-left[max(best - 1, 0) : best + 2])
    slope = np.gradient(scale[best] * shifted[:, best], at)
    apart = max(1.0, WHITE_S / max(float(np.median(np.diff(at))), 1e-3))
    std = np.sqrt(apart * left[best] / max(float((slope * slope).sum()), 1e-12))
    scale_std = np.sqrt(apart * left[best] / max(float((shifted[:, best] ** 2).sum()), 1e-12))
    alike = float(np.corrcoef(shifted[:, best], ground)[0, 1]) if np.ptp(shifted[:, best]) > 0 else 0.0
    return Wheel(float(lag), float(std), float(scale[best]), float(scale_std), alike, clear)


def _reject_outliers(shifted: Floats, ground: Floats) -> np.ndarray:
    """Rows (n,) whose residuals are at most five medians at the lag (n, lags) with the least mean magnitude of them,
    where those beyond count no more than that; the scale is the median ratio."""
    fast = ground > MOVING
    if fast.sum() < 10:
        return np.ones(len(ground), bool)
    ratio = np.median(ground[fast, None] / np.maximum(shifted[fast], 1e-9), 0)
    off = np.abs(ratio * shifted - ground[:, None])
    most = np.inf
    for _ in range(3):
        best = off[:, int(np.minimum(off, most).mean(0).argmin())]
        most = max(OUTLYING * float(np.median(best)), LEAST_RESIDUAL * float(ground.mean()))
    return np.asarray(best <= most)
