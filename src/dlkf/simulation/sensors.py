"""Further sensors of a simulated car: wheel speed, the heading of a dual-antenna receiver, a barometer.

Each has seeds of its own, so that a drive with them is the drive without them and a table more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
from dlkf.data.aids import EXPONENT, SCALE_M, SEA_LEVEL_PA
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.simulation.motion.routes import KMH
from dlkf.simulation.motion.vehicle import Truth

Array = NDArray[np.floating]
FAST = 30.0  # m/s at which the growth of a tyre is given


@dataclass(frozen=True)
class WheelConfig(Ranged, where="sensors.wheel"):
    """A wheel and how the car reports its speed.

    The wheel turns 1 + ``scale`` as fast as its nominal radius gives, by ``warm`` less when it has warmed up (in
    ``warm_s``) and by ``growth`` less at 30 m/s; it is ``right_m`` to the right of the car's middle and slips by
    ``slip`` of the speed per m/s² of acceleration. ``slips_per_h`` times an hour it slips by ``slip_share`` for
    ``slip_s``; a share ``locks`` of hard brakings (beyond 2.5 m/s²) locks it for ``lock_s``.
    Reported are means over a sample's interval, or over its last ``mean_s`` (0: all of it), as of a value that is asked
    for less often than it is made, ``delay_s`` late by stamps that jitter by ``jitter_s``: with white
    noise ``noise`` [m/s], in ticks of ``tick_m`` (0: none), in steps of ``step_kmh`` (0: none), without sign if
    ``unsigned``.
    A share ``dropout_share`` is missing in gaps of ``dropout_s``; a sensor is ``dead`` with that probability from some
    moment of the drive on: then it repeats its last value or reads 0.
    """

    rate_hz: float = bounded_field(20.0, 0.5, 200.0)
    mean_s: float = bounded_field(0.0, 0.0, 2.0)
    scale: float = bounded_field(0.0, -0.2, 0.2)
    warm: float = bounded_field(0.003, 0.0, 0.05)
    warm_s: float = bounded_field(600.0, 1.0, 1e5)
    growth: float = bounded_field(0.004, 0.0, 0.05)
    right_m: float = bounded_field(0.0, -2.0, 2.0)
    slip: float = bounded_field(0.004, 0.0, 0.1)
    slips_per_h: float = bounded_field(0.0, 0.0, 1000.0)
    slip_share: float = bounded_field(0.1, -1.0, 2.0)
    slip_s: float = bounded_field(3.0, 0.1, 60.0)
    locks: float = bounded_field(0.0, 0.0, 1.0)
    lock_s: float = bounded_field(0.5, 0.0, 10.0)
    noise: float = bounded_field(0.02, 0.0, 5.0)
    tick_m: float = bounded_field(0.0, 0.0, 5.0)
    step_kmh: float = bounded_field(0.0, 0.0, 10.0)
    delay_s: float = bounded_field(0.1, -1.0, 2.0)
    jitter_s: float = bounded_field(0.0, 0.0, 0.5)
    unsigned: bool = False
    dropout_share: float = bounded_field(0.0, 0.0, 0.9)
    dropout_s: float = bounded_field(5.0, 0.1, 600.0)
    dead: float = bounded_field(0.0, 0.0, 1.0)


@dataclass(frozen=True)
class HeadingConfig(Ranged, where="sensors.heading"):
    """A dual-antenna receiver: white noise ``std_deg``, antennas turned by ``offset_deg`` in the car."""

    rate_hz: float = bounded_field(5.0, 0.1, 100.0)
    std_deg: float = bounded_field(0.3, 0.0, 20.0)
    offset_deg: float = bounded_field(0.0, -10.0, 10.0)


@dataclass(frozen=True)
class BaroConfig(Ranged, where="sensors.baro"):
    """A barometer: white noise ``noise_m``, an offset, a random walk per √s, and what the wind of the drive adds at
    30 m/s (it grows with the square of the speed)."""

    rate_hz: float = bounded_field(10.0, 0.1, 100.0)
    noise_m: float = bounded_field(0.3, 0.0, 50.0)
    offset_m: float = bounded_field(20.0, -1000.0, 1000.0)
    walk_m: float = bounded_field(0.02, 0.0, 5.0)
    wind_m: float = bounded_field(0.0, -50.0, 50.0)


@dataclass(frozen=True)
class SensorsConfig:
    """The further sensors of a car; None: it has none of that kind."""

    wheel: WheelConfig | None = None
    heading: HeadingConfig | None = None
    baro: BaroConfig | None = None


class _Motion(NamedTuple):
    """Of the rear axle's middle, at the times ``t``."""

    t: Array
    speed: Array  # m/s, forward
    turn: Array  # rad/s about down
    yaw: Array
    height: Array


def sense(seed: np.random.SeedSequence, config: SensorsConfig, axle: Truth, turn: Array) -> dict[str, pd.DataFrame]:
    """Tables of a car's further sensors by name; ``turn`` [rad/s] is the rate about down at the axle's times."""
    C = rotation_from_rpy(torch.from_numpy(axle.rpy)).numpy()
    speed = np.einsum("ti,ti->t", C[..., 0], axle.v_n)
    motion = _Motion(axle.t, speed, turn, np.unwrap(axle.rpy[:, 2]), axle.height)
    wheel_rng, heading_rng, baro_rng = (np.random.default_rng(s) for s in seed.spawn(3))
    tables = {}
    if config.wheel is not None:
        tables["speed"] = wheel_speeds(wheel_rng, config.wheel, motion)
    if config.heading is not None:
        t = _times(motion.t, config.heading.rate_hz)
        heading = np.interp(t, motion.t, motion.yaw) + np.radians(config.heading.offset_deg)
        heading += np.radians(config.heading.std_deg) * heading_rng.standard_normal(len(t))
        tables["heading"] = pd.DataFrame(
            {"t": t, "heading": wrap_angle(heading), "std": np.radians(config.heading.std_deg)}
        )
    if config.baro is not None:
        tables["baro"] = _pressures(baro_rng, config.baro, motion)
    return tables


def wheel_speeds(rng: np.random.Generator, config: WheelConfig, motion: _Motion) -> pd.DataFrame:
    """``t``, ``speed`` of a wheel. InputError where the rate is faster than the truth's."""
    dt = float(motion.t[1] - motion.t[0])
    if config.rate_hz * dt > 1 + 1e-9:
        raise InputError(f"sensors.wheel: rate_hz {config.rate_hz:g} is above the IMU's {1 / dt:g}")
    turning = _turning(rng, config, motion, dt)
    distance = np.concatenate(([0.0], np.cumsum(0.5 * (turning[1:] + turning[:-1]) * dt)))
    t = _times(motion.t, config.rate_hz)
    last = t - config.delay_s + config.jitter_s * rng.uniform(-0.5, 0.5, len(t))
    limits = np.concatenate((last[:1] - 1 / config.rate_hz, last))
    limits = np.maximum.accumulate(limits + 1e-9 * np.arange(len(limits)))
    first = limits[1:] - config.mean_s if config.mean_s > 0 else limits[:-1]
    ends = np.stack((first, limits[1:]))
    reached = np.interp(ends, motion.t, distance)
    reached += turning[0] * np.minimum(ends - motion.t[0], 0.0)  # as fast before the drive begins
    if config.tick_m > 0:
        reached = config.tick_m * np.floor(reached / config.tick_m + rng.uniform())
    nominal = (config.mean_s or 1 / config.rate_hz) if config.tick_m > 0 else (limits[1:] - first).clip(1e-3)
    way = np.diff(reached, axis=0)[0]
    speed = way / nominal + config.noise * rng.standard_normal(len(t)) * (way != 0)
    if config.unsigned:
        speed = np.abs(speed)
    if config.step_kmh > 0:
        step = config.step_kmh * KMH
        speed = step * np.round(speed / step)
    if rng.uniform() < config.dead:
        first = int(rng.uniform(0.3, 0.9) * len(speed))
        speed[first:] = 0.0 if rng.uniform() < 0.5 else speed[first]
    keep = np.ones(len(t), bool)
    if config.dropout_share > 0:
        length = max(1, round(config.dropout_s * config.rate_hz))
        for start in rng.integers(0, len(t), round(config.dropout_share * len(t) / length)):
            keep[start : start + length] = False
    return pd.DataFrame({"t": t[keep], "speed": speed[keep]})


def _turning(rng: np.random.Generator, config: WheelConfig, motion: _Motion, dt: float) -> Array:
    """Speed of the tread by the nominal radius [m/s]."""
    v = motion.speed - config.right_m * motion.turn
    width = max(1, round(0.3 / dt))
    accel = np.convolve(np.gradient(motion.speed, dt), np.ones(width) / width, mode="same")
    warm = config.warm * (1 - np.exp(-(motion.t - motion.t[0]) / config.warm_s))
    scale = 1 + config.scale - warm - config.growth * (motion.speed / FAST) ** 2
    slip = config.slip * accel
    hours = (motion.t[-1] - motion.t[0]) / 3600
    for start in rng.uniform(motion.t[0], motion.t[-1], rng.poisson(config.slips_per_h * hours)):
        slip = np.where((motion.t >= start) & (motion.t < start + config.slip_s), config.slip_share, slip)
    locked = np.zeros(len(v), bool)
    hard = accel < -2.5
    for first in np.flatnonzero(hard[1:] & ~hard[:-1]):
        if rng.uniform() < config.locks:
            locked[first : first + round(config.lock_s / dt)] = True
    return np.where(locked, 0.0, scale * (1 + slip) * v)


def _pressures(rng: np.random.Generator, config: BaroConfig, motion: _Motion) -> pd.DataFrame:
    t = _times(motion.t, config.rate_hz)
    walk = config.walk_m * np.cumsum(rng.standard_normal(len(t))) / np.sqrt(config.rate_hz)
    wind = config.wind_m * (np.interp(t, motion.t, motion.speed) / FAST) ** 2
    white = config.noise_m * rng.standard_normal(len(t))
    height = np.interp(t, motion.t, motion.height) + config.offset_m + walk + wind + white
    return pd.DataFrame({"t": t, "pressure": SEA_LEVEL_PA * (1 - height / SCALE_M) ** (1 / EXPONENT)})


def _times(t: Array, rate_hz: float) -> Array:
    """Stamps of a sensor's own clock phase within a drive."""
    return np.arange(t[0] + 0.37 / rate_hz, t[-1], 1 / rate_hz)
