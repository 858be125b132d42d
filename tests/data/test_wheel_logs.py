"""Wheels with gaps, marks of invalid values, and counters that begin again or are set to another value."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.aid_checks import check_aid
from dlkf.data.discovery.motion import Motion, find_motion
from dlkf.data.discovery.wheel import find_force_lag, find_wheel
from dlkf.data.readers.counters import count_rates
from tests.cars import car
from tests.data.test_csv import log_reader

T = np.arange(0, 420, 0.05)
SPEED = np.clip(12 + 9 * np.sin(T / 11) + 4 * np.sin(T / 3.1), 0, None)
TICKS = np.floor(40 * np.cumsum(0.05 * SPEED))  # 40 a metre
TICK = 1 / 0.05  # a tick in a step, as a rate


def _set_to(counts: np.ndarray, row: int, value: float) -> np.ndarray:
    out = counts.copy()
    out[row:] += value - counts[row]
    return out


COUNTERS = {  # counts, rows whose rate is unknown
    "never": (TICKS, 0),
    "16 bits": ((TICKS + 30_000) % 2**16, 0),
    "16 bits with a sign": ((TICKS + 30_000) % 2**16 - 2**15, 0),
    "12 bits": (TICKS % 2**12, 0),
    "at 1000": (TICKS % 1000, 0),
    "at 720": (TICKS % 720, 0),
    "backward through zero": (-TICKS % 2**16, 0),
    "set to 0 once": (_set_to(TICKS, 5000, 0.0), 1),
    "set to 0 twice": (_set_to(_set_to(TICKS, 5000, 0.0), 5400, 0.0), 2),
    "set to 7 after a little": (_set_to(TICKS, 200, 7.0), 1),
    "unknown counts": (np.where(np.isin(np.arange(len(T)), [700, 4000]), np.nan, TICKS), 4),
}


@pytest.mark.parametrize("case", COUNTERS)
def test_the_rates_of_a_counter(case):
    """To the tick that they are rounded to; where a counter was set nothing is known, and nothing else is lost."""
    counts, unknown = COUNTERS[case]
    rates = count_rates(T, counts)
    assert np.isnan(rates).sum() == unknown
    known = np.isfinite(rates)
    np.testing.assert_allclose(np.abs(rates[known]), 40 * SPEED[1:][known], atol=1.01 * TICK)


def test_counts_far_apart_have_no_rate():
    kept = (T < 100) | (T > 104)
    rates = count_rates(T[kept], TICKS[kept])
    assert np.isnan(rates).sum() == 1 and np.isnan(rates[int((T < 100).sum()) - 1])


def _gnss() -> Motion:
    at = np.arange(0.0, 420.0)
    return Motion(at, np.interp(at, T, SPEED) + 0j, np.zeros(len(at)))


DAMAGES = {
    "none": lambda v: v,
    "a gap of 25 s": lambda v: np.where((T > 100) & (T < 125), np.nan, v),
    "gaps all over": lambda v: np.where(np.sin(T / 20) > 0.6, np.nan, v),
    "marks of 16 bits": lambda v: np.where(np.arange(len(T)) % 300 == 7, 65535.0, v),
    "one wild value": lambda v: np.where(np.arange(len(T)) == 3000, 36_947.0, v),
    "locked wheels for 2 s": lambda v: np.where((T >= 150) & (T <= 152), 0.0, v),
    "a locked wheel for 10 s": lambda v: np.where((T > 200) & (T < 210), 0.0, v),
}


@pytest.mark.parametrize("case", DAMAGES)
@pytest.mark.parametrize("lag_s", [0.0, 0.73])
def test_the_clock_and_scale_of_a_damaged_wheel(case, lag_s):
    """To 20 ms, the step of the search, and a thousandth."""
    wheel = find_wheel(T - lag_s, DAMAGES[case](3.6 * SPEED), _gnss())
    assert wheel is not None and wheel.clear
    assert abs(wheel.lag_s - lag_s) < 0.02 and wheel.scale == pytest.approx(1 / 3.6, rel=1e-3)


def test_one_of_two_wheels_is_enough_and_marks_are_unknown(tmp_path):
    """Empty cells of one, −1 of both, speeds beyond any car."""
    tables = car(60, gnss_hz=10)
    for kind in ("imu", "gnss"):
        tables[kind].to_csv(tmp_path / f"{kind}.csv", index=False)
    speed = np.hypot(tables["gnss"].vel_n, tables["gnss"].vel_e)
    wheels = pd.DataFrame({"t": tables["gnss"].t, "left": speed, "right": speed})
    wheels.loc[100:200, "left"] = np.nan
    wheels.loc[300:310, ["left", "right"]] = -1.0
    wheels.loc[400:401, ["left", "right"]] = 10_263.0
    wheels.to_csv(tmp_path / "wheel.csv", index=False)
    value = {"columns": ["left", "right"], "unit": "m/s"}
    said = {"file": "wheel.csv", "time": {"column": "t"}, "rows": "filled", "value": value}
    (drive,) = log_reader(speed=said).read(tmp_path)
    table = drive.aids["speed"]
    assert len(table) == len(wheels) - 13
    np.testing.assert_allclose(table.speed, np.interp(table.t, tables["gnss"].t, speed), atol=1e-9)
    assert sum("left out 2 of" in note and "beyond 120 m/s" in note for note in drive.notes) == 1


@pytest.mark.parametrize("lag_s", [-2.2, 0.0, 0.73])
def test_the_clock_of_a_wheel_by_the_imu(lag_s):
    """On hills, with noise; to 50 ms. Another axis, and a constant speed, show nothing."""
    rng = np.random.default_rng(2)
    hills = 0.5 * np.sin(T / 40)
    forward = np.gradient(SPEED, T) + hills + rng.normal(0, 0.5, len(T))
    found = find_force_lag(T - lag_s, 1.02 * SPEED, T, forward)
    assert found is not None and abs(found[0] - lag_s) < 0.05 and found[1] > 0.9
    for speed, force in ((SPEED, hills), (0 * SPEED + 9, forward), (SPEED, rng.normal(0, 1, len(T)))):
        assert find_force_lag(T, speed, T, force) is None


@pytest.mark.parametrize("late_s", [0.0, 1.5])
def test_a_wheel_has_the_clock_of_the_imu_where_the_speed_of_gnss_is_late(tmp_path, late_s):
    """As phones give it; the check of a dataset takes such a wheel too, and refuses one on another clock."""
    tables = car(120)
    imu, gnss = tables["imu"], tables["gnss"]
    speed, truth = np.hypot(gnss.vel_n, gnss.vel_e), tables["reference"]
    late = {c: np.interp(gnss.t - late_s, truth.t, truth[c]) for c in ("vel_n", "vel_e")}
    imu.to_csv(tmp_path / "imu.csv", index=False)
    gnss.assign(**late).to_csv(tmp_path / "gnss.csv", index=False)
    at = np.arange(1, 119, 0.1)
    pd.DataFrame({"t": at - 0.7, "v": np.interp(at, gnss.t, speed)}).to_csv(tmp_path / "wheel.csv", index=False)
    said = {"file": "wheel.csv", "time": {"column": "t", "offset_s": "auto"}, "value": {"columns": ["v"]}}
    (drive,) = log_reader(speed=said).read(tmp_path)
    assert drive.mapping["speed"]["time"]["offset_s"] == pytest.approx(0.7, abs=0.05)
    assert any("that speed is 1.5 s late" in note for note in drive.notes) == (late_s > 0)
    samples, moved = ({c: x[c].to_numpy() for c in x} for x in (imu, gnss.assign(**late)))
    wheel = {"t": at, "speed": np.interp(at, gnss.t, speed)}
    check_aid("speed", wheel, samples, find_motion(moved), "a")
    with pytest.raises(InputError, match="the clock of the speed is"):
        check_aid("speed", {**wheel, "t": at - 1.2}, samples, find_motion(moved), "a")
