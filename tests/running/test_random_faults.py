"""Phases of random faults in a stream, each followed by good data: how many filters are still off afterwards.

``python -m pytest -m mutations tests/running/test_random_faults.py -s`` prints the counts; some minutes.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from dlkf.data.store import drive_rows
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.running.streaming import Status, StreamingFilter
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from tests.running.streams import EARTH, IMU
from tests.running.test_recovery import estimator

MINUTES, QUIET_S, FAULTY_S, GOOD_S, LIMIT_M = 80, 55.0, 45.0, 45.0, 5.0
WRONG = (math.nan, math.inf, -math.inf, 1e300, -1e30, 0.0, 1e9, -1.0, 35.0, 390.0)


@pytest.fixture(scope="module")
def hour(tmp_path_factory) -> CheckedTables:
    """A long drive in a town."""
    config = DatasetConfig("hour", hours=MINUTES / 60, drive_minutes=float(MINUTES), imu_rate_hz=50)
    made = simulate_dataset(config, IMU, 1, tmp_path_factory.mktemp("hour") / "d", progress=False, workers=1)
    return read_drive(made, drive_rows(made)[0])


def changed(rng: np.random.Generator, sample: list[float], among: int) -> list[float]:
    """One number of a sample in the place of which stands another."""
    sample = list(sample)
    k = int(rng.integers(among))
    sample[k] = WRONG[int(rng.integers(len(WRONG)))] if rng.random() < 0.5 else sample[k] * rng.normal(1, 3)
    return sample


def moved(rng: np.random.Generator, fix: list[float]) -> list[float]:
    """A fix metres to a hundred kilometres off."""
    fix = list(fix)
    fix[1] += float(np.degrees(10 ** rng.uniform(0, 5) / EARTH))
    return fix


@pytest.mark.mutations
@pytest.mark.parametrize("name", ["mbkf15", "mbkf21_car", "mbkf21_nhc_gated", "plus"])
def test_phases_of_random_faults(hour, name):
    """Of all phases; an estimate is finite and on Earth at any time, and nothing is raised."""
    rng = np.random.default_rng(1)
    stream = StreamingFilter(estimator(name), lever_arm_b=hour.row.lever_arm_b)
    imu, gnss = hour.imu, hour.gnss
    truth = [np.interp(imu["t"], hour.reference["t"], hour.reference[c]) for c in ("lat_deg", "lon_deg")]
    samples = np.stack([imu[c] for c in ("t", "accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")], -1)
    fields = ("t", "lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d")
    fixes = np.stack([gnss[c] for c in fields], -1)
    late: list[list[float]] = []
    calls = faults = next_fix = 0
    off: list[float] = []
    for k, row in enumerate(samples.tolist()):
        t = row[0]
        phase = (t - QUIET_S) % (FAULTY_S + GOOD_S) if t > QUIET_S else math.inf
        bad = phase < FAULTY_S
        given = [row]
        if bad and rng.random() < 0.02:
            faults += 1
            kind = int(rng.integers(4))
            given = ([], [row, row], [changed(rng, row, 7)], [[t - 5.0, *row[1:]], row])[kind]
        while next_fix < len(fixes) and fixes[next_fix, 0] <= t:
            fix = fixes[next_fix].tolist()
            next_fix += 1
            offered = [fix]
            if bad and rng.random() < 0.3:
                faults += 1
                kind = int(rng.integers(5))
                offered = ([], [fix, fix], [changed(rng, fix, 7)], [moved(rng, fix)], [])[kind]
                if kind == 4:
                    late.append(fix)
            elif late and rng.random() < 0.5:
                offered.append(late.pop())
            for f in offered:
                calls += 1
                stream.gnss(f[0], f[1], f[2], f[3], f[4:7])
        for x in given:
            calls += 1
            for estimate in stream.imu(x[0], x[1:4], x[4:]).estimates:
                row_of = estimate.row
                assert all(math.isfinite(row_of[c]) for c in ("lat_deg", "lon_deg", "height_m", "vel_n", "yaw"))
                assert abs(row_of["height_m"]) < 20e3
        last = k + 1 == len(samples) or (samples[k + 1, 0] - QUIET_S) % (FAULTY_S + GOOD_S) < phase
        if t > QUIET_S and last and phase > GOOD_S + FAULTY_S - 1 and (now := stream.now()) is not None:
            error = np.radians([now.row["lat_deg"] - truth[0][k], now.row["lon_deg"] - truth[1][k]])
            off.append(float(np.hypot(error[0], error[1] * np.cos(np.radians(truth[0][k]))) * EARTH))
    wrong = [round(x, 1) for x in off if x > LIMIT_M]
    refused = stream.counts[Status.REFUSED]
    print(f"\n{name}: {calls} calls, {faults} faults, {refused} refused, {len(off)} phases, {len(wrong)} off: {wrong}")
    assert len(off) > 40 and refused > 500 and max(off) < 4 * LIMIT_M and len(wrong) < 0.1 * len(off)
