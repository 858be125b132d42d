"""What a simulated wheel, heading receiver and barometer report of a motion in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.data.aids import pressure_height
from dlkf.simulation import sensors
from dlkf.simulation.motion.vehicle import Truth
from dlkf.simulation.sensors import BaroConfig, SensorsConfig, WheelConfig, sense, wheel_speeds

EXACT = {"warm": 0.0, "growth": 0.0, "slip": 0.0, "noise": 0.0, "delay_s": 0.0}
T = np.arange(0.0, 120.0, 0.01)
SPEED = 12 + 6 * np.sin(0.1 * T)  # m/s


def _motion(speed=SPEED, turn=0.0):
    return sensors._Motion(T, speed, np.full_like(T, turn), 0.01 * T, 100 + 0 * T)


def _reported(**values):
    motion = values.pop("motion", _motion())
    table = wheel_speeds(np.random.default_rng(0), WheelConfig(**{**EXACT, **values}), motion)
    return table["t"].to_numpy(), table["speed"].to_numpy()


@pytest.mark.parametrize("values,back", [
    ({"rate_hz": 20.0}, 0.025), ({"rate_hz": 1.0}, 0.5), ({"rate_hz": 1.0, "mean_s": 0.2}, 0.1),
    ({"rate_hz": 10.0, "delay_s": 0.2}, 0.25),
])  # fmt: skip
def test_a_sample_is_the_mean_over_its_stretch(values, back):
    t, v = _reported(**values)
    inside = t > 1.5
    assert np.allclose(v[inside], 12 + 6 * np.sin(0.1 * (t[inside] - back)), atol=4e-3)


def test_scale_place_warmth_and_growth():
    t, v = _reported(scale=0.03, right_m=0.5, motion=_motion(0 * T + 15, 0.2))
    assert np.allclose(v, 1.03 * (15 - 0.5 * 0.2))
    t, v = _reported(warm=0.01, warm_s=20.0, growth=0.02, motion=_motion(0 * T + 15))
    assert np.allclose(v, 15 * (1 - 0.01 * (1 - np.exp(-(t - 0.025) / 20)) - 0.02 * 0.25), atol=1e-4)


def test_a_wheel_slips_with_the_acceleration():
    t, v = _reported(slip=0.01)
    at = t - 0.025
    expected = (12 + 6 * np.sin(0.1 * at)) * (1 + 0.01 * 0.6 * np.cos(0.1 * at))
    assert np.allclose(v[20:-20], expected[20:-20], atol=1e-3)


def test_hard_braking_locks_it():
    speed = np.clip(20 - 4 * np.clip(T - 60, 0, None), 0, None)
    t, v = _reported(locks=1.0, lock_s=1.0, motion=_motion(speed))
    assert (v[(t > 60.2) & (t < 60.8)] == 0).all() and (v[(t > 61.3) & (t < 62)] > 10).all()


def test_steps_ticks_and_sign():
    _, v = _reported(step_kmh=1.0, rate_hz=1.0, motion=_motion(-SPEED), unsigned=True)
    assert np.allclose(3.6 * v, np.round(3.6 * v)) and (v > 0).all()
    _, v = _reported(tick_m=0.1)
    assert np.allclose(v / 2.0, np.round(v / 2.0))  # 0.1 m in 0.05 s
    _, v = _reported(tick_m=0.1, rate_hz=1.0, mean_s=0.2)
    assert np.allclose(v / 0.5, np.round(v / 0.5))


def test_gaps_and_a_dead_sensor():
    t, v = _reported(dropout_share=0.3, dropout_s=5.0)
    assert np.diff(t).max() > 4.9 and 0.6 < len(t) / 2400 < 0.9
    t, v = _reported(dead=1.0)
    stuck = np.flatnonzero(np.diff(v) == 0)
    assert len(stuck) > 200 and (v[stuck[5] :] == v[-1]).all()


def test_a_wheel_is_no_faster_than_the_truth():
    with pytest.raises(InputError, match="rate_hz 200 is above the IMU's 100"):
        _reported(rate_hz=200.0)


def test_each_sensor_has_seeds_of_its_own():
    rpy = np.stack((0 * T, 0 * T, 0.01 * T), -1)
    v_n = SPEED[:, None] * np.stack((np.cos(0.01 * T), np.sin(0.01 * T), 0 * T), -1)
    truth = Truth(T, 0.8 + 0 * T, 0.1 + 0 * T, 100 + 0 * T, v_n, rpy)

    def made(**config):
        return sense(np.random.SeedSequence(3), SensorsConfig(**config), truth, 0.01 + 0 * T)

    both = made(wheel=WheelConfig(), baro=BaroConfig(offset_m=7.0, noise_m=0.0, walk_m=0.0))
    assert both["speed"].equals(made(wheel=WheelConfig())["speed"])
    assert np.allclose(pressure_height(both["baro"]["pressure"].to_numpy()), 107)
    assert made() == {}
