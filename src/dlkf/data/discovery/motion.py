"""A car's motion by GNSS, and an IMU's integrals to compare it with.

Horizontal vectors are complex numbers: North + i East, or forward + i right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dlkf.data.limits import EARTH_M
from dlkf.data.schema import VELOCITY, stack_columns
from dlkf.data.tables import Columns

Floats = NDArray[np.floating]
Complex = NDArray[np.complexfloating]

MOVING, RESTING = 2.0, 0.3  # m/s: above, the course is known; below, the car stands
LONGEST_STEP_S = 2.5  # fixes further apart make no interval
PHASES = 5  # intervals that overlap: of fixes at 50 Hz one from every fix would say no more, and take long
FIT_S = 5.0  # of positions that have a velocity together
SHORTEST_STEP_S = 0.45  # of faster fixes intervals span several: the noise of a difference grows with its rate


@dataclass(frozen=True)
class Motion:
    """Velocities [m/s] at times ``t`` [s] of the GNSS clock; ``climb`` is the slope of the way, 0 where not known.

    An interval spans ``stride`` fixes.
    """

    t: Floats
    v: Complex
    climb: Floats
    stride: int = 1

    @property
    def speed(self) -> Floats:
        """Horizontal speed [m/s]."""
        return np.abs(self.v)

    @property
    def course(self) -> Floats:
        """Course over ground [rad], clockwise from North."""
        return np.angle(self.v)

    @property
    def phase(self) -> int:
        """Fixes from the beginning of an overlapping interval to that of the next one."""
        return max(1, self.stride // PHASES)

    def intervals(self, overlapping: bool = False) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First and last rows of the intervals, end to end, or of ``PHASES`` and more (one from every fix at most)."""
        first = np.arange(0, max(len(self.t) - self.stride, 0), self.phase if overlapping else self.stride)
        first = first[self.t[first + self.stride] - self.t[first] <= LONGEST_STEP_S]
        return first, first + self.stride


def find_motion(fixes: Columns | pd.DataFrame) -> Motion:
    """Of the usable rows of a GNSS table; where they have no velocities, from the differences of their positions."""
    t, lat_deg, lon_deg = (np.asarray(fixes[c]) for c in ("t", "lat_deg", "lon_deg"))
    v_ned = stack_columns(fixes, VELOCITY)
    place = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    known = np.isfinite(v_ned[:, :2]).all(-1)
    if known.sum() < 0.2 * len(t):
        return _from_positions(t[place], lat_deg[place], lon_deg[place])
    v = v_ned[known, 0] + 1j * v_ned[known, 1]
    speed = np.abs(v)
    climb = np.where(speed > MOVING, -np.nan_to_num(v_ned[known, 2]) / np.maximum(speed, 0.1), 0.0)
    return Motion(t[known], v, np.clip(climb, -0.3, 0.3), stride=_stride(t[known]))


def stretches(t: Floats, seconds: float, broken: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last rows of the stretches of so many seconds, one from every row, with no ``broken`` step (n − 1,)."""
    first, last = np.arange(len(t)), np.searchsorted(t, t + seconds)
    breaks = np.concatenate(([0], np.cumsum(broken)))
    whole = (last < len(t)) & (breaks[np.minimum(last, len(t) - 1)] == breaks)
    return first[whole], last[whole]


def displacements(lat_deg: Floats, lon_deg: Floats) -> Complex:
    """From each position to the next, north + i east [m]."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    return EARTH_M * (np.diff(lat) + 1j * np.cos(lat[:-1]) * np.diff(lon))


def _stride(t: Floats) -> int:
    """How many fixes an interval spans."""
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    return max(1, int(np.ceil(SHORTEST_STEP_S / max(step, 1e-3) - 0.01)))


def _from_positions(t: Floats, lat_deg: Floats, lon_deg: Floats) -> Motion:
    """Velocity between two fixes, at the middle of their interval."""
    thin = slice(None, None, _stride(t))
    t, moved = t[thin], displacements(lat_deg[thin], lon_deg[thin])
    step = np.diff(t)
    fine = (step > 0) & (step <= LONGEST_STEP_S)
    middle = 0.5 * (t[1:] + t[:-1])[fine]
    return Motion(middle, moved[fine] / step[fine], np.zeros(int(fine.sum())))


def fit_motion(fixes: Columns | pd.DataFrame) -> Motion:
    """Velocities from straight lines through the positions of :data:`FIT_S` around each fix: of coarse positions, whose
    differences are noise; turns and braking are smoothed."""
    t, lat_deg, lon_deg = (np.asarray(fixes[c]) for c in ("t", "lat_deg", "lon_deg"))
    place = np.concatenate(([0.0], np.cumsum(displacements(lat_deg, lon_deg))))
    s = t - t[0]
    before, after = np.searchsorted(t, t - FIT_S / 2 - 1e-6), np.searchsorted(t, t + FIT_S / 2 + 1e-6)
    count = after - before

    def mean(x: np.ndarray) -> Any:
        total = np.concatenate(([0.0], np.cumsum(x)))
        return (total[after] - total[before]) / count

    middle, spread = mean(s), mean(s * s) - mean(s) ** 2
    v = (mean(s * place) - middle * mean(place)) / np.maximum(spread, 1e-9)
    full = spread > (0.9 * FIT_S) ** 2 / 12  # no gap nearby, no end of the log
    good = full & (count >= 4) & (np.abs(middle - s) < 0.1 * FIT_S)
    return Motion(t[good], v[good], np.zeros(int(good.sum())), stride=_stride(t[good]))


def position_delay(fixes: Columns | pd.DataFrame) -> tuple[float, float]:
    """Seconds by which positions are older than the velocities beside them, and 1σ; NaN where it is not observable.

    Δp − ∫v dt = −δ Δv: what a turn or a braking car leaves between them.
    """
    north, east, lat_deg, lon_deg = (np.asarray(fixes[c]) for c in (*VELOCITY[:2], "lat_deg", "lon_deg"))
    stamps, known = np.asarray(fixes["t"]), np.flatnonzero(np.isfinite(north + east + lat_deg + lon_deg))
    rows = known[:: _stride(stamps[known])]
    t, v = stamps[rows], north[rows] + 1j * east[rows]
    step = np.diff(t)
    fine = (step > 0) & (step < LONGEST_STEP_S)
    # the mean radius is good to 0.3 %: what it spoils is a share of the way, so it is fitted beside the delay
    moved = displacements(lat_deg[rows], lon_deg[rows])[fine]
    way, change = ((v[1:] + v[:-1]) / 2 * step)[fine], np.diff(v)[fine]
    if len(way) < 20 or np.sum(np.abs(change) ** 2) < 20.0:
        return float("nan"), float("nan")
    keep = np.ones(len(way), bool)
    fitted = np.zeros(4)
    sigma = float("nan")
    design = np.concatenate(
        [
            np.column_stack((-change.real, way.real, 0 * way.real)),
            np.column_stack((-change.imag, 0 * way.real, way.imag)),
        ]
    )
    left = np.concatenate((moved.real, moved.imag))
    for _ in range(3):
        both = np.concatenate((keep, keep))
        fitted, *_ = np.linalg.lstsq(design[both], left[both], rcond=None)
        off = left - design @ fitted
        size = np.hypot(*off.reshape(2, -1))
        keep = size <= 4 * max(float(np.median(size[keep])), 1e-4)
        spread = float(np.sqrt(np.mean(off[np.concatenate((keep, keep))] ** 2)))
        sigma = 2 * spread / float(np.sqrt(np.sum(np.abs(change[keep]) ** 2)))  # 2: neighbours share a fix's noise
    return float(fitted[0]), sigma


@dataclass(frozen=True)
class Levelled:
    """An IMU in axes (e1, e2, down) that do not turn with the sensor's pose; all integrals start at ``t[0]``.

    ``turn`` is the angle about down, ``force`` and ``ones`` the integrals of e^{i turn} times the horizontal force
    and 1, ``swing`` = i ω e^{i turn}, each at the limits of the samples ``t``. ``tilted`` is ``force`` with what the
    gyroscopes give of pitch and roll: q = ∫ e^{i turn} (ω₂ − i ω₁) dt is the horizontal part of the sensor's third
    axis, and f_z q its share of gravity (small angles; q drifts slowly).
    """

    t: Floats
    turn: Floats
    force: Complex
    ones: Complex
    swing: Complex
    tilted: Complex
    axes: Floats  # (3, 3): rows e1, e2, down in the sensor's axes


def _gyro_biases(across: Floats, about: Floats) -> Floats:
    """Means of the gyroscopes across (n, 2) where the car does not turn ``about`` down: their biases.

    Their means are not: a car that leans in its turns, or is not quite level, turns about them too, and a loop of
    360° under 3° within two minutes is 0.15 °/s.
    """
    mean, turning = across.mean(0), about - about.mean()
    lean = turning @ (across - mean) / max(float(turning @ turning), 1e-12)
    return mean - lean * about.mean()


def integrate_level(t: Floats, accel: Floats, gyro: Floats, down: Floats) -> Levelled:
    """Integrate samples that end at ``t`` (n,); ``accel`` [m/s²], ``gyro`` [rad/s] (n, 3), ``down`` a unit vector."""
    helper = np.eye(3)[int(np.abs(down).argmin())]
    e1 = helper - down * (helper @ down)
    e1 /= np.linalg.norm(e1)
    axes = np.stack((e1, np.cross(down, e1), down))
    step = np.diff(t, prepend=t[0] - np.median(np.diff(t)))
    step = np.where(step > 1.0, 0.0, step)  # nothing is known of gaps
    f, rates = accel @ axes.T, gyro @ axes.T
    w = rates[:, 2]
    turn = np.concatenate(([0.0], np.cumsum(w * step)))
    middle = np.exp(0.5j * (turn[1:] + turn[:-1]))
    force = np.concatenate(([0.0], np.cumsum(middle * (f[:, 0] + 1j * f[:, 1]) * step)))
    ones = np.concatenate(([0.0], np.cumsum(middle * step)))
    still = _gyro_biases(rates[:, :2], w)
    pitching = middle * (rates[:, 1] - still[1] - 1j * (rates[:, 0] - still[0]))
    q = np.concatenate(([0.0], np.cumsum(pitching * step)))
    level = middle * (f[:, 0] + 1j * f[:, 1]) + f[:, 2] * 0.5 * (q[1:] + q[:-1])
    tilted = np.concatenate(([0.0], np.cumsum(level * step)))
    limits = np.concatenate((t[:1] - step[0], t))
    width = max(1, round(0.1 / float(np.median(step))))
    smooth = np.convolve(np.concatenate((w[:1], w)), np.ones(width) / width, mode="same")
    return Levelled(limits, turn, force, ones, 1j * smooth * np.exp(1j * turn), tilted, axes)
