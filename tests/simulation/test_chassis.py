"""A car round the IMU: truth stays exact, slip and suspension as stated, road and vibration of the stated size."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation
from tests.simulation.oracle import apart, apart_of_python_ins, positions_and_integral, strapdown

from dlkf.base.errors import InputError
from dlkf.command.composing import compose_command
from dlkf.simulation.dataset import dataset_config
from dlkf.simulation.imu import inverse_mechanisation
from dlkf.simulation.motion.chassis import ChassisConfig, apply_mounting, draw_car, rough_road, slip_angle, vibration
from dlkf.simulation.motion.routes import Kinematics, Plan, VehicleConfig
from dlkf.simulation.motion.vehicle import Route, Truth, follow_route, random_route, random_waves

CONF = Path(__file__).parents[2] / "conf"
LEVEL = VehicleConfig(slope_std=0.0, height_m=0.0)


@cache
def preset(name: str):
    return dataset_config(compose_command("simulate", f"simulated@dataset={name}")["dataset"])


def drive(vehicle: VehicleConfig, kind: ChassisConfig, seconds: int, rate: int, seed: int = 5) -> Truth:
    t = np.arange(seconds * rate + 1) / rate
    route = random_route(np.random.default_rng(seed), vehicle, float(seconds))
    rng = np.random.default_rng(seed + 1)
    return apply_mounting(rng, draw_car(rng, kind), route, follow_route(route, vehicle, t))


def later(truth: Truth, first: int) -> Truth:
    return Truth(*(getattr(truth, name)[first:] for name in Truth.__dataclass_fields__))


def circling(speed: float, rate: float, seconds: int) -> Route:
    """Ten seconds to a speed, then round and round at a yaw rate [rad/s]."""
    accelerate, turn = 10.0, seconds - 10.0
    plan = Plan(
        start=np.array((0.0, accelerate)),
        length=np.array((accelerate, turn)),
        ramp=np.array((1.0, 2.0)),
        speed=np.array((0.0, speed)),
        speed_change=np.array((speed, 0.0)),
        course=np.zeros(2),
        course_change=np.array((0.0, rate * (turn - 2.0))),
        distance=np.array((0.0, 0.5 * speed * accelerate)),
    )
    flat = random_waves(np.random.default_rng(0), 0.0)
    return Route(plan, None, flat, flat, 0.0)


def body_velocity(truth: Truth) -> np.ndarray:
    return Rotation.from_euler("ZYX", truth.rpy[:, ::-1]).inv().apply(truth.v_n)


@pytest.mark.parametrize("name", ["lifelike", "highway", "car_park"])
@pytest.mark.parametrize("rate", [50, 200])
def test_strapdown_reproduces_a_lifelike_minute(name, rate):
    """Vibration up to 42 Hz included: 0.1 mm where the position rule of the oracle is f' dt³/12 per sample."""
    config = preset(name)
    truth = later(drive(config.vehicle, config.chassis, 100, rate), 40 * rate)
    off = apart(truth, *strapdown(truth, inverse_mechanisation(truth), rate))
    assert off[0] < 5e-4 and off[1] < 1e-6 and off[2] < 1e-9


def test_python_ins_integrates_to_a_lifelike_truth():
    """Its gravity lacks small height terms, so on the ellipsoid; 5 mm is what its position rule allows."""
    rate, config = 100, preset("lifelike")
    vehicle = replace(config.vehicle, height_m=0.0, slope_std=0.0)
    truth = later(drive(vehicle, config.chassis, 100, rate), 40 * rate)
    off = apart_of_python_ins(truth, inverse_mechanisation(truth), rate)
    assert off[0] < 5e-3 and off[2] < 1e-5


def test_positions_are_the_integral_of_the_velocities():
    """Simpson's rule at 400 Hz, where vibration is well resolved."""
    rate, config = 400, preset("lifelike")
    r_e, integral = positions_and_integral(drive(config.vehicle, config.chassis, 120, rate), rate)
    assert np.abs(r_e - integral).max() < 1e-4
    assert np.linalg.norm(r_e - r_e[0], axis=1).max() > 300


def test_any_sample_rate_sees_the_same_motion():
    """Position is integrated at the sample rate to below 1 µm; all else is a function of time alone."""
    config = preset("lifelike")
    slow = drive(config.vehicle, config.chassis, 60, 50)
    for rate in (100, 200):
        fast = drive(config.vehicle, config.chassis, 60, rate)
        rows = slice(None, None, rate // 50)
        assert np.abs(fast.lat[rows] - slow.lat).max() < 1e-6 / 6.4e6
        assert np.abs(fast.height[rows] - slow.height).max() < 1e-6
        assert np.abs(fast.v_n[rows] - slow.v_n).max() < 1e-12
        assert np.abs(fast.rpy[rows] - slow.rpy).max() < 1e-12


def test_without_chassis_the_imu_is_the_point():
    route = random_route(np.random.default_rng(2), VehicleConfig(), 60.0)
    axle = follow_route(route, VehicleConfig(), np.arange(6001) / 100)
    rng = np.random.default_rng(3)
    car = apply_mounting(rng, draw_car(rng, ChassisConfig()), route, axle)
    for name in Truth.__dataclass_fields__:
        assert np.allclose(getattr(car, name), getattr(axle, name), rtol=0, atol=1e-12), name


def test_the_rear_axle_slips_by_the_single_track_model():
    """To the right −K v² χ', forward v: closed form on a level road; kitti's K is 0.0075 s²/m."""
    route = circling(15.0, 0.3, 60)
    motion = route.motion(np.arange(6001) / 100)
    rng = np.random.default_rng(0)
    kind = ChassisConfig(sideslip=0.0075)
    truth = apply_mounting(rng, draw_car(rng, kind), route, follow_route(route, LEVEL, motion.t))
    v_b = body_velocity(truth)
    slip = 0.0075 * motion.speed * motion.yaw_rate
    assert np.abs(v_b[:, 1] + motion.speed * np.sin(slip)).max() < 1e-12
    assert v_b[3000, 1] == pytest.approx(-0.0075 * 15**2 * 0.3, rel=1e-3)
    assert np.abs(v_b[:, 2]).max() < 1e-12


def test_gusts_push_the_axle_by_the_stated_angle():
    """RMS over 40 cars of the slip angle of a car with nothing else; sums of six waves each."""
    route = circling(15.0, 0.0, 600)
    motion = route.motion(np.arange(6000) / 10)
    kind = ChassisConfig(slip_noise=0.003)
    slip = [slip_angle(draw_car(np.random.default_rng(k), kind), route, motion) for k in range(40)]
    assert np.std([angle[200:] for angle, _ in slip]) == pytest.approx(0.003, rel=0.1)
    angle, rate = slip_angle(draw_car(np.random.default_rng(1), kind), route, route.motion(np.arange(30_000) / 1000))
    assert np.abs((angle[2:] - angle[:-2]) * 500 - rate[1:-1]).max() < 1e-6


def test_swells_pitch_the_body_by_the_stated_angle():
    """RMS over 40 cars of the pitch of a car with nothing else on a level road; the velocity down is v sin(pitch)."""
    route, t = circling(15.0, 0.0, 600), np.arange(6001) / 10
    axle, rng = follow_route(route, LEVEL, t), np.random.default_rng(0)
    cars = [draw_car(np.random.default_rng(k), ChassisConfig(pitch_noise=0.004)) for k in range(40)]
    truths = [apply_mounting(rng, car, route, axle) for car in cars]
    pitch = [truth.rpy[200:, 1] for truth in truths]
    assert np.std(pitch) == pytest.approx(0.004, rel=0.1)
    assert np.abs(body_velocity(truths[0])[200:, 2] - 15.0 * np.sin(pitch[0])).max() < 1e-4  # m/s
    per_second = np.abs(np.diff(pitch, axis=1)).max() * 10
    assert per_second < 3 * 0.004 * 2 * np.pi * 15.0 / 50  # no wave is shorter than 50 m: some σ times its rate


def test_lateral_velocity_at_the_imu_is_arm_times_yaw_rate():
    route = circling(15.0, 0.3, 60)
    rng = np.random.default_rng(0)
    truth = apply_mounting(
        rng,
        draw_car(rng, ChassisConfig(imu_arm=(-0.32, 0.1, -0.6))),
        route,
        follow_route(route, LEVEL, np.arange(6001) / 100),
    )
    v_b = body_velocity(truth)
    assert v_b[3000] == pytest.approx([15.0 - 0.1 * 0.3, -0.32 * 0.3, 0.0], abs=2e-5)  # transport rate 2e-6 m/s


def test_the_body_leans_out_of_turns_and_back_under_power():
    """Settled: roll = −gradient · v χ', pitch = gradient · a; on the way it overshoots as damping 0.35 says."""
    route = circling(15.0, 0.3, 60)
    t = np.arange(6001) / 100
    rng = np.random.default_rng(0)
    kind = ChassisConfig(roll_gradient=0.008, pitch_gradient=0.004)
    truth = apply_mounting(rng, draw_car(rng, kind), route, follow_route(route, LEVEL, t))
    assert truth.rpy[3000:4000, 0] == pytest.approx(-0.008 * 15 * 0.3, abs=1e-5)
    accelerating = slice(400, 800)
    assert truth.rpy[accelerating, 1] == pytest.approx(0.004 * route.motion(t[accelerating]).acceleration, abs=2e-4)
    assert truth.rpy[:, 0].min() < 1.0005 * -0.008 * 15 * 0.3
    assert np.abs(truth.rpy[5990:, 1]).max() < 1e-4


def test_mounting_turns_the_imu_in_the_car():
    route = random_route(np.random.default_rng(2), VehicleConfig(), 30.0)
    axle = follow_route(route, VehicleConfig(), np.arange(3001) / 100)
    rng = np.random.default_rng(3)
    angles = (1.0, -2.0, 3.0)
    truth = apply_mounting(rng, draw_car(rng, ChassisConfig(mounting_deg=angles)), route, axle)
    car, imu = (Rotation.from_euler("ZYX", x.rpy[:, ::-1]) for x in (axle, truth))
    assert np.abs((car.inv() * imu).as_euler("ZYX", degrees=True) - angles[::-1]).max() < 1e-9


def test_every_car_is_another():
    kind = ChassisConfig(sideslip=0.0075, spread=0.2, imu_arm_std=0.3, mounting_std_deg=0.5)
    cars = [draw_car(np.random.default_rng(k), kind) for k in range(400)]
    assert np.std(np.log([car.sideslip for car in cars])) == pytest.approx(0.2, rel=0.2)  # 1σ of a σ: 3.5 %
    assert np.std([car.imu_arm for car in cars]) == pytest.approx(0.3, rel=0.1)
    assert np.degrees(np.std([car.mounting for car in cars])) == pytest.approx(0.5, rel=0.1)


def test_rough_road_has_the_spectrum_of_iso_8608():
    """G_d(n) = G_d(0.1) (n/0.1)⁻² between 0.05 and 0.5 cycles/m; 40 km hold 500 of Welch's windows."""
    step = 0.25
    distance = np.arange(0, 40_000, step)
    road = rough_road(np.random.default_rng(1), ChassisConfig(roughness=64e-6), distance)
    n, height = welch(road[:, 2], 1 / step, nperseg=640)
    for wave in (0.05, 0.1, 0.3):  # the mean of front and rear wheels takes cos²(π n 2.7)
        k = np.argmin(np.abs(n - wave))
        stated = 64e-6 * (wave / 0.1) ** -2 * math.cos(math.pi * wave * 2.7) ** 2
        assert height[k - 2 : k + 3].mean() == pytest.approx(stated, rel=0.25)


def test_vibration_has_the_stated_size():
    """RMS of the second derivative at 15 m/s, by differences at 2 kHz, and none of it at zero."""
    t = np.arange(40_001) / 2000
    still = np.zeros_like(t)
    motion = Kinematics(t, 15 + still, still, still, still, still, 15 * t)
    kind = ChassisConfig(vibration=0.3, vibration_rate=0.003)
    shake, change = vibration(np.random.default_rng(4), kind, motion)
    force = np.diff(change[:, :3], axis=0) * 2000
    assert np.sqrt(np.mean(force**2, axis=0)) == pytest.approx([0.3] * 3, rel=0.02)
    assert np.sqrt(np.mean(change[:, 3:] ** 2, axis=0)) == pytest.approx([0.003] * 3, rel=0.02)
    assert np.abs((shake[2:] - shake[:-2]) * 1000 - change[1:-1]).max() < 1e-4
    assert not vibration(np.random.default_rng(4), ChassisConfig(), motion)[0].any()


@pytest.mark.parametrize(
    "change",
    [
        {"sideslip": -0.1},
        {"roughness": 1.0},
        {"imu_arm": (1.0, 2.0)},
        {"mounting_deg": (0.0, 90.0, 0.0)},
        {"spread": math.nan},
    ],
)
def test_impossible_cars_are_one_clear_line(change):
    with pytest.raises(InputError, match=next(iter(change))) as caught:
        ChassisConfig(**change)
    assert "\n" not in str(caught.value)
