"""Physical limits of samples, fixes and estimates: beyond what any car and its sensors can give.

They stand in front of every filter, in batch runs, in streams and in the exported C (which takes the numbers from
here). A sample beyond full scale, or a fix that no car can have reached since the last good one, is refused and
counted. A receiver that was right all along is not refused for ever: fixes in a row that agree with each other replace
the good one (:class:`FixScreen`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from dlkf.data.schema import POSITION, STD, VELOCITY, stack_columns

FULL_SCALE = (400.0, 40.0)  # m/s², rad/s: beyond any IMU of a car, so a damaged packet
FASTEST_M_S, STEEPEST_M_S = 120.0, 30.0  # m/s, horizontally and vertically: beyond any road car
JUMP_M, JUMP_SIGMAS = 100.0, 6.0  # two good fixes differ by the way between them, this, and so many of their 1σ
MOST_JUMP_STD_M = 500.0  # m: of a 1σ so much counts there
HEIGHTS_M = (-1000.0, 10_000.0)  # of a road above the ellipsoid
LARGEST_STD = 1e4  # m, m/s: a fix with a larger 1σ is not used
NOWHERE_DEG = 1e-6  # °, both: what receivers write before they have a position
FROZEN_SPEED_M_S, FROZEN_M = 2.0, 10.0  # a position that stays while its own velocity makes such a way
FROZEN_IMU_S = 0.5  # for so long all six numbers of an IMU may stay the same to the bit while the car moves
AGREEING_FIXES, AGREEING_S = 5, 10.0  # refused fixes that agree with each other for so long replace the good one
LEVER_ARM_M = 30.0  # no antenna of a car is further from its IMU
ESTIMATE_M_S, ESTIMATE_HEIGHTS_M = 200.0, (-2000.0, 20_000.0)  # an estimate beyond is that of a diverged filter
# a filter whose position is off by so much and by so many 1σ of the fix, in so many fixes in a row that take so long;
# by a share of it, but no smaller one, in so many times more
LOST_M, LOST_SIGMAS, LOST_FIXES, LOST_S, LOST_SHARE = 25.0, 10.0, 10, 10.0, 0.3
EARTH_M = 6_371_000.0  # m, mean radius: distances to 0.5 %
DEGREE_M = math.radians(EARTH_M)  # of latitude


class Refused(NamedTuple):
    """How many samples and fixes of a drive lie beyond the limits, and how many samples are spikes; left out."""

    samples: int = 0
    fixes: int = 0
    spikes: int = 0  # dlkf.data.spikes

    def __str__(self) -> str:
        """As a part of a sentence; empty where nothing was refused."""
        words = (("sample", "samples"), ("fix", "fixes"), ("spike of the IMU", "spikes of the IMU"))
        said = [f"{n} {one if n == 1 else many}" for n, (one, many) in zip(self, words) if n]
        return " and ".join((", ".join(said[:-1]), said[-1]) if len(said) > 1 else said)


NONE_REFUSED = Refused()


class GoodFix(NamedTuple):
    """A fix as far as the next one is compared with it."""

    t: float  # s
    lat_deg: float
    lon_deg: float
    height_m: float
    std_m: float  # horizontal and vertical 1σ together
    since: float  # s: the first fix in a row at exactly this place


def within_full_scale(accel: np.ndarray, gyro: np.ndarray) -> np.ndarray:
    """Rows (n,) of specific force and rate (n, 3) [m/s², rad/s] that a sensor can give; NaN is none."""
    return np.all(np.abs(accel) <= FULL_SCALE[0], -1) & np.all(np.abs(gyro) <= FULL_SCALE[1], -1)


def horizontal_distance(lat_a, lon_a, lat_b, lon_b):
    """Great-circle distance [m] between places [°] on a sphere (haversine), element by element."""
    a, b = np.radians(lat_a), np.radians(lat_b)
    half = np.sin((b - a) / 2) ** 2 + np.cos(a) * np.cos(b) * np.sin(np.radians(lon_b - lon_a) / 2) ** 2
    return 2 * EARTH_M * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0)))


def _spread(std: np.ndarray) -> np.ndarray:
    """1σ (n,) [m] of positions from their three components (n, 3); NaN counts as zero."""
    return np.minimum(np.sqrt((np.nan_to_num(std, nan=0.0) ** 2).sum(-1)), MOST_JUMP_STD_M)


def known_speed(velocity: np.ndarray) -> np.ndarray:
    """Magnitude [m/s] of velocities (…, 3) by the components that are known: many receivers give none down."""
    return np.sqrt(np.nansum(velocity**2, -1))


def is_reachable(dt, way_m, climb_m, std_m):
    """Whether a car can have moved so far [m] in ``dt`` [s]; ``std_m`` is the sum of both fixes' 1σ."""
    slack = JUMP_M + JUMP_SIGMAS * std_m
    return (way_m <= FASTEST_M_S * dt + slack) & (np.abs(climb_m) <= STEEPEST_M_S * dt + slack)


class FixScreen:
    """Fixes one at a time, each compared with the last good one; those that no car can have reached are refused.

    ``switched`` holds time [s] and length [m] of the jumps that were accepted in the end, because ``AGREEING_FIXES``
    fixes in a row over ``AGREEING_S`` seconds agreed with each other, against as many good ones before. Where fewer
    were good than now agree, these replace them at once: a first fix that was wrong refuses no second.
    """

    def __init__(self) -> None:
        self._good: GoodFix | None = None
        self._count = 0  # good fixes in a row, up to AGREEING_FIXES
        self._other: GoodFix | None = None  # the last refused one
        self._others, self._others_since = 0, 0.0
        self.switched: list[tuple[float, float]] = []

    def find_refusal(self, t: float, place: tuple[float, float, float], speed: float, std: np.ndarray) -> str:
        """Why a fix cannot be: time [s], lat [°], lon [°], height [m], speed [m/s], 1σ (6); empty if it can."""
        lat, lon, height = place
        for said, beyond in _find_faults(lat, lon, height, speed, std).items():
            if beyond:
                return said.format(height=height, speed=speed)
        fix = GoodFix(t, lat, lon, height, float(_spread(std[:3])), t)
        if self._good is None:
            return self._take(fix)
        if self._reaches(self._good, fix):
            same = self._good.lat_deg == lat and self._good.lon_deg == lon
            since = self._good.since if same else t
            if same and speed > FROZEN_SPEED_M_S and speed * (t - since) > FROZEN_M:
                return f"the position stays while the velocity is {speed:.1f} m/s: a frozen receiver"
            self._others, self._other = 0, None
            return self._take(fix._replace(since=since)) if t >= self._good.t else ""
        agrees = self._other is not None and self._reaches(self._other, fix)
        self._others = self._others + 1 if agrees else 1
        self._others_since = self._others_since if agrees else t
        self._other = fix
        enough = self._others >= AGREEING_FIXES and t - self._others_since >= AGREEING_S
        way = float(horizontal_distance(self._good.lat_deg, self._good.lon_deg, lat, lon))
        if enough or self._count < min(self._others, AGREEING_FIXES):
            if self._count >= AGREEING_FIXES:
                self.switched.append((t, max(way, abs(height - self._good.height_m))))
            self._count = self._others - 1
            self._others, self._other = 0, None
            return self._take(fix)
        climb, dt = height - self._good.height_m, abs(t - self._good.t)
        return f"{way:.0f} m off and {climb:+.0f} m up in {dt:.1f} s: implausible jump"

    def _take(self, fix: GoodFix) -> str:
        self._good = fix
        self._count = min(self._count + 1, AGREEING_FIXES)
        return ""

    @staticmethod
    def _reaches(a: GoodFix, b: GoodFix) -> bool:
        way = horizontal_distance(a.lat_deg, a.lon_deg, b.lat_deg, b.lon_deg)
        return bool(is_reachable(abs(b.t - a.t), way, b.height_m - a.height_m, a.std_m + b.std_m))


def _find_faults(lat, lon, height, speed, std) -> dict[str, Any]:
    """Which fixes are beyond the limits by themselves, by what is wrong with them; ``std`` (…, 6)."""
    with np.errstate(invalid="ignore"):
        return {
            "at 0°/0°: no position yet": (np.abs(lat) < NOWHERE_DEG) & (np.abs(lon) < NOWHERE_DEG),
            f"height {{height:.4g}} m lies outside {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m": (
                (height < HEIGHTS_M[0]) | (height > HEIGHTS_M[1])
            ),
            "a velocity of {speed:.4g} m/s is beyond any car": speed > FASTEST_M_S,
            f"a 1σ beyond {LARGEST_STD:g} m or m/s": (np.nan_to_num(std, nan=0.0) > LARGEST_STD).any(-1),
        }


class Screened(NamedTuple):
    """What a screen made of a table of fixes."""

    keep: np.ndarray  # (n,) bool
    first: str  # the first row that was refused and why; empty if none was
    switched: list[tuple[float, float]]  # FixScreen.switched


def screen_fixes(gnss: dict[str, np.ndarray]) -> Screened:
    """A table of usable fixes in order of time through a :class:`FixScreen`; no loop where no two contradict."""
    t, (lat, lon, height) = gnss["t"], (gnss[c] for c in POSITION)
    std = stack_columns(gnss, STD)
    speed = known_speed(stack_columns(gnss, VELOCITY))
    spread = _spread(std[:, :3])
    keep = np.ones(len(t), bool)
    way = horizontal_distance(lat[:-1], lon[:-1], lat[1:], lon[1:])
    frozen = (np.diff(lat) == 0) & (np.diff(lon) == 0) & (speed[1:] > FROZEN_SPEED_M_S)
    apart = ~is_reachable(np.diff(t), way, np.diff(height), spread[:-1] + spread[1:])
    alone = _find_faults(lat, lon, height, speed, std).values()
    if not (any(x.any() for x in alone) or apart.any() or frozen.any()):
        return Screened(keep, "", [])
    screen, first = FixScreen(), ""
    for k in range(len(t)):
        place = (float(lat[k]), float(lon[k]), float(height[k]))
        reason = screen.find_refusal(float(t[k]), place, float(speed[k]), std[k])
        if reason:
            keep[k] = False
            first = first or f"t = {t[k]:.3f}: {reason}"
    return Screened(keep, first, screen.switched)
