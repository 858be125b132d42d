"""The IMU: a strapdown reproduces the truth from it, closed forms at rest, errors as stated."""

import math

import numpy as np
import pandas as pd
import pytest
import torch
from pyins.strapdown import Integrator
from scipy.linalg import expm
from tests.simulation.oracle import OMEGA, attitude, axes, cross_matrix, ecef, gravity, strapdown

from dlkf.errors import InputError
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors, imu_spec
from dlkf.simulation.imu import (
    ImuUnit,
    _inverse_mean_rotation,
    corrupt,
    draw_unit,
    gauss_markov,
    inverse_mechanisation,
)
from dlkf.simulation.vehicle import Truth, VehicleConfig, drive_vehicle

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
    r, v, C = strapdown(truth, imu, rate)
    C_en = axes(truth.lat[-1], truth.lon[-1])
    assert np.linalg.norm(truth.v_n, axis=1).max() > 10
    assert np.linalg.norm(r - ecef(truth.lat[-1], truth.lon[-1], truth.height[-1])) < 1e-3 * (100 / rate) ** 2
    assert np.linalg.norm(v - C_en @ truth.v_n[-1]) < 2e-6
    assert np.linalg.norm(C - C_en @ attitude(*truth.rpy[-1])) < 1e-10


def test_python_ins_integrates_to_the_truth():
    """Its gravity lacks small height terms (so height 0 here); its position rule is trapezoidal."""
    rate = 100
    truth = drive(60, rate, height_m=0.0, slope_std=0.0)
    imu = inverse_mechanisation(truth)
    theta = imu[:, 3:] / rate
    turned = np.cross(theta, imu[:, :3])
    dv = (imu[:, :3] + turned / 2 + np.cross(theta, turned) / 6) / rate
    increments = pd.DataFrame(
        np.hstack((np.full((len(imu), 1), 1 / rate), theta, dv)),
        columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
        index=truth.t[1:],
    )
    start = pd.Series(
        [
            *np.degrees((truth.lat[0], truth.lon[0])),
            truth.height[0],
            *truth.v_n[0],
            *np.degrees(truth.rpy[0]),
        ],
        index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
        name=truth.t[0],
    )
    end = Integrator(start).integrate(increments).iloc[-1]
    moved = ecef(math.radians(end.lat), math.radians(end.lon), end.alt)
    assert np.linalg.norm(moved - ecef(truth.lat[-1], truth.lon[-1], truth.height[-1])) < 2e-3
    assert np.abs(end[["VN", "VE", "VD"]].to_numpy() - truth.v_n[-1]).max() < 1e-4
    apart = (
        attitude(*np.radians(end[["roll", "pitch", "heading"]].astype(float))) @ attitude(*truth.rpy[-1]).T
    )
    assert np.linalg.norm(apart - np.eye(3)) < 1e-5


def test_at_rest_it_feels_gravity_and_the_turning_earth():
    n, rpy, lat = 200, (0.05, -0.08, 2.1), math.radians(52.0)
    ones = np.ones(n)
    truth = Truth(
        np.arange(n) / 100, lat * ones, 0.2 * ones, 80 * ones, np.zeros((n, 3)), np.tile(rpy, (n, 1))
    )
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
    "test",
    accel=SensorErrors(1e-3, 0.1, 0.02, 5.0, 5e-3, 3e-3),
    gyro=SensorErrors(7e-5, 5e-3, 4e-4, 2.0, 2e-3, 1e-3),
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
    b = gauss_markov(np.random.default_rng(2), 4000 * rate, sensor, rate)
    for lag in (0, 20, 40):
        correlation = (b[: len(b) - lag] * b[lag:]).mean() / sensor.instability**2
        assert correlation == pytest.approx(math.exp(-lag / rate / sensor.correlation_time), abs=0.1)
    starts = np.stack([gauss_markov(np.random.default_rng(k), 2, sensor, rate)[0] for k in range(600)])
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


NEEDED = ("noise_density", "turn_on_bias", "instability", "correlation_time", "scale_factor", "misalignment")
GOOD = {"name": "x", "accel": dict.fromkeys(NEEDED, 1.0), "gyro": dict.fromkeys(NEEDED, 2.0)}


def test_spec_from_a_mapping():
    assert imu_spec(GOOD).gyro.noise_density == 2.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"accel": {**GOOD["accel"], "nois_density": 1.0}}, "nois_density"),
        ({"gyro": {"noise_density": 1.0}}, "missing"),
        ({"gyro": {**GOOD["gyro"], "noise_density": -1.0}}, "gyro: noise_density"),
        ({"gyro": {**GOOD["gyro"], "noise_density": "abc"}}, "noise_density"),
        ({"accel": None}, "mapping"),
        ({"extra": 1}, "extra"),
    ],
)
def test_bad_presets_are_one_clear_line(change, said):
    with pytest.raises(InputError) as caught:
        imu_spec({**GOOD, **change})
    assert said in str(caught.value) and "\n" not in str(caught.value)
