"""The motion keeps the paper's bounds, and its position, velocity and attitude belong together."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.simulation.oracle import positions_and_integral

from dlkf.base.errors import InputError
from dlkf.simulation.motion.vehicle import VehicleConfig, drive_vehicle, follow_route, random_route

RATE = 100


def drive(seed: int, seconds: int, **changes):
    t = np.arange(seconds * RATE + 1) / RATE
    return drive_vehicle(np.random.default_rng(seed), replace(VehicleConfig(), **changes), t)


@pytest.fixture(scope="module")
def hour():
    return drive(3, 3600)


def test_bounds_of_the_paper_hold_for_an_hour(hour):
    """R085-R088, from numerical derivatives of the truth (central differences: errors below 1e-3)."""
    speed = np.linalg.norm(hour.v_n, axis=1)
    along = np.gradient(speed, 1 / RATE)
    yaw_rate = np.gradient(hour.rpy[:, 2], 1 / RATE)
    lateral = np.abs(speed * yaw_rate)
    assert speed.min() >= 0 and speed.max() * 3.6 <= 80 + 1e-9
    assert speed.max() * 3.6 > 75
    assert np.abs(along).max() <= 2 + 1e-3
    assert np.abs(along).max() > 1.8
    turning = np.abs(yaw_rate) > 1e-6
    radius = speed[turning] / np.abs(yaw_rate[turning])
    assert radius.min() >= 40 - 1e-3
    assert lateral.max() <= 5 + 1e-3
    # on the plateau of a turn (yaw rate steady) radius and lateral acceleration lie in the band
    steady = (np.abs(np.gradient(yaw_rate, 1 / RATE)) < 1e-6) & turning
    assert steady.sum() > 300 * RATE
    assert (speed[steady] / np.abs(yaw_rate[steady])).max() <= 150 + 1e-3
    assert lateral[steady].min() >= 0.5 - 1e-3


def test_all_manoeuvres_occur(hour):
    """R084: standing, straight driving, turning both ways, full circles both ways (figure-eight)."""
    speed = np.linalg.norm(hour.v_n, axis=1)
    yaw_rate = np.gradient(hour.rpy[:, 2], 1 / RATE)
    share = [np.mean(x) for x in (speed == 0, (speed > 1) & (yaw_rate == 0), yaw_rate > 0.05, yaw_rate < -0.05)]
    assert min(share) > 0.02
    turned = np.split(hour.rpy[:, 2], np.flatnonzero(np.diff(np.sign(np.round(yaw_rate, 6)))))
    angles = np.array([part[-1] - part[0] for part in turned if len(part) > 1])
    assert angles.max() == pytest.approx(2 * math.pi, abs=0.01)
    assert angles.min() == pytest.approx(-2 * math.pi, abs=0.01)


def test_motion_is_smooth(hour):
    """No jump in acceleration or turn rate: the largest step in 10 ms is that of a ramp's steepest point."""
    assert np.abs(np.diff(hour.v_n, 2, axis=0)).max() * RATE**2 < 12  # jerk, m/s³
    assert np.abs(np.diff(hour.rpy, 2, axis=0)).max() * RATE**2 < 0.6  # rad/s²


def test_positions_are_the_integral_of_the_velocities():
    """To 20 µm over 10 minutes."""
    r_e, integral = positions_and_integral(drive(5, 600), RATE)
    assert np.abs(r_e - integral).max() < 2e-5
    assert np.linalg.norm(r_e - r_e[0], axis=1).max() > 500


def test_a_drive_may_begin_anywhere_on_its_route():
    """From the second minute on: positions are still the integral of the velocities."""
    route = random_route(np.random.default_rng(2), VehicleConfig(), 200.0)
    truth = follow_route(route, VehicleConfig(), 100 + np.arange(60 * RATE + 1) / RATE)
    r_e, integral = positions_and_integral(truth, RATE)
    assert np.abs(r_e - integral).max() < 2e-5


def test_body_lies_along_the_motion():
    truth = drive(6, 300)
    moving = np.linalg.norm(truth.v_n, axis=1) > 0.1
    course = np.arctan2(truth.v_n[moving, 1], truth.v_n[moving, 0])
    climb = np.arctan2(-truth.v_n[moving, 2], np.hypot(*truth.v_n[moving, :2].T))
    yaw = truth.rpy[moving, 2]
    assert np.abs(np.angle(np.exp(1j * (course - yaw)))).max() < 1e-12
    assert np.abs(climb - truth.rpy[moving, 1]).max() < 1e-12
    assert not truth.rpy[:, 0].any()


def test_hills_can_be_switched_off():
    flat = drive(7, 120, slope_std=0.0, height_m=12.0)
    assert np.array_equal(flat.height, np.full_like(flat.t, 12.0))
    assert not flat.v_n[:, 2].any()
    grades = np.concatenate([drive(seed, 600).rpy[:, 1] for seed in range(8)])
    assert 0.015 < grades.std() < 0.045


@pytest.mark.parametrize(
    "changes",
    [
        {"max_speed_kmh": 10.0},  # below what 0.5 m/s² on 40 m takes
        {"max_speed_kmh": -80.0},
        {"min_radius": 200.0},
        {"min_lateral": 6.0},
        {"min_radius": 0.0},
        {"max_acceleration": 0.0},
        {"slope_std": 1.0},
        {"lat_deg": 95.0},
        {"lat_deg": float("nan")},
    ],
)
def test_impossible_bounds_are_one_clear_line(changes):
    with pytest.raises(InputError) as caught:
        VehicleConfig(**changes)
    said = str(caught.value)
    assert "\n" not in said
    assert next(iter(changes)) in said or "start" in said


def test_slow_vehicle_keeps_to_turns_it_can_drive():
    truth = drive(8, 600, max_speed_kmh=20.0)
    speed = np.linalg.norm(truth.v_n, axis=1)
    assert speed.max() * 3.6 <= 20 + 1e-9
    yaw_rate = np.gradient(truth.rpy[:, 2], 1 / RATE)
    lateral = np.abs(speed * yaw_rate)
    steady = (np.abs(np.gradient(yaw_rate, 1 / RATE)) < 1e-6) & (lateral > 1e-6)
    assert steady.any() and lateral[steady].min() >= 0.5 - 1e-3
