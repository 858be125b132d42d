"""RTS smoother: consistent, better than the filter, and the least-squares answer where the world is linear."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import chi2

from dlkf.base.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import Ins, Mbkf
from dlkf.filters.smoother import smooth
from dlkf.filters.tuning import Tuning
from dlkf.running.batched import run_filter

from . import scene as scenes
from .scene import IMU, scene


def with_outage(batch, first: int, last: int):
    available = batch.available.clone()
    available[:, first:last] = False
    return replace(batch, available=available)


def test_errors_are_smaller_and_as_large_as_the_smoother_says(monkeypatch):
    """NEES by component; start errors small enough for a first-order filter to be right about the first seconds."""
    monkeypatch.setattr(scenes, "START_STD", 0.3 * scenes.START_STD)
    imu = replace(IMU, accel=replace(IMU.accel, turn_on_bias=0.03), gyro=replace(IMU.gyro, turn_on_bias=1.5e-3))
    batch = with_outage(scene(100, 60, seed=1, imu=imu), 20, 50)
    filtered, smoothed = integrate(batch, Mbkf(imu)), smooth(batch, Mbkf(imu))
    e = smoothed.posterior.error_to(batch.truth)
    inside = slice(25, 45)
    before = filtered.posterior.error_to(batch.truth)[:, inside, :3].square().mean().sqrt()
    after = e[:, inside, :3].square().mean().sqrt()
    assert after < 0.2 * before
    assert torch.equal(smoothed.posterior.p_n[:, -1], filtered.posterior.p_n[:, -1])  # nothing comes after the end
    low, high = chi2.ppf([0.001, 0.999], 100)
    for t in (5, 30, 45):
        square = (e[:, t] / smoothed.std[:, t, :9]).square().sum(0)
        assert ((low < square) & (square < 1.05 * high)).all(), (t, square)
    bias = (batch.true_imu_error - smoothed.imu_error)[:, 2].square().mean(0)
    assert (bias < (batch.true_imu_error - filtered.imu_error)[:, 2].square().mean(0)).all()


def test_first_order_equals_the_whole_drive_s_least_squares():
    """With a near-perfect IMU the smoothed start position is the mean of all fixes, brought back to the start."""
    quiet = replace(IMU, accel=replace(IMU.accel, noise_density=1e-9, turn_on_bias=0.0, instability=0.0))
    quiet = replace(quiet, gyro=replace(IMU.gyro, noise_density=1e-12, turn_on_bias=0.0, instability=0.0))
    batch = scene(5, 40, seed=2, imu=quiet, bias=torch.zeros(5, 6, dtype=torch.float64), velocity_std=1e3)
    batch = replace(batch, start=batch.start._replace(v_n=batch.start.v_n * 0 + 12 * batch.start.C_nb[:, :, 0]))
    exact = scene(5, 40, seed=2, imu=quiet, noise=False, bias=torch.zeros(5, 6, dtype=torch.float64), velocity_std=1e3)
    std = torch.tensor([100.0] * 3 + [1e-9] * 6, dtype=torch.float64).expand(5, 9)
    batch = replace(batch, start=exact.start._replace(p_n=batch.start.p_n), start_std=std)
    smoothed = smooth(batch, Mbkf(quiet, Tuning(walk_floor_accel=1e-9, walk_floor_gyro=1e-12)))
    offset = (batch.gnss - exact.gnss)[..., :3].mean(1)
    found = (smoothed.posterior.p_n - exact.truth.p_n)[:, 0]
    assert (found - offset).abs().max() < 2e-4


def test_padding_and_names():
    batch = scene(2, 30, seed=3)
    short = batch.present.clone()
    short[1, 20:] = False
    available = batch.available & short
    padded = replace(batch, present=short, available=available)
    one = smooth(padded, build_filter("mbkf21", IMU))
    cut = {"imu", "gnss", "gnss_std", "gnss_valid", "gnss_lag", "available", "present"}
    alone = replace(batch, **{name: getattr(batch, name)[:, :20] for name in cut})
    other = run_filter(alone, build_filter("mbkf21_rts", IMU))
    assert torch.allclose(one.posterior.p_n[1, :20], other.posterior.p_n[1], atol=1e-9)
    with pytest.raises(InputError, match="needs a filter with a covariance"):
        smooth(batch, Ins())


def test_scale_factors_of_the_whole_drive_are_taken_off_its_beginning():
    """The complete error of the third second, gravity times the scale factor among it, as the end knows it."""
    scale = torch.tensor([0.01, -0.008, 0.012, 0.01, -0.01, 0.005], dtype=torch.float64)
    imu = replace(IMU, accel=replace(IMU.accel, scale_factor=0.01), gyro=replace(IMU.gyro, scale_factor=0.01))
    batch = scene(20, 60, seed=5, imu=imu)
    batch = replace(batch, imu=batch.imu + scale * batch.imu)
    complete = batch.true_imu_error + scale * batch.imu.mean(2)
    smoothed = smooth(batch, build_filter("mbkf21", imu))
    off = (smoothed.imu_error - complete)[:, 2].square().mean(0).sqrt()
    assert off[2] < 0.005 and off[3:].max() < 5e-4  # m/s² along gravity, of 0.12 that the factor makes; rad/s


class Wandering:
    """A Kalman filter that says of its positions that the receiver is off by 2 m for long."""

    def __init__(self, kalman: Mbkf) -> None:
        self.kalman, self.states = kalman, kalman.states

    def begin(self, batch):
        return self.kalman.begin(batch)

    def step(self, memory, epoch):
        memory, correction = self.kalman.step(memory, epoch)
        slow = torch.tensor([4.0] * 3 + [0.0] * 12, dtype=torch.float64)
        return memory, correction._replace(std=(correction.std.square() + slow).sqrt())


def test_what_a_filter_says_beside_its_covariance_is_not_averaged():
    batch, kalman = scene(4, 40, seed=3), build_filter("mbkf15", IMU)
    plain, wandering = smooth(batch, kalman), smooth(batch, Wandering(kalman))
    more = wandering.std.square() - plain.std.square()
    torch.testing.assert_close(more[..., :3], torch.full_like(more[..., :3], 4.0))
    assert more[..., 3:].abs().max() < 1e-12 and torch.equal(plain.posterior.p_n, wandering.posterior.p_n)
