"""How a car moves: position, velocity and attitude along a plan of manoeuvres.

Speed, course and distance of a plan are in closed form; only the position is integrated, on the ellipsoid.
The road rises and falls gently; a point on it lies along the road: yaw = course, pitch = slope, roll = 0.
What a car adds is in ``chassis``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray

from dlkf.navigation.earth import ECCENTRICITY_SQ, transverse_radius
from dlkf.simulation.motion.routes import Kinematics, Plan, VehicleConfig, along, random_plan

Array = NDArray[np.floating]
WAVES = 6  # of an angle of the road


@dataclass(frozen=True)
class Truth:
    """Position, velocity and attitude of the body at the times ``t`` (N,), in true local NED."""

    t: Array  # s
    lat: Array  # rad
    lon: Array  # rad
    height: Array  # m
    v_n: Array  # (N, 3) m/s
    rpy: Array  # (N, 3) rad, yaw continuous

    def at(self, rows: slice | NDArray[np.int64]) -> Truth:
        """Some rows of it."""
        return Truth(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class Waves:
    """An angle of the road against distance, Σ amplitude · sin(wavenumber · s + phase) [rad]."""

    amplitude: Array
    wavenumber: Array
    phase: Array

    def at(self, motion: Kinematics) -> tuple[Array, Array]:
        """The angle [rad] where the car is, and its rate [rad/s]."""
        angle, rate = np.zeros_like(motion.t), np.zeros_like(motion.t)
        if not self.amplitude.any():
            return angle, rate
        for amplitude, wavenumber, phase in zip(self.amplitude, self.wavenumber, self.phase):
            where = wavenumber * motion.distance + phase
            angle += amplitude * np.sin(where)
            rate += amplitude * wavenumber * np.cos(where) * motion.speed
        return angle, rate

    def steer(self, motion: Kinematics) -> Kinematics:
        """The motion with the angle added to its course."""
        angle, bend, curl = (np.zeros_like(motion.t) for _ in range(3))  # and its derivatives by distance
        for amplitude, wavenumber, phase in zip(self.amplitude, self.wavenumber, self.phase):
            where = wavenumber * motion.distance + phase
            wave = amplitude * np.sin(where)
            angle += wave
            bend += amplitude * wavenumber * np.cos(where)
            curl -= wavenumber**2 * wave
        return replace(
            motion,
            course=motion.course + angle,
            yaw_rate=motion.yaw_rate + bend * motion.speed,
            yaw_acceleration=motion.yaw_acceleration + curl * motion.speed**2 + bend * motion.acceleration,
        )


@dataclass(frozen=True)
class Route:
    """A plan, how the driver wanders from it, and the road: slope, cross slope, bank of turns [rad per m/s²]."""

    plan: Plan
    wander: Waves | None
    slope: Waves
    cross_slope: Waves
    superelevation: float

    def motion(self, t: Array) -> Kinematics:
        """Where along the road the car is at times ``t`` [s], and how fast."""
        planned = along(self.plan, t)
        return planned if self.wander is None else self.wander.steer(planned)

    def bank(self, motion: Kinematics) -> tuple[Array, Array]:
        """Bank of the road [rad], positive where its right edge is the lower, and its rate [rad/s]."""
        angle, rate = self.cross_slope.at(motion)
        lateral = motion.speed * motion.yaw_rate
        change = motion.acceleration * motion.yaw_rate + motion.speed * motion.yaw_acceleration
        return angle + self.superelevation * lateral, rate + self.superelevation * change


def drive_vehicle(rng: np.random.Generator, config: VehicleConfig, t: Array) -> Truth:
    """One random drive of a point at the uniformly spaced times ``t`` [s], which start at 0."""
    return follow_route(random_route(rng, config, float(t[-1])), config, t)


def random_route(rng: np.random.Generator, config: VehicleConfig, duration: float) -> Route:
    """A random plan of at least ``duration`` [s] on a random road."""
    cross_rng, wander_rng = rng.spawn(2)
    plan = random_plan(rng, config, duration)
    slope = random_waves(rng, config.slope_std)
    wander = random_waves(wander_rng, math.radians(config.wander_deg), (60.0, 400.0)) if config.wander_deg else None
    return Route(plan, wander, slope, random_waves(cross_rng, config.bank_std), config.superelevation)


def random_waves(rng: np.random.Generator, rms: float, lengths: tuple[float, float] = (200, 1500)) -> Waves:
    """Waves with a given RMS on average, their wavelengths [m] log-uniform: hills, or the bank of a road."""
    amplitude = rms * math.sqrt(2 / WAVES) * rng.uniform(0.5, 1.35, WAVES)
    wavelength = np.exp(rng.uniform(math.log(lengths[0]), math.log(lengths[1]), WAVES))
    return Waves(amplitude, 2 * math.pi / wavelength, rng.uniform(0, 2 * math.pi, WAVES))


def follow_route(route: Route, config: VehicleConfig, t: Array) -> Truth:
    """Truth of a point that moves along a route, at uniform times ``t`` [s]; it has no roll.

    Positions are the integral of the velocities by the trapezoid rule with end correction,
    ∫f dt = dt/2 (f₀ + f₁) + dt²/12 (f₀' − f₁'), exact for cubics: below 1 µm at 100 Hz.
    """
    motion = route.motion(t)
    slope, slope_rate = route.slope.at(motion)
    speed, acceleration, yaw_rate = motion.speed, motion.acceleration, motion.yaw_rate
    flat, rise = np.cos(slope), np.sin(slope)
    level, level_rate = speed * flat, acceleration * flat - speed * rise * slope_rate
    north, east = np.cos(motion.course), np.sin(motion.course)
    v_n = np.stack((level * north, level * east, -speed * rise), -1)
    dt = t[1] - t[0]
    height = config.height_m + _integral(speed * rise, acceleration * rise + level * slope_rate, dt)
    lat, lon = _walk(
        v_n, level_rate * north - v_n[:, 1] * yaw_rate, level_rate * east + v_n[:, 0] * yaw_rate,
        height, math.radians(config.lat_deg), math.radians(config.lon_deg), dt,
    )  # fmt: skip
    return Truth(t, lat, lon, height, v_n, np.stack((np.zeros_like(t), slope, motion.course), -1))


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
        _, per_metre = radians_per_metre(lat, height)
        lat = lat0 + _integral(v_n[:, 0] * per_metre, a_north * per_metre, dt)
    turn, per_metre = radians_per_metre(lat, height)
    speed_up = a_east + v_n[:, 0] * v_n[:, 1] * np.tan(lat) * per_metre  # d/dt of 1/cos L
    return lat, lon0 + _integral(v_n[:, 1] * turn, speed_up * turn, dt)


def radians_per_metre(lat: Array, height: Array) -> tuple[Array, Array]:
    """1/((R_E + h) cos L) and 1/(R_N + h) [rad/m]."""
    meridian, transverse = radii_of_curvature(lat)
    return 1 / ((transverse + height) * np.cos(lat)), 1 / (meridian + height)


def radii_of_curvature(lat: Array) -> tuple[Array, Array]:
    """R_N of the meridian and R_E of the prime vertical [m] (Groves 2.105, 2.106); lat [rad]."""
    transverse = transverse_radius(torch.from_numpy(lat)).numpy()
    return (1 - ECCENTRICITY_SQ) * transverse / (1 - ECCENTRICITY_SQ * np.sin(lat) ** 2), transverse
