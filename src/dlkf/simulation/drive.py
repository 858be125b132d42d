"""One simulated drive: a seed to truth, to IMU, to GNSS, to the three tables of the data contract."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.simulation.gnss.receiver import Receiver
from dlkf.simulation.gnss.satellite_fixes import delay_fixes, receive
from dlkf.simulation.gnss.surroundings import Surroundings, sky_along
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.imu import ImuUnit, corrupt, interval_means, inverse_mechanisation
from dlkf.simulation.motion.chassis import Car, ChassisConfig, apply_mounting, draw_car, slip_angle
from dlkf.simulation.motion.routes import VehicleConfig
from dlkf.simulation.motion.vehicle import Route, Truth, follow_route, random_route
from dlkf.simulation.sensors import SensorsConfig, sense
from dlkf.simulation.tables import imu_columns, reference_columns


class Seeds(NamedTuple):
    """One seed for each part of a drive."""

    motion: np.random.SeedSequence
    imu: np.random.SeedSequence
    gnss: np.random.SeedSequence
    surroundings: np.random.SeedSequence
    chassis: np.random.SeedSequence


@dataclass(frozen=True)
class Rates:
    """Sample rates [Hz]; the IMU's is a multiple of the other two.

    An IMU sample is the mean of ``imu_parts`` parts; 0 gives the constant rate and force that act like its interval.
    """

    imu_hz: int
    gnss_hz: float
    reference_hz: int
    imu_parts: int = 0


@dataclass(frozen=True)
class SimulatedTables:
    """The tables of one drive, and what is worth knowing of it: a row of ``drives.parquet``.

    The IMU error in a row of the reference is that of the sample which ends there, without white noise.
    """

    imu: pd.DataFrame
    gnss: pd.DataFrame
    reference: pd.DataFrame
    raw: pd.DataFrame | None  # GNSS observations, where fixes come from satellites
    facts: dict[str, float]
    aids: dict[str, pd.DataFrame] = field(default_factory=dict)  # of further sensors


def simulate_drive(
    seeds: Seeds,
    duration_s: int,
    rates: Rates,
    vehicle: VehicleConfig,
    chassis: ChassisConfig,
    surroundings: Surroundings,
    spec: ImuSpec,
    unit: ImuUnit,
    gnss: GnssConfig,
    receiver: Receiver | None = None,
    sensors: SensorsConfig | None = None,
    sensor_seed: np.random.SeedSequence | None = None,
) -> SimulatedTables:
    """One drive; each part has a seed of its own, so changing one leaves the others as they were."""
    motion_rng, imu_rng, gnss_rng, sky_rng, chassis_rng = (np.random.default_rng(seed) for seed in seeds)
    parts = max(rates.imu_parts, 1)
    t = np.arange(duration_s * rates.imu_hz * parts + 1) / (rates.imu_hz * parts)
    route = random_route(motion_rng, vehicle, float(duration_s))
    car = draw_car(chassis_rng, chassis)
    axle = follow_route(route, vehicle, t)
    truth = axle if chassis.is_point and not vehicle.is_banked else apply_mounting(chassis_rng, car, route, axle)
    true_imu = interval_means(truth, parts) if rates.imu_parts else inverse_mechanisation(truth)
    t, axle, truth = t[::parts], *(x.at(slice(None, None, parts)) for x in (axle, truth))
    measured, error = corrupt(imu_rng, true_imu, spec, unit, rates.imu_hz)
    fixes = np.arange(0, len(t), round(rates.imu_hz / rates.gnss_hz))
    rows = slice(None, None, rates.imu_hz // rates.reference_hz)
    sky = sky_along(sky_rng, surroundings, route.motion(t[fixes]).distance)
    seen, rate_b = delay_fixes(truth, _rate_at_rows(true_imu[:, 3:]), fixes, gnss, rates.imu_hz)
    received = receive(gnss_rng, seen, rate_b, gnss, receiver, sky)
    return SimulatedTables(
        imu=pd.DataFrame(imu_columns(t[1:], measured)),
        gnss=received.fixes,
        reference=pd.DataFrame(reference_columns(truth.at(rows), np.concatenate((error[:1], error))[rows])),
        raw=received.raw,
        facts=_facts(car, route, axle, truth, rates.imu_hz),
        aids={}
        if sensors is None
        else sense(sensor_seed or np.random.SeedSequence(0), sensors, axle, route.motion(axle.t).yaw_rate),
    )


def _rate_at_rows(rate: NDArray[np.floating]) -> NDArray[np.floating]:
    """Body rate at the N+1 truth rows from the N sample means between them: the mean of both neighbours."""
    padded = np.concatenate((rate[:1], rate, rate[-1:]))
    return 0.5 * (padded[1:] + padded[:-1])


def _facts(car: Car, route: Route, axle: Truth, truth: Truth, rate_hz: int) -> dict[str, float]:
    """Distance, velocity across the car while it moves (RMS, above 2 m/s), and the car itself.

    ``lateral_axle_mps`` is the rear axle's in the car, ``lateral_imu_mps`` and ``down_imu_mps`` the IMU's in its
    own axes, as a constraint of a filter would see them.
    """
    motion = route.motion(axle.t)
    moving = motion.speed > 2.0
    v_b = np.einsum("tij,ti->tj", rotation_from_rpy(torch.from_numpy(truth.rpy)).numpy(), truth.v_n)
    across = motion.speed * np.sin(slip_angle(car, route, motion)[0]), v_b[:, 1], v_b[:, 2]
    rms = (float(np.sqrt(np.mean(v[moving] ** 2))) if moving.any() else 0.0 for v in across)
    return {
        "distance_m": float(np.linalg.norm(truth.v_n, axis=1)[1:].sum() / rate_hz),
        **dict(zip(("lateral_axle_mps", "lateral_imu_mps", "down_imu_mps"), rms)),
        **{f"imu_arm_{axis}_m": float(x) for axis, x in zip("xyz", car.imu_arm)},
        **{f"mounting_{name}_deg": float(np.degrees(x)) for name, x in zip(("roll", "pitch", "yaw"), car.mounting)},
        "sideslip_s2pm": car.sideslip,
    }
