"""Simulated drives whose IMU errors are exactly those of a filter's model, for consistency tests (R020, R090).

A filter of 15 states models biases alone, one of 21 also scale factors, one of 33 also misalignment; so each has
drives of its own, with the errors that it does not model switched off, and is given the same preset. GNSS errors
are white, its antenna is the IMU, and every drive has a new unit and a new car.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.ranges import draw_ranges
from dlkf.base.settings import Ranged, bounded_field, settings_from
from dlkf.data.drive import Batch, Drive
from dlkf.data.segments import Segment, StartLaw, make_batch
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import Columns, DriveRow
from dlkf.data.validate import CheckedTables
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ErrorStates
from dlkf.simulation.imu import corrupt, draw_unit, inverse_mechanisation
from dlkf.simulation.motion.chassis import ChassisConfig, apply_mounting, draw_car
from dlkf.simulation.motion.routes import VehicleConfig
from dlkf.simulation.motion.vehicle import Truth, follow_route, radians_per_metre, random_route
from dlkf.simulation.tables import fix_columns, imu_columns, reference_columns


@dataclass(frozen=True)
class MatchedDrives(Ranged, where="consistency"):
    """How many drives, how long, and what a filter is given: 1 Hz GNSS and start errors, 1σ."""

    drives: int = bounded_field(100, 2, 10**6)
    minutes: float = bounded_field(5.0, 0.5, 60)
    rate_hz: int = bounded_field(50, 10, 1000)
    position_m: float = bounded_field(0.02, 1e-15, 1e3)
    velocity_mps: float = bounded_field(0.05, 1e-15, 1e3)
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    chassis: ChassisConfig = field(default_factory=ChassisConfig)
    start: StartLaw = field(default_factory=StartLaw)
    seed: int = 0
    cars: Mapping[str, Any] | None = None  # ranges that the chassis of each drive is drawn from, if any


def make_matched_drives(spec: ImuSpec, states: ErrorStates) -> ImuSpec:
    """The preset without the errors that a filter with these states does not model."""
    names = ("warm_up", "g_sensitivity", "quantisation", "full_scale", "wander", "unevenness")
    left_out: dict[str, float] = dict.fromkeys(names, 0.0)
    if states.matrix == "none":
        left_out["scale_factor"] = 0.0
    if states.matrix != "full":
        left_out["misalignment"] = 0.0

    def of(sensor: SensorErrors) -> SensorErrors:
        return replace(sensor, **left_out)

    return replace(spec, name=f"{spec.name}, {states.matrix}", accel=of(spec.accel), gyro=of(spec.gyro))


def make_matched_batch(
    settings: MatchedDrives, spec: ImuSpec, progress: ProgressCallback = no_progress
) -> tuple[Batch, Tensor]:
    """The drives as one batch, and the units' matrices M (B, 2, 3, 3).

    ``true_imu_error`` of the batch is the bias b(t) alone, without M.
    """
    drives, matrices = [], []
    for k in range(settings.drives):
        drive, matrix = _drive(settings, spec, k)
        drives.append(drive)
        matrices.append(torch.from_numpy(matrix))
        progress(k + 1, settings.drives)
    epochs = min(d.epochs for d in drives)
    batch = make_batch(
        drives,
        [Segment(k, 0, epochs) for k in range(len(drives))],
        dtype=torch.float64,
        start=settings.start,
        generator=torch.Generator().manual_seed(settings.seed),
    )
    return batch, torch.stack(matrices)


def _drive(settings: MatchedDrives, spec: ImuSpec, index: int) -> tuple[Drive, np.ndarray]:
    seeds = np.random.SeedSequence(settings.seed, spawn_key=(index,)).spawn(5)
    motion, unit_rng, imu_rng, gnss_rng, car_rng = (np.random.default_rng(s) for s in seeds)
    rate = settings.rate_hz
    t = np.arange(round(settings.minutes * 60) * rate + 1) / rate
    route = random_route(motion, settings.vehicle, float(t[-1]))
    truth = follow_route(route, settings.vehicle, t)
    chassis = settings.chassis
    if settings.cars is not None:
        seed = np.random.SeedSequence(settings.seed, spawn_key=(index, 1))
        chassis = settings_from(ChassisConfig, draw_ranges(settings.cars, seed), "chassis")
    if not chassis.is_point:
        truth = apply_mounting(car_rng, draw_car(car_rng, chassis), route, truth)
    exact, unit = inverse_mechanisation(truth), draw_unit(unit_rng, spec)
    measured, error = corrupt(imu_rng, exact, spec, unit, rate)
    bias = error - np.concatenate((exact[:, :3] @ unit.matrix[0].T, exact[:, 3:] @ unit.matrix[1].T), -1)
    tables = CheckedTables(
        DriveRow(f"matched-{index:03d}", f"matched-{index:03d}", (0.0, 0.0, 0.0)),
        imu_columns(t[1:], measured),
        _gnss(settings, gnss_rng, truth, rate),
        reference_columns(truth.at(slice(None, None, rate)), np.concatenate((bias[:1], bias))[::rate]),
    )
    return drive_from_tables(tables, "matched", float(rate), 1.0, torch.float64), unit.matrix


def _gnss(settings: MatchedDrives, rng: np.random.Generator, truth: Truth, rate: int) -> Columns:
    """Fixes once a second, from the first second on, with white errors."""
    rows = slice(rate, None, rate)
    n = len(truth.t[rows])
    off = settings.position_m * rng.standard_normal((n, 3))
    east, north = radians_per_metre(truth.lat[rows], truth.height[rows])
    place = (truth.lat[rows] + off[:, 0] * north, truth.lon[rows] + off[:, 1] * east, truth.height[rows] - off[:, 2])
    velocity = truth.v_n[rows] + settings.velocity_mps * rng.standard_normal((n, 3))
    std = np.repeat([[settings.position_m] * 3 + [settings.velocity_mps] * 3], n, axis=0)
    quality = np.full(n, 4, dtype=np.int64)
    return fix_columns(truth.t[rows], *place, velocity, std, quality)
