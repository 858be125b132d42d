"""The IMU: a strapdown reproduces the truth from it, closed forms at rest, errors as stated."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.linalg import expm
from tests.simulation.oracle import OMEGA, apart, apart_of_python_ins, attitude, cross_matrix, gravity, strapdown

from dlkf.base.errors import InputError
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors, imu_spec
from dlkf.simulation.imu import (
    ImuUnit,
    _inverse_mean_rotation,
    corrupt,
    draw_unit,
    gauss_markov,
    inverse_mechanisation,
    quantise,
)
from dlkf.simulation.motion.vehicle import Truth, VehicleConfig, drive_vehicle

CONF = Path(__file__).parents[2] / "conf"
FLAT = {
    "noise_density": 1e-3, "turn_on_bias": 0.1, "instability": 0.0, "correlation_time": 100.0, "scale_factor": 0.0,
    "misalignment": 0.0,
}  # fmt: skip
NO_UNIT = ImuUnit(np.zeros(6), np.zeros((2, 3, 3)))


def drive(seconds, rate, seed=11, skip=60, **changes):
    """A moving minute: truth rows from ``skip`` seconds on."""
    t = np.arange((skip + seconds) * rate + 1) / rate
    truth = drive_vehicle(np.random.default_rng(seed), VehicleConfig(**changes), t)
    return Truth(*(getattr(truth, name)[skip * rate :] for name in Truth.__dataclass_fields__))


@pytest.mark.parametrize("rate", [50, 100, 200])
def test_strapdown_reproduces_the_truth_over_a_minute(rate):
    """Position to f' dt³/12 per sample: 0.1 mm; velocity and attitude to rounding."""
    truth = drive(60, rate)
    imu = inverse_mechanisation(truth)
    off = apart(truth, *strapdown(truth, imu, rate))
    assert np.linalg.norm(truth.v_n, axis=1).max() > 10
    assert off[0] < 1e-3 * (100 / rate) ** 2 and off[1] < 2e-6 and off[2] < 1e-10


def test_python_ins_integrates_to_the_truth():
    """Its gravity lacks small height terms (so height 0 here); its position rule is trapezoidal."""
    truth = drive(60, 100, height_m=0.0, slope_std=0.0)
    off = apart_of_python_ins(truth, inverse_mechanisation(truth), 100)
    assert off[0] < 2e-3 and off[1] < 1e-4 and off[2] < 1e-5


def test_at_rest_it_feels_gravity_and_the_turning_earth():
    n, rpy, lat = 200, (0.05, -0.08, 2.1), math.radians(52.0)
    ones = np.ones(n)
    truth = Truth(np.arange(n) / 100, lat * ones, 0.2 * ones, 80 * ones, np.zeros((n, 3)), np.tile(rpy, (n, 1)))
    imu = inverse_mechanisation(truth)
    C_bn = attitude(*rpy).T
    assert np.abs(imu[:, 3:] - C_bn @ (OMEGA * np.array((math.cos(lat), 0, -math.sin(lat))))).max() < 1e-13
    # the rounding of 465 m/s (Earth rotation) in 10 ms is 1e-11 m/s²
    assert np.abs(imu[:, :3] - C_bn @ (0, 0, -gravity(lat, 80.0))).max() < 1e-10


def test_fast_turn_needs_the_mean_rotation():
    """J(φ)⁻¹ at 0.5 rad per sample: the velocity gained in body axes equals a numeric integral."""
    rate, spin, n = 2.0, 1.0, 9
    t, ones = np.arange(n) / rate, np.ones(n)
    yaw = spin * t
    truth = Truth(t, 0.9 * ones, 0 * t, 0 * t, np.zeros((n, 3)), np.stack((0 * t, 0 * t, yaw), -1))
    imu = inverse_mechanisation(truth)
    # at rest on a turntable with level axes the force stays vertical
    assert np.abs(imu[:, :2]).max() < 1e-3 and np.abs(imu[:, 2] + gravity(0.9, 0.0)).max() < 1e-4
    phi, f = imu[0, 3:] / rate, np.array((1.0, 2.0, 3.0))
    block = np.zeros((4, 4))
    block[:3, :3], block[:3, 3] = cross_matrix(phi), f
    gained = expm(block)[:3, 3]  # ∫₀¹ exp(sφ×) f ds
    recovered = _inverse_mean_rotation(torch.from_numpy(phi[None]), torch.from_numpy(gained[None])).numpy()[0]
    assert np.abs(recovered - f).max() < 1e-14


def test_long_drives_are_cut_without_a_seam(monkeypatch):
    truth = drive(10, 100)
    whole = inverse_mechanisation(truth)
    monkeypatch.setattr("dlkf.simulation.imu.CHUNK", 137)
    assert np.array_equal(inverse_mechanisation(truth), whole)


SPEC = ImuSpec(
    "test", accel=SensorErrors(1e-3, 0.1, 0.02, 5.0, 5e-3, 3e-3), gyro=SensorErrors(7e-5, 5e-3, 4e-4, 2.0, 2e-3, 1e-3)
)


def test_white_noise_has_density_times_root_rate():
    """R094; 60000 samples: relative std of a std is 1/√(2N) = 0.3 %, five sigma."""
    quiet = ImuSpec("white", SensorErrors(noise_density=1e-3), SensorErrors(noise_density=7e-5))
    for rate in (50, 200):
        measured, error = corrupt(np.random.default_rng(1), np.zeros((60000, 6)), quiet, NO_UNIT, rate)
        assert not error.any()
        expected = np.repeat((1e-3, 7e-5), 3) * math.sqrt(rate)
        assert np.abs(measured.std(0) / expected - 1).max() < 0.015
        assert np.abs((measured[1:] * measured[:-1]).mean(0) / expected**2).max() < 0.025


def test_gauss_markov_variance_and_time_constant():
    """Autocorrelation e^(−lag/τ) at lags of 0, τ/2 and τ; 3 × 4000 s hold some 3000 spans of 2τ."""
    rate, sensor = 20, SPEC.gyro
    settings = 1 / (rate * sensor.correlation_time), sensor.instability
    b = gauss_markov(np.random.default_rng(2), (4000 * rate, 3), *settings)
    for lag in (0, 20, 40):
        correlation = (b[: len(b) - lag] * b[lag:]).mean() / sensor.instability**2
        assert correlation == pytest.approx(math.exp(-lag / rate / sensor.correlation_time), abs=0.1)
    starts = np.stack([gauss_markov(np.random.default_rng(k), (2, 3), *settings)[0] for k in range(600)])
    assert starts.std() == pytest.approx(sensor.instability, rel=0.1)  # stationary from the first sample on


def test_measured_is_true_plus_error_plus_noise():
    true = np.random.default_rng(3).normal(size=(500, 6))
    unit = draw_unit(np.random.default_rng(4), SPEC)
    constant = ImuSpec("constant", SensorErrors(), SensorErrors())
    measured, error = corrupt(np.random.default_rng(5), true, constant, unit, 100)
    for part, M in zip((slice(0, 3), slice(3, 6)), unit.matrix):
        assert np.allclose(error[:, part], true[:, part] @ M.T + unit.bias[part], rtol=0, atol=1e-15)
    assert np.allclose(measured - true, error, rtol=0, atol=1e-15)


def test_units_are_drawn_with_the_preset_sigmas():
    """2000 units: relative std of a std over 3 × 2000 draws is 0.9 %."""
    rng = np.random.default_rng(6)
    units = [draw_unit(rng, SPEC) for _ in range(2000)]
    bias = np.stack([u.bias for u in units])
    assert bias[:, :3].std() == pytest.approx(0.1, rel=0.05)
    assert bias[:, 3:].std() == pytest.approx(5e-3, rel=0.05)
    M = np.stack([u.matrix for u in units])
    diagonal = np.eye(3, dtype=bool)
    assert M[:, 0][:, diagonal].std() == pytest.approx(5e-3, rel=0.05)
    assert M[:, 1][:, ~diagonal].std() == pytest.approx(1e-3, rel=0.05)


def allan_deviation(x, rate, m):
    """Overlapping Allan deviation at m samples (IEEE Std 952), RMS over the axes."""
    theta = np.concatenate((np.zeros((1, x.shape[1])), np.cumsum(x, axis=0))) / rate
    second = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
    return math.sqrt((second**2).mean() / 2) / (m / rate)


@pytest.mark.parametrize("name", ["consumer", "icm20602_i2nav", "adis16465_i2nav"])
def test_allan_deviation_of_a_static_imu_is_that_of_its_preset(name):
    """N²/τ + (2σ²T/τ)(1 − T/(2τ)(3 − 4e^(−τ/T) + e^(−2τ/T))); six hours hold 72 clusters of 300 s on 3 axes."""
    rate, spec = 10, imu_spec(yaml.safe_load((CONF / "imu" / f"{name}.yaml").read_text()))
    rng = np.random.default_rng(8)
    at_rest = np.broadcast_to((0.1, 0.0, -9.81, 0.0, 5e-5, -5e-5), (6 * 3600 * rate, 6))
    measured, _ = corrupt(rng, at_rest, spec, draw_unit(rng, spec), rate)
    for part, sensor in ((slice(0, 3), spec.accel), (slice(3, 6), spec.gyro)):
        for tau, allowed in ((1, 0.02), (10, 0.03), (100, 0.1), (300, 0.2)):
            T = sensor.correlation_time
            decay = 3 - 4 * math.exp(-tau / T) + math.exp(-2 * tau / T)
            in_run = 2 * sensor.instability**2 * T / tau * (1 - T / (2 * tau) * decay)
            stated = math.sqrt(sensor.noise_density**2 / tau + in_run)
            assert allan_deviation(measured[:, part], rate, tau * rate) == pytest.approx(stated, rel=allowed), tau


def only(**gyro):
    return ImuSpec("one error", SensorErrors(), SensorErrors(**gyro))


def test_gyroscopes_feel_the_specific_force():
    spec = only(g_sensitivity=1e-4)
    unit = draw_unit(np.random.default_rng(1), spec)
    true = np.random.default_rng(2).normal(size=(300, 6))
    measured, error = corrupt(np.random.default_rng(3), true, spec, unit, 100)
    assert np.allclose(error[:, 3:], true[:, :3] @ unit.g_sensitivity.T, rtol=0, atol=1e-16)
    assert not error[:, :3].any() and np.allclose(measured, true + error, rtol=0, atol=1e-15)
    entries = [draw_unit(np.random.default_rng(k), spec).g_sensitivity for k in range(300)]
    assert np.std(entries) == pytest.approx(1e-4, rel=0.06)  # relative 1σ 1.4 %


def test_a_unit_warms_up():
    """c (1 − e^(−t/T)): 63 % of the drift after one time constant, all of it after many."""
    spec = only(warm_up=1e-3, warm_up_time=20.0)
    unit = draw_unit(np.random.default_rng(1), spec)
    _, error = corrupt(np.random.default_rng(2), np.zeros((40_000, 6)), spec, unit, 100)
    assert error[1999, 3:] == pytest.approx((1 - math.exp(-1)) * unit.warm_up[3:], rel=1e-9)
    assert error[-1, 3:] == pytest.approx(unit.warm_up[3:], rel=1e-6)
    assert np.abs(error[0, 3:]).max() < 1e-3 * np.abs(unit.warm_up[3:]).max()


def test_rate_random_walk_grows_with_the_root_of_time():
    """K √t after 100 s over 3 × 300 walks: relative 1σ of a σ 2.4 %."""
    spec = only(random_walk=2e-5)
    ends = [corrupt(np.random.default_rng(k), np.zeros((1000, 6)), spec, NO_UNIT, 10)[1][-1, 3:] for k in range(300)]
    assert np.std(ends) == pytest.approx(2e-5 * 10, rel=0.1)
    assert spec.gyro.walk_psd == pytest.approx(4e-10)


def test_output_has_steps_and_an_end():
    x = np.array((-7.0, -0.26, 0.1, 0.14, 3.0))
    assert quantise(x, SensorErrors(quantisation=0.25)).tolist() == [-7.0, -0.25, 0.0, 0.25, 3.0]
    assert quantise(x, SensorErrors(full_scale=2.0)).tolist() == [-2.0, -0.26, 0.1, 0.14, 2.0]
    assert quantise(x, SensorErrors()).tolist() == x.tolist()
    spec = ImuSpec("steps", SensorErrors(1e-3, quantisation=1e-2), SensorErrors(1e-4, full_scale=1.0))
    true = np.random.default_rng(1).normal(size=(500, 6))
    measured, error = corrupt(np.random.default_rng(2), true, spec, NO_UNIT, 100)
    assert np.abs(measured[:, :3] / 1e-2 - np.round(measured[:, :3] / 1e-2)).max() < 1e-9
    assert np.abs(measured[:, 3:]).max() == 1.0
    assert not error.any()  # noise of the output, not an error to estimate


NEEDED = ("noise_density", "turn_on_bias", "instability", "correlation_time", "scale_factor", "misalignment")
GOOD = {"name": "x", "accel": dict.fromkeys(NEEDED, 1.0), "gyro": dict.fromkeys(NEEDED, 2.0)}


def test_spec_from_a_mapping():
    """The later keys are optional and off, so that presets written before them keep their meaning."""
    spec = imu_spec(GOOD)
    assert spec.gyro.noise_density == 2.0
    optional = ("random_walk", "warm_up", "g_sensitivity", "quantisation", "full_scale")
    assert not any(getattr(sensor, key) for sensor in (spec.accel, spec.gyro) for key in optional)
    warm = {**GOOD, "gyro": {**GOOD["gyro"], "warm_up": 3.0, "warm_up_time": 60.0}}
    assert (imu_spec(warm).gyro.warm_up, imu_spec(warm).gyro.warm_up_time) == (3.0, 60.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"accel": {**GOOD["accel"], "nois_density": 1.0}}, "nois_density"),
        ({"gyro": {"noise_density": 1.0}}, "missing"),
        ({"gyro": {**GOOD["gyro"], "noise_density": -1.0}}, "gyro: noise_density"),
        ({"gyro": {**GOOD["gyro"], "noise_density": "abc"}}, "noise_density"),
        ({"accel": None}, "mapping"),
        ({"extra": 1}, "extra"),
        ({"accel": {**GOOD["accel"], "g_sensitivity": 1.0}}, "g_sensitivity"),
        ({"gyro": {**GOOD["gyro"], "warm_up": 1.0, "warm_up_time": 0.0}}, "warm_up_time"),
        ({"gyro": {**GOOD["gyro"], "quantisation": 1.0, "full_scale": 1.0}}, "full_scale"),
    ],
)
def test_bad_presets_are_one_clear_line(change, said):
    with pytest.raises(InputError) as caught:
        imu_spec({**GOOD, **change})
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_wander_forgets_itself_and_axes_differ():
    """Autocorrelation of the second Gauss-Markov part at its time constant; noise factors log-normal per axis."""
    spec = imu_spec(
        {
            "name": "rough",
            **{s: {**FLAT, "wander": 0.05, "wander_time": 4.0, "unevenness": 0.6} for s in ("accel", "gyro")},
        }
    )
    units = [draw_unit(np.random.default_rng(k), spec) for k in range(500)]
    factors = np.log([unit.noise_factors for unit in units])
    assert factors.std() == pytest.approx(0.6, rel=0.05) and factors.mean() == pytest.approx(0, abs=0.05)
    measured, error = corrupt(np.random.default_rng(1), np.zeros((400_000, 6)), spec, units[0], 20)
    wander = error - units[0].bias
    assert wander.std(0) == pytest.approx([0.05] * 6, rel=0.08)  # 20000 s are 2500 spans of 2τ, 1σ 2 %
    for x in wander.T:
        assert np.corrcoef(x[80:], x[:-80])[0, 1] == pytest.approx(math.exp(-1), abs=0.06)
    white = (measured - error).std(0) / (FLAT["noise_density"] * math.sqrt(20))
    assert white == pytest.approx(units[0].noise_factors, rel=0.01)


def test_a_preset_with_ranges_is_its_middle():
    ranged = {**FLAT, "noise_density": {"log_uniform": [1e-4, 1e-2]}, "wander": {"uniform": [0, 1], "absent": 0.9}}
    spec = imu_spec({"name": "any", "accel": ranged, "gyro": FLAT})
    assert spec.accel.noise_density == pytest.approx(1e-3) and spec.accel.wander == 0
