"""Where a car goes and how fast: random plans of manoeuvres within bounds, in closed form.

A plan is a row of segments. In each, speed and course change by given amounts through one smooth window
w(x): a cubic ramp up, a plateau, a ramp down. So longitudinal acceleration (its jerk bounded) and yaw rate
(a clothoid-like turn) are continuous, and speed, course and distance are polynomials in closed form. Bounds:
R084-R088 of the paper (speed 0-80 km/h, longitudinal 0-2 m/s², turns of 40-150 m radius at 0.5-5 m/s²
lateral, the last two on the plateau of a turn).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field

Array = NDArray[np.floating]
KMH = 1 / 3.6


@dataclass(frozen=True)
class Manoeuvres:
    """What a driver does how often, and for how long (R084); each pair is the range of a uniform draw.

    ``stretch``, ``turn``, ``stop``, ``eight``, ``lane_change``, ``reverse`` are shares of the manoeuvres and sum to 1.
    A stretch goes to a speed of at least ``slowest`` of the top speed and holds it for ``stretch_s``; a turn
    of ``turn_deg`` is followed by ``after_turn_s`` straight on, a lane change of ``lane_deg`` there and back
    by a stretch's time; a stop lasts ``stop_s``. A figure-eight is a full circle each way. Reversing is a stop,
    a turn backwards, and another stop.
    """

    stretch: float = 0.35
    turn: float = 0.50
    stop: float = 0.10
    eight: float = 0.05
    lane_change: float = 0.0
    reverse: float = 0.0
    slowest: float = 0.25
    stretch_s: tuple[float, float] = (2.0, 20.0)
    turn_deg: tuple[float, float] = (20.0, 120.0)
    after_turn_s: tuple[float, float] = (1.0, 8.0)
    lane_deg: tuple[float, float] = (1.5, 4.0)
    stop_s: tuple[float, float] = (3.0, 25.0)

    def __post_init__(self) -> None:
        if min(self.shares) < 0 or abs(sum(self.shares) - 1) > 1e-9:
            raise InputError(
                f"manoeuvres: stretch, turn, stop, eight, lane_change and reverse sum to {sum(self.shares):g}, "
                f"must be shares that sum to 1"
            )
        if self.shares[0] == 0:
            raise InputError("manoeuvres: stretch is 0, must be positive, or a stationary car would never set off")
        if not 0 < self.slowest <= 1:
            raise InputError(f"manoeuvres: slowest {self.slowest} is outside 0 to 1")
        for name in ("stretch_s", "turn_deg", "after_turn_s", "lane_deg", "stop_s"):
            span = getattr(self, name)
            if len(span) != 2 or not 0 < span[0] <= span[1] <= 3600:
                raise InputError(f"manoeuvres: {name} {list(span)} must be two positive numbers in rising order")

    @property
    def shares(self) -> tuple[float, ...]:
        return self.stretch, self.turn, self.stop, self.eight, self.lane_change, self.reverse


@dataclass(frozen=True)
class VehicleConfig(Ranged, where="vehicle"):
    """Bounds of the motion, where it starts, and the road.

    ``slope_std`` is the RMS grade, ``bank_std`` the RMS cross slope, 0 for a flat road; in a turn the road is
    banked inwards by ``superelevation`` [rad per m/s² of lateral acceleration]. ``wander_deg``: RMS by which
    the driver's course departs from the plan, in waves of 60 to 400 m; the bounds are those of the plan.
    """

    max_speed_kmh: float = 80.0
    max_acceleration: float = bounded_field(2.0, 0.2, 10)  # m/s², along the road
    min_radius: float = 40.0  # m
    max_radius: float = 150.0
    min_lateral: float = 0.5  # m/s², on the plateau of a turn
    max_lateral: float = 5.0
    slope_std: float = bounded_field(0.03, 0, 0.1)
    bank_std: float = bounded_field(0.0, 0, 0.1)
    superelevation: float = bounded_field(0.0, 0, 0.1)
    wander_deg: float = bounded_field(0.0, 0, 3)
    lat_deg: float = bounded_field(52.15, -80, 80)
    lon_deg: float = bounded_field(9.95, -180, 180)
    height_m: float = bounded_field(100.0, -500, 9000)
    manoeuvres: Manoeuvres = field(default_factory=Manoeuvres)

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in (("min_radius", "max_radius"), ("min_lateral", "max_lateral")):
            if not 0 < getattr(self, low) <= getattr(self, high):
                raise InputError(
                    f"vehicle: {low} {getattr(self, low)} and {high} {getattr(self, high)} "
                    f"must be positive and in that order"
                )
        slowest = math.sqrt(self.min_lateral * self.min_radius) / KMH
        if not slowest <= self.max_speed_kmh <= 300:
            raise InputError(
                f"vehicle: max_speed_kmh {self.max_speed_kmh} is outside {slowest:.1f} to 300: a turn of "
                f"{self.min_radius} m radius with {self.min_lateral} m/s² lateral takes {slowest:.1f} km/h"
            )


@dataclass(frozen=True)
class Plan:
    """Segments: start time, length and ramp [s]; speed [m/s], course [rad], distance [m] at the start."""

    start: Array
    length: Array
    ramp: Array
    speed: Array
    speed_change: Array
    course: Array
    course_change: Array
    distance: Array


@dataclass(frozen=True)
class Kinematics:
    """Motion along the road at the times ``t`` (N,): all that depends on the plan alone, in closed form."""

    t: Array  # s
    speed: Array  # m/s
    acceleration: Array  # m/s², along the road
    course: Array  # rad, continuous
    yaw_rate: Array  # rad/s
    yaw_acceleration: Array  # rad/s²
    distance: Array  # m


def random_plan(rng: np.random.Generator, config: VehicleConfig, duration: float) -> Plan:
    """Manoeuvres (R084) until ``duration`` [s] is filled: stretches, turns, stops, figure-eights, lane changes."""
    habits = config.manoeuvres
    rows: list[tuple[float, float, float, float]] = []  # length, ramp, speed change, course change
    top = config.max_speed_kmh * KMH
    clock, speed = 0.0, 0.0

    def add(length: float, ramp: float = 1.0, faster: float = 0.0, turned: float = 0.0) -> None:
        nonlocal clock, speed
        rows.append((length, ramp, faster, turned))
        clock += length
        speed += faster

    def reach(target: float) -> None:
        if abs(target - speed) < 1e-6:
            return
        rate = rng.uniform(0.4, 1.0) * config.max_acceleration
        ramp = rng.uniform(0.6, 1.5)
        add(abs(target - speed) / rate + ramp, ramp, target - speed)

    def turn(angle: float, radius: float, lateral: float) -> None:
        rate = math.sqrt(lateral / radius)
        ramp = min(max(0.8, lateral / rng.uniform(1.5, 3.0)), abs(angle) / rate)
        add(abs(angle) / rate + ramp, ramp, turned=angle)

    def bend(max_radius: float) -> tuple[float, float]:
        radius = rng.uniform(config.min_radius, min(max_radius, top**2 / config.min_lateral))
        sharp = rng.triangular(config.min_lateral, config.min_lateral, config.max_lateral)
        return radius, min(sharp, top**2 / radius)

    add(rng.uniform(2.0, 8.0))
    while clock < duration:
        kind = rng.choice(6, p=habits.shares)
        side = rng.choice((-1.0, 1.0))
        if kind == 0:
            reach(rng.uniform(habits.slowest, 1.0) * top)
            add(rng.uniform(*habits.stretch_s))
        elif kind == 1:
            radius, lateral = bend(config.max_radius)
            reach(math.sqrt(lateral * radius))
            turn(side * math.radians(rng.uniform(*habits.turn_deg)), radius, lateral)
            add(rng.uniform(*habits.after_turn_s))
        elif kind == 2 and speed > 0:
            reach(0.0)
            add(rng.uniform(*habits.stop_s))
        elif kind == 3:
            radius, lateral = bend(0.5 * (config.min_radius + config.max_radius))
            reach(math.sqrt(lateral * radius))
            turn(side * 2 * math.pi, radius, lateral)
            turn(-side * 2 * math.pi, radius, lateral)
        elif kind == 4:
            radius, lateral = bend(config.max_radius)
            angle = side * math.radians(rng.uniform(*habits.lane_deg))
            reach(math.sqrt(lateral * radius))
            turn(angle, radius, lateral)
            turn(-angle, radius, lateral)
            add(rng.uniform(*habits.stretch_s))
        elif kind == 5:
            reach(0.0)
            add(rng.uniform(1.0, 3.0))
            radius, lateral = config.min_radius, config.min_lateral
            reach(-math.sqrt(lateral * radius))
            turn(side * math.radians(rng.uniform(*habits.turn_deg)), radius, lateral)
            reach(0.0)
            add(rng.uniform(1.0, 3.0))
    length, ramp, faster, turned = np.array(rows).T
    speed_at = np.cumsum(faster) - faster
    speed_at[np.abs(speed_at) < 1e-9] = 0.0  # a standstill is exactly still
    course = rng.uniform(-math.pi, math.pi) + np.cumsum(turned) - turned
    driven = speed_at * length + 0.5 * faster * length  # the window is symmetric
    return Plan(np.cumsum(length) - length, length, ramp, speed_at, faster, course, turned, np.cumsum(driven) - driven)


def along(plan: Plan, t: Array) -> Kinematics:
    """The motion at ``t``, by the window and its integrals."""
    k = np.searchsorted(plan.start, t, side="right") - 1
    x, ramp, length = t - plan.start[k], plan.ramp[k], plan.length[k]
    up = _ramp_integrals(x / ramp)
    down = _ramp_integrals((x - length + ramp) / ramp)
    area = length - ramp  # of the whole window, so w/area integrates to one
    w, first, second = ((u - d) * ramp**n / area for n, (u, d) in enumerate(zip(up, down)))
    speed, faster, turned = plan.speed[k], plan.speed_change[k], plan.course_change[k]
    return Kinematics(
        t,
        speed + faster * first,
        faster * w,
        plan.course[k] + turned * first,
        turned * w,
        turned * (_ramp_slope(x / ramp) - _ramp_slope((x - length + ramp) / ramp)) / (ramp * area),
        plan.distance[k] + speed * x + faster * second,
    )


def _ramp_slope(x: Array) -> Array:
    c = np.clip(x, 0, 1)
    return 6 * c * (1 - c)


def _ramp_integrals(x: Array) -> tuple[Array, Array, Array]:
    """The ramp 3x² − 2x³ (0 before, 1 after) and its first and second integral."""
    c, over = np.clip(x, 0, 1), np.maximum(x - 1, 0)
    return (c * c * (3 - 2 * c), c**3 * (1 - c / 2) + over, c**4 * (1 / 4 - c / 10) + over * (1 + over) / 2)
