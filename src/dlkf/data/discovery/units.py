"""Units of a log from its numbers: gravity for accelerometers, the car's motion for all else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dlkf.data.bursts import MANY, share_at_once, usual_interval
from dlkf.data.discovery.motion import Floats, displacements, stretches
from dlkf.navigation.earth import STANDARD_GRAVITY as G

NEAR = 0.06  # of gravity: a scale error, the road's curves, a cold sensor
ALIKE = 0.12  # of a unit's size, of what is regressed
TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # of a stamp, in a second
CLIMB_S, LEAST_CLIMB_M = 10.0, 1.0  # heights are compared over such stretches, of which the RMS of the climb is more
CLIMBS_ALIKE = 0.7  # correlation
SHAKES = np.radians((0.15, 8.0))  # rad/s RMS of a car on its way, noise and turns included; less wide than °/s in rad/s


def accel_units(size: float, known: Mapping[str, float]) -> list[str]:
    """The units in which ``size`` is gravity, one of each factor: mg and cm/s² are 2 % apart, as biases are."""
    fits = {factor: name for name, factor in reversed(list(known.items())) if abs(size * factor / G - 1) < NEAR}
    return list(fits.values())


def nearest_unit(factor: float, std: float, known: Mapping[str, float]) -> str | None:
    """The unit of about ``factor`` SI, if one is within 12 % and the others beyond four sigma."""
    if not factor > 0:  # of noise alone
        return None
    apart = {name: abs(np.log(factor / value)) for name, value in known.items()}
    best = min(apart, key=lambda name: apart[name])
    certain = std / factor < 0.25 * min(
        (abs(np.log(known[best] / value)) for value in known.values() if value != known[best]), default=1.0
    )
    return best if apart[best] < ALIKE and certain else None


def unit_left(factor: float, std: float, shaking: float, known: Mapping[str, float]) -> str | None:
    """The only unit of a gyroscope that is left for a car that hardly turns: within three sigma of ``factor``, the
    others beyond five, or such that a car on its way would shake by more or less than cars do.

    ``shaking`` is the rates' RMS in the log's unit.
    """
    left: dict[float, str] = {}
    for name, value in known.items():
        if abs(factor - value) <= 5 * std and SHAKES[0] <= shaking * value <= SHAKES[1]:
            left.setdefault(value, name)
    return next((name for value, name in left.items() if len(left) == 1 and abs(factor - value) <= 3 * std), None)


def speed_factor(t: Floats, lat_deg: Floats, lon_deg: Floats, speed: Floats) -> tuple[float, float]:
    """Metres of the way per unit of speed and second, and its spread; NaN where the car hardly moved.

    Over stretches of ten seconds, so that the noise of fixes does not matter.
    """
    good = np.isfinite(lat_deg) & np.isfinite(lon_deg) & np.isfinite(speed)
    t, speed = t[good], speed[good]
    if len(t) < 5:
        return float("nan"), float("nan")
    step = np.diff(t)
    fine = (step > 0) & (step <= 2.5)
    moved = np.concatenate(([0.0], np.cumsum(np.where(fine, np.abs(displacements(lat_deg[good], lon_deg[good])), 0.0))))
    way = np.concatenate(([0.0], np.cumsum(np.where(fine, 0.5 * (speed[1:] + speed[:-1]) * step, 0.0))))
    first, last = stretches(t, 10.0, np.zeros(len(step), bool))
    far = (moved[last] - moved[first]) > 30.0
    if far.sum() < 3:
        return float("nan"), float("nan")
    ratio = (moved[last] - moved[first])[far] / np.maximum((way[last] - way[first])[far], 1e-9)
    middle = float(np.median(ratio))
    return middle, float(np.median(np.abs(ratio - middle))) * 1.5


class Climb(NamedTuple):
    """How much the heights change per metre that the vertical velocity climbs: ``slope``, its 1σ, the correlation."""

    slope: float
    std: float
    alike: float

    def differs(self, factor: float, sigmas: float) -> bool:
        """Whether the slope is above ``factor`` or below its inverse for certain, and not by a few wrong heights."""
        doubt = sigmas * self.std
        return self.alike > CLIMBS_ALIKE and (self.slope - doubt > factor or 0 < self.slope < 1 / factor - doubt)


def compare_climbs(t: Floats, height: Floats, down: Floats) -> Climb | None:
    """Heights against the integral of the downward velocity [m/s]; None without enough vertical motion.

    Over stretches of ten seconds, one from every row: those that overlap count as one for the 1σ.
    """
    known = np.isfinite(height) & np.isfinite(down)
    t, height, down = t[known], height[known], down[known]
    if len(t) < 20:
        return None
    step = np.diff(t)
    fallen = np.concatenate(([0.0], np.cumsum(step * (down[1:] + down[:-1]) / 2)))
    first, last = stretches(t, CLIMB_S, step > 2.0)
    climbed, rose = height[last] - height[first], fallen[first] - fallen[last]
    if len(rose) < 10 or np.sqrt(np.mean(rose**2)) < LEAST_CLIMB_M:
        return None
    slope = float(climbed @ rose / (rose @ rose))
    count = max(len(rose) * float(np.median(step)) / CLIMB_S, 1.0)
    std = float(np.sqrt(np.mean((climbed - slope * rose) ** 2) / np.mean(rose**2) / count))
    alike = abs(float(climbed @ rose)) / max(float(np.linalg.norm(climbed) * np.linalg.norm(rose)), 1e-12)
    return Climb(slope, std, alike)


def time_unit(values: Floats, slowest_s: float, fastest_s: float) -> str | None:
    """Unit of stamps: by their size where they count from 1970, else by their usual step; None if ambiguous."""
    numbers = np.asarray(values, dtype=float)
    size = float(np.nanmedian(np.abs(numbers)))
    for unit, ticks in TICKS.items():
        if 8e8 * ticks < size < 5e9 * ticks:
            return unit
    step = np.diff(numbers)
    step = step[step > 0]
    if not len(step):
        return None
    packets = share_at_once(numbers) > MANY
    usual = usual_interval(numbers) if packets else float(np.median(step))
    fits = [unit for unit, ticks in TICKS.items() if fastest_s <= usual / ticks <= slowest_s]
    return fits[0] if len(fits) == 1 else None
