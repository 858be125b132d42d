"""How a car moves: a random plan of manoeuvres, and position, velocity and attitude along it.

A plan is a row of segments. In each, speed and course change by given amounts through one smooth window
w(x): a cubic ramp up, a plateau, a ramp down. So longitudinal acceleration (its jerk bounded) and yaw rate
(a clothoid-like turn) are continuous, and speed, course and distance are polynomials in closed form; only
the position is integrated, on the ellipsoid. Bounds: R084-R088 of the paper (speed 0-80 km/h, longitudinal
0-2 m/s², turns of 40-150 m radius at 0.5-5 m/s² lateral, the last two on the plateau of a turn).

The road rises and falls gently; the body lies along the road: yaw = course, pitch = slope, roll = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from dlkf.errors import InputError
from dlkf.navigation.earth import ECCENTRICITY_SQ, transverse_radius

Array = NDArray[np.float64]
KMH = 1 / 3.6


@dataclass(frozen=True)
class VehicleConfig:
    """Bounds of the motion and where it starts; ``slope_std`` is the RMS grade, 0 for a flat road."""

    max_speed_kmh: float = 80.0
    max_acceleration: float = 2.0  # m/s², along the road
    min_radius: float = 40.0  # m
    max_radius: float = 150.0
    min_lateral: float = 0.5  # m/s², on the plateau of a turn
    max_lateral: float = 5.0
    slope_std: float = 0.03
    lat_deg: float = 52.15
    lon_deg: float = 9.95
    height_m: float = 100.0

    def __post_init__(self) -> None:
        for low, high in (("min_radius", "max_radius"), ("min_lateral", "max_lateral")):
            if not 0 < getattr(self, low) <= getattr(self, high):
                raise InputError(
                    f"vehicle: {low} {getattr(self, low)} and {high} {getattr(self, high)} "
                    f"must be positive and in that order"
                )
        if not 0.2 <= self.max_acceleration <= 10:
            raise InputError(f"vehicle: max_acceleration {self.max_acceleration} m/s² is outside 0.2 to 10")
        if not 0 <= self.slope_std <= 0.1:
            raise InputError(f"vehicle: slope_std {self.slope_std} is outside 0 to 0.1")
        slowest = math.sqrt(self.min_lateral * self.min_radius) / KMH
        if not slowest <= self.max_speed_kmh <= 300:
            raise InputError(
                f"vehicle: max_speed_kmh {self.max_speed_kmh} is outside {slowest:.1f} to 300: a turn of "
                f"{self.min_radius} m radius with {self.min_lateral} m/s² lateral takes {slowest:.1f} km/h"
            )
        if not (abs(self.lat_deg) <= 80 and abs(self.lon_deg) <= 180 and -500 <= self.height_m <= 9000):
            raise InputError(
                f"vehicle: start at {self.lat_deg}°, {self.lon_deg}°, {self.height_m} m is outside "
                f"±80°, ±180°, -500 to 9000 m"
            )


@dataclass(frozen=True)
class Truth:
    """Position, velocity and attitude of the body at the times ``t`` (N,), in true local NED."""

    t: Array  # s
    lat: Array  # rad
    lon: Array  # rad
    height: Array  # m
    v_n: Array  # (N, 3) m/s
    rpy: Array  # (N, 3) rad, yaw continuous


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
class Road:
    """Slope [rad] against distance, a sum of waves: Σ amplitude · sin(wavenumber · s + phase)."""

    amplitude: Array
    wavenumber: Array
    phase: Array


def drive_vehicle(rng: np.random.Generator, config: VehicleConfig, t: Array) -> Truth:
    """One random drive at the uniformly spaced times ``t`` [s], which start at 0."""
    plan = random_plan(rng, config, float(t[-1]))
    road = random_road(rng, config)
    return follow(plan, road, config, t)


def random_plan(rng: np.random.Generator, config: VehicleConfig, duration: float) -> Plan:
    """Manoeuvres (R084) until ``duration`` [s] is filled: stretches, turns, stops, figure-eights."""
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
        kind = rng.choice(4, p=(0.35, 0.50, 0.10, 0.05))
        side = rng.choice((-1.0, 1.0))
        if kind == 0:
            reach(rng.uniform(0.25, 1.0) * top)
            add(rng.uniform(2.0, 20.0))
        elif kind == 1:
            radius, lateral = bend(config.max_radius)
            reach(math.sqrt(lateral * radius))
            turn(side * math.radians(rng.uniform(20.0, 120.0)), radius, lateral)
            add(rng.uniform(1.0, 8.0))
        elif kind == 2 and speed > 0:
            reach(0.0)
            add(rng.uniform(3.0, 25.0))
        elif kind == 3:
            radius, lateral = bend(0.5 * (config.min_radius + config.max_radius))
            reach(math.sqrt(lateral * radius))
            turn(side * 2 * math.pi, radius, lateral)
            turn(-side * 2 * math.pi, radius, lateral)
    length, ramp, faster, turned = np.array(rows).T
    speed_at = np.cumsum(faster) - faster
    speed_at[np.abs(speed_at) < 1e-9] = 0.0  # a standstill is exactly still
    course = rng.uniform(-math.pi, math.pi) + np.cumsum(turned) - turned
    driven = speed_at * length + 0.5 * faster * length  # the window is symmetric
    return Plan(
        np.cumsum(length) - length, length, ramp, speed_at, faster, course, turned, np.cumsum(driven) - driven
    )


def random_road(rng: np.random.Generator, config: VehicleConfig, waves: int = 6) -> Road:
    """Hills of 200 to 1500 m wavelength with an RMS grade of ``slope_std`` on average."""
    amplitude = config.slope_std * math.sqrt(2 / waves) * rng.uniform(0.5, 1.35, waves)
    wavelength = np.exp(rng.uniform(math.log(200), math.log(1500), waves))
    return Road(amplitude, 2 * math.pi / wavelength, rng.uniform(0, 2 * math.pi, waves))


def follow(plan: Plan, road: Road, config: VehicleConfig, t: Array) -> Truth:
    """Truth along a plan and a road at uniform times ``t`` [s].

    Positions are the integral of the velocities by the trapezoid rule with end correction,
    ∫f dt = dt/2 (f₀ + f₁) + dt²/12 (f₀' − f₁'), exact for cubics: below 1 µm at 100 Hz.
    """
    speed, acceleration, course, yaw_rate, distance = _along(plan, t)
    slope, slope_rate = np.zeros_like(t), np.zeros_like(t)
    for amplitude, wavenumber, phase in zip(road.amplitude, road.wavenumber, road.phase):
        angle = wavenumber * distance + phase
        slope += amplitude * np.sin(angle)
        slope_rate += amplitude * wavenumber * np.cos(angle) * speed
    flat, rise = np.cos(slope), np.sin(slope)
    level, level_rate = speed * flat, acceleration * flat - speed * rise * slope_rate
    north, east = np.cos(course), np.sin(course)
    v_n = np.stack((level * north, level * east, -speed * rise), -1)
    dt = t[1] - t[0]
    height = config.height_m + _integral(speed * rise, acceleration * rise + level * slope_rate, dt)
    lat, lon = _walk(
        v_n, level_rate * north - v_n[:, 1] * yaw_rate, level_rate * east + v_n[:, 0] * yaw_rate,
        height, math.radians(config.lat_deg), math.radians(config.lon_deg), dt,
    )  # fmt: skip
    return Truth(t, lat, lon, height, v_n, np.stack((np.zeros_like(t), slope, course), -1))


def _along(plan: Plan, t: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Speed, acceleration, course, yaw rate and distance at ``t``, by the window and its integrals."""
    k = np.searchsorted(plan.start, t, side="right") - 1
    x, ramp, length = t - plan.start[k], plan.ramp[k], plan.length[k]
    up = _ramp_integrals(x / ramp)
    down = _ramp_integrals((x - length + ramp) / ramp)
    area = length - ramp  # of the whole window, so w/area integrates to one
    w, first, second = ((u - d) * ramp**n / area for n, (u, d) in enumerate(zip(up, down)))
    speed, faster, turned = plan.speed[k], plan.speed_change[k], plan.course_change[k]
    return (
        speed + faster * first,
        faster * w,
        plan.course[k] + turned * first,
        turned * w,
        plan.distance[k] + speed * x + faster * second,
    )


def _ramp_integrals(x: Array) -> tuple[Array, Array, Array]:
    """The ramp 3x² − 2x³ (0 before, 1 after) and its first and second integral."""
    c, over = np.clip(x, 0, 1), np.maximum(x - 1, 0)
    return (
        c * c * (3 - 2 * c),
        c**3 * (1 - c / 2) + over,
        c**4 * (1 / 4 - c / 10) + over * (1 + over) / 2,
    )


def _integral(f: Array, slope: Array, dt: float) -> Array:
    steps = dt / 2 * (f[1:] + f[:-1]) + dt**2 / 12 * (slope[:-1] - slope[1:])
    return np.concatenate(((0.0,), np.cumsum(steps)))


def _walk(
    v_n: Array, a_north: Array, a_east: Array, height: Array, lat0: float, lon0: float, dt: float
) -> tuple[Array, Array]:
    """Latitude, longitude from L' = v_N/(R_N + h), λ' = v_E/((R_E + h) cos L) (Groves 2.111).

    The radii need the latitude; each pass of this fixed point gains five digits.
    """
    lat = np.full_like(height, lat0)
    for _ in range(3):
        _, per_metre = _radians_per_metre(lat, height)
        lat = lat0 + _integral(v_n[:, 0] * per_metre, a_north * per_metre, dt)
    turn, per_metre = _radians_per_metre(lat, height)
    speed_up = a_east + v_n[:, 0] * v_n[:, 1] * np.tan(lat) * per_metre  # d/dt of 1/cos L
    return lat, lon0 + _integral(v_n[:, 1] * turn, speed_up * turn, dt)


def _radians_per_metre(lat: Array, height: Array) -> tuple[Array, Array]:
    """1/((R_E + h) cos L) and 1/(R_N + h) [rad/m]."""
    transverse = transverse_radius(torch.from_numpy(lat)).numpy()
    meridian = (1 - ECCENTRICITY_SQ) * transverse / (1 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    return 1 / ((transverse + height) * np.cos(lat)), 1 / (meridian + height)
