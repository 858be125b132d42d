"""One simulated drive: settings, and a seed to truth, to IMU, to GNSS, to the three tables of the data contract."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
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

LONGEST_DRIVE = 240.0  # minutes; a drive is held in memory as a whole
MOST_EPOCHS = 100_000  # of a drive with satellites, 2 GB


@dataclass(frozen=True)
class DatasetConfig(Ranged, where="dataset"):
    """What to simulate. ``imu_errors``: ``one`` unit for all drives, a new one ``per_drive``, a ``fleet``, or ``wide``.

    With ``one``, turn-on bias, scale factors and misalignment are drawn once, from ``unit_seed``: the same
    IMU on other roads is another seed with the same ``unit_seed``. White noise and the in-run bias belong to
    each drive either way. With ``fleet``, each drive has a new unit of a type drawn from ``fleet``; with ``wide``, of
    a type of its own, drawn from the ranges of the IMU preset.
    An IMU sample is the mean over its interval, taken of ``imu_parts`` parts; 0 gives the constant rate and force that
    act like the interval, which loading corrects for coning a second time (some mm in a minute with little vibration).
    Fixes come from the satellites in view of a ``receiver``, or have white noise without one; ``raw`` keeps its
    observations as well.
    """

    name: str
    hours: float = bounded_field(5.0, 0.005, 1e5)
    drive_minutes: float = bounded_field(10.0, 0.25, LONGEST_DRIVE)
    imu_rate_hz: int = bounded_field(100, 10, 2000)
    reference_rate_hz: int = bounded_field(10, 1, 2000)
    imu_parts: int = bounded_field(0, 0, 16)
    imu_errors: Literal["one", "per_drive", "fleet", "wide"] = "one"
    unit_seed: int = bounded_field(0, 0, 2**63)
    fleet: Mapping[str, ImuSpec] = field(default_factory=dict)
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    chassis: ChassisConfig = field(default_factory=ChassisConfig)
    surroundings: Surroundings = field(default_factory=Surroundings)
    gnss: GnssConfig = field(default_factory=GnssConfig)
    receiver: Receiver | None = None
    raw: bool = False
    sensors: SensorsConfig | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise InputError(f"dataset: name {self.name!r} must be letters, digits, _ . - ")
        super().__post_init__()
        rates = {"gnss.rate_hz": self.gnss.rate_hz, "reference_rate_hz": self.reference_rate_hz}
        for name, rate in rates.items():
            samples = self.imu_rate_hz / rate if rate > 0 else 0.0
            if samples < 1 or abs(samples - round(samples)) > 1e-9:
                raise InputError(f"dataset: imu_rate_hz {self.imu_rate_hz} is not a multiple of {name} {rate}")
        if self.imu_errors == "fleet" and not self.fleet:
            raise InputError("dataset: imu_errors is fleet, but fleet names no IMU presets (see simulated/fleet.yaml)")
        if not isinstance(self.raw, bool) or (self.raw and self.receiver is None):
            raise InputError(f"raw={self.raw}: there are raw observations with a satellite receiver=<preset> only")
        epochs = self.gnss.rate_hz * self.drive_minutes * 60
        if self.receiver is not None and epochs > MOST_EPOCHS:
            raise InputError(
                f"dataset: gnss.rate_hz {self.gnss.rate_hz} over drive_minutes {self.drive_minutes:g} are {epochs:.0f} "
                f"epochs of satellites, more than {MOST_EPOCHS}; make the drives shorter or the rate lower"
            )

    @property
    def durations(self) -> list[int]:
        """Whole seconds of every drive: the hours shared out evenly over drives of at most drive_minutes."""
        total = round(self.hours * 3600)
        drives = math.ceil(total / (self.drive_minutes * 60) - 1e-9)
        return [total // drives + (k < total % drives) for k in range(drives)]


class Seeds(NamedTuple):
    """One seed for each part of a drive."""

    motion: np.random.SeedSequence
    imu: np.random.SeedSequence
    gnss: np.random.SeedSequence
    surroundings: np.random.SeedSequence
    chassis: np.random.SeedSequence
    sensors: np.random.SeedSequence


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
    aids: dict[str, pd.DataFrame]  # of further sensors


def simulate_drive(
    seeds: Seeds, duration_s: int, config: DatasetConfig, spec: ImuSpec, unit: ImuUnit
) -> SimulatedTables:
    """One drive with a unit of an IMU; each part has a seed of its own, so changing one leaves the others as they
    were."""
    motion_rng, imu_rng, gnss_rng, sky_rng, chassis_rng = (np.random.default_rng(seed) for seed in seeds[:5])
    rate, parts, vehicle, gnss = config.imu_rate_hz, max(config.imu_parts, 1), config.vehicle, config.gnss
    t = np.arange(duration_s * rate * parts + 1) / (rate * parts)
    route = random_route(motion_rng, vehicle, float(duration_s))
    car = draw_car(chassis_rng, config.chassis)
    axle = follow_route(route, vehicle, t)
    is_point = config.chassis.is_point and vehicle.bank_std <= 0 and vehicle.superelevation <= 0
    truth = axle if is_point else apply_mounting(chassis_rng, car, route, axle)
    true_imu = interval_means(truth, parts) if config.imu_parts else inverse_mechanisation(truth)
    t, axle, truth = t[::parts], *(x.at(slice(None, None, parts)) for x in (axle, truth))
    measured, error = corrupt(imu_rng, true_imu, spec, unit, rate)
    fixes = np.arange(0, len(t), round(rate / gnss.rate_hz))
    rows = slice(None, None, rate // config.reference_rate_hz)
    sky = sky_along(sky_rng, config.surroundings, route.motion(t[fixes]).distance)
    seen, rate_b = delay_fixes(truth, _rate_at_rows(true_imu[:, 3:]), fixes, gnss, rate)
    received = receive(gnss_rng, seen, rate_b, gnss, config.receiver, sky)
    sensors = config.sensors
    return SimulatedTables(
        imu=pd.DataFrame(imu_columns(t[1:], measured)),
        gnss=received.fixes,
        reference=pd.DataFrame(reference_columns(truth.at(rows), np.concatenate((error[:1], error))[rows])),
        raw=received.raw,
        facts=_facts(car, route, axle, truth, rate),
        aids={} if sensors is None else sense(seeds.sensors, sensors, axle, route.motion(axle.t).yaw_rate),
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
