"""Plans of every profile keep their bounds; manoeuvres occur as asked; old seeds give the old drives."""

import math

import numpy as np
import pytest
from tests.simulation.test_chassis import preset

from dlkf.base.errors import InputError
from dlkf.simulation.motion.routes import Manoeuvres, VehicleConfig, along, random_plan
from dlkf.simulation.motion.vehicle import drive_vehicle, random_route

RATE = 20
PROFILES = ["paper_clean", "lifelike", "city", "highway", "car_park", "tunnel"]


@pytest.mark.parametrize("name", PROFILES)
def test_an_hour_of_each_profile_keeps_its_bounds(name):
    """R085-R088, or the bounds of the profile: radius and lateral acceleration on the plateau of a turn."""
    config = preset(name).vehicle
    motion = along(random_plan(np.random.default_rng(1), config, 3600.0), np.arange(3600 * RATE) / RATE)
    speed, lateral = np.abs(motion.speed), np.abs(motion.speed * motion.yaw_rate)
    top = config.max_speed_kmh / 3.6
    assert speed.max() <= top * (1 + 1e-12) and speed.max() > 0.9 * top
    assert np.abs(motion.acceleration).max() <= config.max_acceleration + 1e-9
    assert np.abs(motion.acceleration).max() > 0.8 * config.max_acceleration
    turning = motion.yaw_rate != 0
    assert lateral.max() <= config.max_lateral + 1e-9
    assert (speed[turning] / np.abs(motion.yaw_rate[turning])).min() >= config.min_radius - 1e-6
    steady = turning & (motion.yaw_acceleration == 0)
    assert steady.sum() > 60 * RATE
    assert lateral[steady].min() >= config.min_lateral - 1e-9
    assert (speed[steady] / np.abs(motion.yaw_rate[steady])).max() <= config.max_radius + 1e-6


def test_yaw_acceleration_is_the_derivative_of_the_yaw_rate():
    """Of the plan and of the wandering driver, by central differences."""
    t = np.arange(60_000) / 1000
    for wander in (0.0, 1.0):
        motion = random_route(np.random.default_rng(2), VehicleConfig(wander_deg=wander), 60.0).motion(t)
        for value, derivative, allowed in (
            (motion.course, motion.yaw_rate, 1e-5),
            (motion.yaw_rate, motion.yaw_acceleration, 1e-3),
        ):
            assert np.abs((value[2:] - value[:-2]) * 500 - derivative[1:-1]).max() < allowed
        assert np.abs(motion.yaw_rate).max() > 0.05


def test_drivers_wander_as_far_as_asked():
    """RMS of the course against the plan over 40 drives; it is a random sum of six waves in each."""
    t = np.arange(6000) / 10
    apart = []
    for seed in range(40):
        straight, wandering = (
            random_route(np.random.default_rng(seed), VehicleConfig(wander_deg=w), 600.0).motion(t) for w in (0.0, 0.5)
        )
        apart.append(np.degrees(wandering.course - straight.course))
    assert np.std(apart) == pytest.approx(0.5, rel=0.15)


def test_seeds_of_published_results_give_the_same_road():
    """Values of commit 90c128e, to the rounding of a float."""
    truth = drive_vehicle(np.random.default_rng(3), VehicleConfig(), np.arange(60_001) / 100)
    end = truth.lat[-1], truth.lon[-1], truth.height[-1], truth.rpy[-1, 2]
    assert end == pytest.approx(
        (0.9100536107621412, 0.17282075537822736, 98.29731180538195, 2.6479712962346493), rel=1e-13
    )


def test_lane_changes_come_back_to_the_course():
    habits = Manoeuvres(stretch=0.3, turn=0.0, stop=0.0, eight=0.0, lane_change=0.7)
    plan = random_plan(np.random.default_rng(4), VehicleConfig(manoeuvres=habits), 600.0)
    turned = plan.course_change[plan.course_change != 0]
    assert len(turned) > 20 and np.abs(turned[::2] + turned[1::2]).max() == 0
    assert math.radians(1.5) <= np.abs(turned).min() and np.abs(turned).max() <= math.radians(4.0)


def test_cars_reverse_where_told():
    habits = Manoeuvres(stretch=0.5, turn=0.0, stop=0.0, eight=0.0, reverse=0.5)
    motion = along(random_plan(np.random.default_rng(5), VehicleConfig(manoeuvres=habits), 600.0), np.arange(6000) / 10)
    back = motion.speed < -1
    assert 0.05 < back.mean() < 0.9
    assert np.abs(motion.yaw_rate[back]).max() > 0.05
    assert (np.diff(motion.distance)[back[1:] & back[:-1]] < 0).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"turn": 0.6}, "sum"),
        ({"stretch": 0.0, "turn": 0.85}, "stretch"),
        ({"stop": -0.1, "turn": 0.7}, "shares"),
        ({"slowest": 0.0}, "slowest"),
        ({"stop_s": (5.0, 1.0)}, "stop_s"),
        ({"turn_deg": (-5.0, 1.0)}, "turn_deg"),
        ({"stretch_s": (0.0, math.nan)}, "stretch_s"),
    ],
)
def test_impossible_habits_are_one_clear_line(change, said):
    with pytest.raises(InputError, match=said) as caught:
        Manoeuvres(**change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [{"bank_std": 0.5}, {"superelevation": -1.0}, {"wander_deg": 10.0}])
def test_impossible_roads_are_one_clear_line(change):
    with pytest.raises(InputError, match=next(iter(change))):
        VehicleConfig(**change)
