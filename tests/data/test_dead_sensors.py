"""Axes that stick while the car moves, of sensors with noise; coarse sensors and those of a simulation do not."""

from __future__ import annotations

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.data.dead_sensors import check_frozen
from dlkf.data.schema import ACCEL, GYRO, VELOCITY
from tests.cars import car


@pytest.fixture(scope="module")
def gnss():
    """Three minutes, of which the last half a minute is a standstill."""
    table = {name: x.to_numpy().copy() for name, x in car(180)["gnss"].items()}
    for name in VELOCITY:
        table[name][table["t"] > 150] = 0.0
    return table


@pytest.fixture
def imu():
    """Noise of 0.03 m/s² and 0.1 °/s, and three times that while the car moves."""
    table = {name: x.to_numpy().copy() for name, x in car(180)["imu"].items()}
    rng = np.random.default_rng(0)
    for name in (*GYRO, *ACCEL):
        std = np.where(table["t"] < 150, 3.0, 1.0) * (np.radians(0.1) if name in GYRO else 0.03)
        table[name] += std * rng.normal(size=len(std))
    return table


@pytest.mark.parametrize("name", ["accel_z", "accel_x", "gyro_z"])
@pytest.mark.parametrize(("begin", "end"), [(80.0, 80.7), (80.0, 85.0), (80.0, 200.0), (149.0, 170.0)])
def test_an_axis_that_sticks_is_refused(imu, gnss, name, begin, end):
    """At zero or its last value, for more than half a second in motion, up to the end or into a standstill."""
    there = (imu["t"] > begin) & (imu["t"] <= end)
    for value in (0.0, imu[name][np.argmax(there)]):
        imu[name][there] = value
        with pytest.raises(
            InputError, match=rf"town: {name} stays at .* from t = {begin:.1f}.*stuck or saturated"
        ) as error:
            check_frozen(imu, gnss, "town")
        assert "\n" not in str(error.value)
        assert ("dead band" in str(error.value)) == (name == "gyro_z" and value == 0)


def test_positions_alone_show_the_motion(imu, gnss):
    imu["gyro_z"][8000:8200] = 0.0
    alone = {**gnss, **{name: np.full(len(gnss["t"]), np.nan) for name in VELOCITY}}
    with pytest.raises(InputError, match=r"gyro_z stays at 0 from t = 80\.01"):
        check_frozen(imu, alone, "town")


def test_a_car_that_stops_in_a_gap_of_the_fixes_is_not_taken_for_moving(imu, gnss):
    """The last fix before shows a speed, the first one after comes when it has stood for a while."""
    repeated = (imu["t"] > 153) & (imu["t"] < 165)
    imu["gyro_z"][repeated] = 0.0
    gap = (gnss["t"] < 146) | (gnss["t"] > 178)
    check_frozen(imu, {name: x[gap] for name, x in gnss.items()}, "town")
    moving = (imu["t"] > 100) & (imu["t"] < 103)
    imu["gyro_z"][moving] = 0.0
    with pytest.raises(InputError, match="gyro_z stays at 0 from t = 100"):
        check_frozen(imu, {name: x[gap] for name, x in gnss.items()}, "town")


@pytest.mark.parametrize(("rate", "force"), [(0.06, 0.02), (0.25, 0.1), (1.0, 0.5), (2.0, 1.0)])
def test_coarse_sensors_repeat_themselves(imu, gnss, rate, force):
    """Steps of up to 2 °/s; one axis at a time, since the others tell a frozen IMU."""
    for name in (*GYRO, *ACCEL):
        step = np.radians(rate) if name in GYRO else force
        check_frozen({**imu, name: np.round(imu[name] / step) * step}, gnss, "town")


def test_a_standstill_and_a_short_repeat_are_none(imu, gnss):
    imu["accel_z"][16000:17500] = imu["accel_z"][16000]
    imu["gyro_x"][8000:8045] = 0.0
    check_frozen(imu, gnss, "town")


def test_samples_without_noise_may_repeat(gnss):
    check_frozen({name: x.to_numpy() for name, x in car(180)["imu"].items()}, gnss, "town")
