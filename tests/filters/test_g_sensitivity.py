"""g-sensitivity of the gyroscopes as states: their columns of Φ, what is found, what an outage gains, streams and C."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dlkf.data.masks import withhold_fixes
from dlkf.filters.aids.attach import aid_columns
from dlkf.filters.build import build_filter
from dlkf.filters.g_sensitivity import NAMES, add_columns
from dlkf.filters.integration import integrate
from dlkf.filters.smoother import smooth
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.error_model import window_model
from dlkf.navigation.strapdown import strapdown
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.onboard.library import find_compiler
from tests.cars import IMU, car_batch

G = torch.tensor([[2e-4, -1e-4], [-3e-4, 2e-4], [1e-4, 1e-4]], dtype=torch.float64)  # rad/s per m/s²


@pytest.fixture(scope="module")
def sensitive():
    """Two minutes of eight cars whose gyroscopes feel force."""
    batch = car_batch(8, 120)
    force, rate = batch.imu.split(3, -1)
    return replace(batch, imu=torch.cat((force, rate + force[..., :2] @ G.mT), -1))


def test_columns_are_the_derivative_of_the_strapdown():
    """Of each entry: attitude exactly, velocity and position but for how the force changes within the interval."""
    batch = car_batch(3, 1)
    imu, frame, dt = batch.imu[:, 0], batch.frame, batch.dt
    states = build_filter("mbkf21+g_sensitivity", IMU).states
    psd = dict.fromkeys(("accel_noise", "gyro_noise", "accel_walk", "gyro_walk"), 1.0)
    model = window_model(frame, dt, imu.shape[1], psd, states=states, walk=torch.zeros(6))
    window = strapdown(batch.start, imu, dt, frame)
    Phi = add_columns(model.transition(batch.start, window, imu, frame), imu, states)
    bias, small = imu.new_zeros(3, 6), 1e-6
    for k, name in enumerate(NAMES):
        entry = imu.new_zeros(3, 6)
        entry[:, k] = small
        with_it = ImuError(bias, None, entry.unflatten(-1, (3, 2))).correct(imu)
        measured = window.end.error_to(strapdown(batch.start, with_it, dt, frame).end) / small
        column = Phi[:, :9, states.of(name).start]
        assert torch.allclose(measured[:, 6:], column[:, 6:], atol=3e-3)
        assert (measured - column)[:, :6].abs().max() < 0.1 * column[:, :6].abs().max()


def test_the_complete_error_is_what_is_taken_off_the_samples():
    error = ImuError(torch.full((2, 6), 0.01), torch.full((2, 6), 0.02), G.float().expand(2, -1, -1))
    raw = torch.randn(2, 5, 6, generator=torch.Generator().manual_seed(0))
    corrected = error.correct(raw)
    assert torch.allclose(error.at(corrected.mean(1)), (raw - corrected).mean(1), atol=1e-6)


def test_it_is_found_and_a_filter_without_it_is_overconfident(sensitive):
    """Errors over their 1σ of all entries and cars; innovations as large as expected, without these states larger."""
    kalman = build_filter("mbkf15+g_sensitivity", IMU)
    solution = integrate(sensitive, kalman, keep_innovations=True)
    last = dict(zip(aid_columns(kalman), solution.aids[:, -1].unbind(-1)))
    found, std = (torch.stack([last[head + name] for name in NAMES], -1) for head in ("", "std_"))
    normalised = (found - G.flatten()) / std
    assert std[:, [0, 1, 2, 3]].max() < 5e-5 and 0.6 < normalised.square().mean().sqrt() < 1.4

    def spread(model: str) -> float:
        run = integrate(sensitive, build_filter(model, IMU), keep_innovations=True)
        z, S = run.innovation[:, 40:], run.innovation_covariance[:, 40:]
        return float((z.unsqueeze(-2) @ torch.linalg.solve(S, z.unsqueeze(-1))).mean() / 6)

    assert 0.8 < spread("mbkf15+g_sensitivity") < 1.2 < spread("mbkf15")


def test_an_outage_is_shorter_by_it(sensitive):
    withheld = withhold_fixes(sensitive, (torch.arange(120) >= 80).expand(8, -1))

    def error(model: str) -> float:
        run = integrate(withheld, build_filter(model, IMU))
        return float((run.posterior.p_n - withheld.truth.p_n)[:, -1, :2].norm(dim=-1).log().mean().exp())

    assert error("mbkf15+g_sensitivity") < 0.6 * error("mbkf15")


def test_a_smoother_has_its_part_of_the_error(sensitive):
    """The smoothed error of the gyroscopes is nearer to the truth than the filter's, from the first minute on."""
    kalman = build_filter("mbkf15+g_sensitivity", IMU)
    true = sensitive.true_imu_error.clone()
    true[..., 3:] += sensitive.imu.mean(2)[..., :2] @ G.mT
    off = [(run.imu_error - true)[:, 10:40, 3:].square().mean() for run in
           (integrate(sensitive, kalman), smooth(sensitive, kalman))]  # fmt: skip
    assert off[1] < 0.7 * off[0]


@pytest.mark.whole
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
def test_in_c_it_is_the_same(sensitive):
    kalman = build_filter("mbkf21_car+receiver+g_sensitivity", IMU)
    in_c = compile_filter(kalman, rate_hz=1 / sensitive.dt, epoch_s=sensitive.epoch_s)
    ours, theirs = integrate(sensitive, kalman), integrate(sensitive, in_c)
    assert torch.allclose(ours.posterior.p_n, theirs.posterior.p_n, atol=1e-6)
    assert torch.allclose(ours.aids, theirs.aids, atol=1e-7, equal_nan=True)
    assert torch.allclose(ours.imu_error, theirs.imu_error, atol=1e-9)
