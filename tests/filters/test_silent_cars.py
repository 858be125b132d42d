"""Cars without vibration, made by python-ins: constant speed for minutes is no standstill, in outages of 120 s."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import pytest
import torch
from pipelines.studies.parity import POSITION_STD, RATE, START, VELOCITY_STD
from pyins import sim
from pyins.util import ACCEL_COLS, GYRO_COLS, LLA_COLS, VEL_COLS

from dlkf.command.composing import imu_preset
from dlkf.data.masks import withhold_fixes
from dlkf.data.schema import write_drive, write_drives_table
from dlkf.data.segments import cut_segments, make_batch
from dlkf.data.store import load_dataset
from dlkf.filters.build import build_filter
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.plus import ANY_MEMS, START_TUNING
from dlkf.filters.shipped import trained_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.batched import run_filter
from dlkf.simulation.imu import corrupt, draw_unit
from dlkf.simulation.motion.vehicle import Truth
from dlkf.simulation.tables import fix_columns, imu_columns, reference_columns

OUTAGES = ((240, 360),)  # s
SPEEDS, STRAIGHT = (6.7, 17.1, 5.0, 20.0), 2  # m/s; so many of the cars drive straight on


def silent_drive(folder, seed: int, speed: float, straight: bool) -> dict:
    """Six minutes: stops, changing speed, and in the outage ``speed`` [m/s] straight on or with curves."""
    t = np.arange(380 * RATE + 1) / RATE
    motion, unit, errors, gnss = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
    known = [0, 15, 35, 75, 100, 110, 130, 200, 220, 380]
    at = np.array([0, 0, 12, 5, 8, 0, 0, 1.2 * speed, speed, speed])  # 0: at rest
    v = np.interp(t, known, at)
    smooth = np.hanning(2 * RATE + 1) / np.hanning(2 * RATE + 1).sum()
    v = np.convolve(np.pad(v, RATE, "edge"), smooth, "valid")
    wave = np.sin(2 * np.pi * t / 41 + motion.uniform(0, 6))
    rate = 0.4 * np.sign(wave) * np.maximum(0, np.abs(wave) - 0.5) * np.minimum(1, v / 5)  # a third straight on
    if straight:
        rate *= 1 - sum(np.interp(t, [a - 20, a - 10, b, b + 10], [0, 1, 1, 0]) for a, b in OUTAGES)
    yaw = motion.uniform(-3, 3) + np.cumsum(rate) / RATE
    v_n = v[:, None] * np.stack((np.cos(yaw), np.sin(yaw), 0 * yaw), -1)
    rpy = np.stack((0 * yaw, 0 * yaw, yaw), -1)
    trajectory, imu = sim.generate_imu(t, (50.0, 8.0, 200.0), np.degrees(rpy), v_n, "increment")
    spec = imu_preset("consumer")
    exact = imu[[*ACCEL_COLS, *GYRO_COLS]].to_numpy()[1:] * RATE
    measured, error = corrupt(errors, exact, spec, draw_unit(unit, spec), RATE)
    each = trajectory.iloc[::RATE]
    lat, lon = np.radians(each[LLA_COLS].to_numpy()[:, :2]).T
    truth = Truth(each.index.to_numpy(), lat, lon, each["alt"].to_numpy(), each[VEL_COLS].to_numpy(), rpy[::RATE])
    fixes = each.iloc[1:]
    position = sim.generate_position_measurements(fixes, POSITION_STD, gnss.integers(2**31)).to_numpy()
    velocity = sim.generate_ned_velocity_measurements(fixes, VELOCITY_STD, gnss.integers(2**31)).to_numpy()
    std = np.tile((POSITION_STD,) * 3 + (VELOCITY_STD,) * 3, (len(fixes), 1))
    rows = fix_columns(
        fixes.index.to_numpy(), *np.radians(position[:, :2]).T, position[:, 2], velocity, std, np.full(len(fixes), 4)
    )
    error_at = np.concatenate((error[:1], error))[::RATE][: len(each)]
    return write_drive(
        folder, {"drive": f"silent-{seed}"}, pd.DataFrame(imu_columns(t[1:], measured)), pd.DataFrame(rows),
        pd.DataFrame(reference_columns(truth, error_at)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def silent(tmp_path_factory):
    """Four cars at 5 to 20 m/s with an outage of 120 s, and the row at whose end it ends."""
    folder = tmp_path_factory.mktemp("silent")
    write_drives_table(folder, [silent_drive(folder, k, speed, k < STRAIGHT) for k, speed in enumerate(SPEEDS)])
    drives = load_dataset(folder, rate_hz=50.0, dtype=torch.float64)
    law = {"start": START, "generator": torch.Generator().manual_seed(0)}
    batch = make_batch(drives, cut_segments(drives, 374.0), dtype=torch.float64, **law)
    begin = batch.t_start[0] + torch.arange(batch.size[1]) * batch.epoch_s
    hidden = sum((begin >= first) & (begin < last) for first, last in OUTAGES).bool()
    return withhold_fixes(batch, hidden), torch.nonzero(hidden[:-1] & ~hidden[1:]).flatten()


@dataclass(frozen=True)
class Watched(CarConstraints):
    """Constraints that record in which windows they take the car for stationary, and may leave that unused."""

    used: bool = True
    seen: list[torch.Tensor] = field(default_factory=list)

    def detect_rest(self, epoch, turning, prediction, memory):
        found, level, variance = super().detect_rest(epoch, turning, prediction, memory)
        self.seen.append(found)
        return found & self.used, level, variance


def classical():
    """``mbkf21_car`` for an IMU of which nothing is known, and so unsure of its speed after a minute."""
    return build_filter("mbkf21_car", imu_spec(ANY_MEMS), tuning=Tuning(**START_TUNING))


@pytest.fixture(scope="module")
def classically(silent):
    """The solution of the classical filter, and in which windows it took the cars for stationary."""
    return solve(silent[0], used=True)


def solve(batch, used: bool):
    """Whether stationary windows are used or only seen."""
    kalman = classical()
    eyes = [Watched(s.tuning, s.states, used=used) for s in kalman.sources if isinstance(s, CarConstraints)]
    estimator = replace(kalman, sources=(*(s for s in kalman.sources if not isinstance(s, CarConstraints)), *eyes))
    with torch.inference_mode():
        return run_filter(batch, estimator), torch.stack(eyes[0].seen, 1)


@pytest.mark.parametrize("name", ["mbkf21_car", pytest.param("plus", marks=pytest.mark.commands)])
def test_two_minutes_with_curves_are_bridged(silent, classically, name):
    """Horizontal RMS at the ends of the outages below 15 m."""
    batch, ends = silent
    with torch.inference_mode():
        solution = run_filter(batch, trained_filter("plus")) if name == "plus" else classically[0]
    off = (solution.posterior.p_n - batch.truth.p_n)[STRAIGHT:, ends, :2].norm(dim=-1)
    assert off.square().mean().sqrt() < 15, off


def test_straight_on_at_constant_speed_is_no_standstill(silent, classically):
    """Nothing shows the sensors' errors, so the filter drifts; it stops no car, and drifts as without the updates."""
    batch, ends = silent
    speed, errors = batch.truth.v_n.norm(dim=-1), []
    for solution, seen in (classically, solve(batch, used=False)):
        errors.append((solution.posterior.p_n - batch.truth.p_n)[:STRAIGHT, ends, :2].norm(dim=-1))
        assert not (seen & (speed > 1.0)).any()
        assert (seen & (speed < 0.01)).any()
    assert (errors[0] < 1.1 * errors[1] + 1.0).all(), errors
