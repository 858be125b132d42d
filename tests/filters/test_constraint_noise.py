"""The noise of vehicle constraints is what innovations show of cars whose sideways and vertical velocity is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.constraint_noise import EXPECTED, FIRST, HIGH, LEAST, LOW, MEMORY, MOST, ConstraintNoise
from dlkf.filters.constraints import CarConstraints, CarMemory, _is_near_fix
from dlkf.filters.integration import integrate
from dlkf.filters.shipped import trained_filter
from dlkf.filters.sources import Predicted
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import ErrorStates, NavState

from .scene import IMU, M, scene
from .test_constraints import driven, epoch_of, outage, slipping
from .test_stationarity import in_parts

D = torch.float64


def swaying(sideways: float, down: float, epochs: int = 120):
    """Cars at 15 m/s whose velocity across them has this 1σ [m/s], anew every second, with GNSS throughout."""
    base, g = scene(6, epochs, seed=3), torch.Generator().manual_seed(5)
    C = torch.eye(3, dtype=D).repeat(6, 1, 1)
    start = NavState(torch.zeros(6, 3, dtype=D), torch.tensor([[15.0, 0.0, 0.0]], dtype=D).repeat(6, 1), C)
    v = torch.randn(6, epochs + 1, 3, generator=g, dtype=D) * torch.tensor([0.0, sideways, down], dtype=D)
    v[:, 0] = 0.0
    clean = torch.zeros(6, epochs, M, 6, dtype=D)
    clean[..., 3:] = base.frame.earth_rate_n[:, None, None]
    clean[..., :3] = (v[:, 1:] - v[:, :-1])[:, :, None] - base.frame.gravity(start.p_n)[:, None, None]
    batch = driven(base, start, clean)
    return replace(batch, available=torch.ones_like(batch.available))


def factors(batch, name: str = "mbkf21_car", **tuning: float) -> torch.Tensor:
    """(B, 2) f at the end."""
    kalman, last = build_filter(name, IMU, tuning=Tuning(**tuning)), {}

    class Watched(CarConstraints):
        def rows(self, epoch, memory, prediction):
            row, after = super().rows(epoch, memory, prediction)
            last["f"] = after.noise.factor
            return row, after

    sources = tuple(
        Watched(s.tuning, s.states, adapts_noise=True) if isinstance(s, CarConstraints) else s for s in kalman.sources
    )
    integrate(batch, replace(kalman, sources=sources))
    return last["f"]


@pytest.mark.parametrize("size", [0.1, 0.5, 1.0])
def test_sums_are_those_of_numpy(size):
    g = np.random.default_rng(3)
    z, of_state, variance = size * g.normal(size=(400, 2)), g.uniform(0.1, 0.3, (400, 2)), g.uniform(0.2, 0.6, (400, 2))
    learns = g.random(400) < 0.8
    noise, squares, fixes, f = ConstraintNoise.begin(torch.zeros(1, dtype=D), 1), np.zeros(2), 0.0, np.ones(2)
    for k in range(400):
        row = [torch.from_numpy(x)[None] for x in (z[k], of_state[k], variance[k])]
        noise = noise.update(*row, 2.0, torch.tensor([bool(learns[k])]))
        if learns[k]:
            keep = 1 - 1 / MEMORY
            square = np.minimum(z[k] ** 2, 4 * (of_state[k] + f * variance[k]))
            squares, fixes = keep * squares + square / (of_state[k] + variance[k]), keep * fixes + 1
            mean = (FIRST * EXPECTED + squares) / (FIRST + fixes)
            f = np.clip(np.where(mean > HIGH, mean / HIGH, np.where(mean < LOW, mean / LOW, 1.0)), LEAST, MOST)
    np.testing.assert_allclose(noise.factor.numpy()[0], f, rtol=1e-12)


@pytest.mark.parametrize(("sideways", "down"), [(0.5, 0.02), (0.02, 0.5)])
def test_a_car_that_sways_has_a_larger_variance_on_that_axis(sideways, down):
    f = factors(swaying(sideways, down), lateral_std=0.1, vertical_std=0.1)
    large, small = (0, 1) if sideways > down else (1, 0)
    assert (f[:, large] > 4).all() and (f[:, small] < 1).all()


def test_a_car_that_hardly_breaks_them_keeps_its_variance_within_limits():
    assert (factors(swaying(0.05, 0.05), lateral_std=0.1, vertical_std=0.1) == 1).all()
    assert (factors(swaying(0.01, 0.01), lateral_std=0.1, vertical_std=0.1) < 1).all()


def test_nothing_is_learned_without_fixes_or_at_rest():
    batch = swaying(0.5, 0.5, 30)
    torch.testing.assert_close(factors(outage(batch, 0, 30)), torch.ones(6, 2, dtype=D))
    standing = replace(batch, imu=scene(6, 30).imu * 0.0 + batch.imu.mean((1, 2), keepdim=True))
    stopped = standing.start._replace(v_n=torch.zeros_like(standing.start.v_n))
    gnss = torch.zeros_like(standing.gnss)
    torch.testing.assert_close(factors(replace(standing, start=stopped, gnss=gnss)), torch.ones(6, 2, dtype=D))


def test_a_fix_far_from_the_filter_teaches_nothing():
    """A filter that wrong fixes have led astray would take its own velocity for that of the car."""
    at = epoch_of(scene(1, 1, seed=3), scene(1, 1, seed=3).start, ImuError(torch.zeros(1, 6, dtype=D)))
    P, std = 0.16 * torch.eye(26, dtype=D)[None], torch.full((1, 6), 0.3, dtype=D)  # 0.5 m together
    yes = torch.ones(1, 6, dtype=torch.bool)
    for off, near in ((1.4, True), (1.6, False)):
        z = torch.tensor([[0.1, off, 0.0, 9.0, 9.0, 9.0]], dtype=D)
        assert bool(_is_near_fix(at._replace(z=z, fix=at.fix._replace(std=std, used=yes)), P)) is near
    assert not bool(_is_near_fix(at._replace(z=0 * z, fix=at.fix._replace(std=std, used=~yes)), P))


def test_shorter_update_intervals_find_the_same():
    batch = swaying(0.4, 0.2)
    whole, halves = (factors(x, lateral_std=0.1, vertical_std=0.1) for x in (batch, in_parts(batch, 2)))
    assert ((halves / whole - 1).abs() < 0.35).all()


def test_the_rows_have_the_variance_that_was_found():
    batch = scene(1, 1, seed=3)
    states = ErrorStates(structure=True)
    rules = CarConstraints(Tuning(), states, adapts_noise=True)
    memory = rules.begin(batch)
    found = ConstraintNoise.begin(batch.imu, 1)._replace(
        squares=torch.tensor([[90.0, 1.0]], dtype=D), fixes=torch.tensor([[90.0]], dtype=D)
    )
    at = epoch_of(batch, batch.start, ImuError(torch.zeros(1, 6, dtype=D)))
    P = Predicted(1e-4 * torch.eye(states.count, dtype=D).unsqueeze(0))
    row, other = (rules.rows(at, m, P)[0] for m in (memory, memory._replace(noise=found)))
    expected = [(2.5 + 90) / 100 / HIGH, (2.5 + 1) / 100 / LOW]
    torch.testing.assert_close((other.R / row.R)[0, :2], torch.tensor(expected, dtype=D))
    torch.testing.assert_close(other.R[:, 2:], row.R[:, 2:])


def test_only_a_filter_that_finds_it_carries_it():
    batch = scene(2, 3)
    rules = next(s for s in build_filter("mbkf21_car", IMU).sources if isinstance(s, CarConstraints))
    begun = rules.begin(batch), replace(rules, adapts_noise=True).code.begin(batch)
    assert isinstance(begun[0], CarMemory) and begun[0].noise is None and begun[1].noise is not None


def turn_mount(batch, epoch: int, angle: float):
    """The IMU turns about its z axis by so much [rad] in the first 0.4 s of an epoch."""
    T = batch.size[1]
    t = (torch.arange(T * M, dtype=D) + 0.5) * batch.dt - epoch * M * batch.dt
    turned, rate = angle * (t / 0.4).clamp(0, 1), torch.where((t > 0) & (t < 0.4), angle / 0.4, 0.0)
    axis = torch.stack((0 * turned, 0 * turned, -turned), -1)
    R = rotation_from_vector(axis).reshape(T, M, 3, 3)
    imu = (R[:, :, None] @ batch.imu.unflatten(-1, (2, 3)).unsqueeze(-1)).squeeze(-1).flatten(-2)
    imu[..., 5] += rate.reshape(T, M)
    return replace(batch, imu=imu)


@torch.inference_mode()
def test_a_mount_that_turns_is_found(monkeypatch):
    """By 20°, a minute and a half before an outage of 20 s, on cars that turn and keep the constraints: the mounting
    takes it. With its walk as set the biases do, and the error in the outage is several times as large."""
    batch = outage(turn_mount(slipping(4, 180, (0.0,) * 5), 60, math.radians(20)), 155, 175)

    def off():
        solution = integrate(batch, trained_filter("plus"))
        return (solution.posterior.p_n - batch.truth.p_n)[:, 174, :2].norm(dim=-1).square().mean().sqrt()

    found = off()
    monkeypatch.setattr(CarConstraints, "widen_walks", lambda self, P, *_: P)
    assert found < 3.0 and off() > 3 * found


def test_innovations_without_a_sign_leave_the_mounting_alone():
    """White ones of the size that they have for the filter, or rare large ones: the walk is as set, as a rule."""
    g = torch.Generator().manual_seed(3)
    noise, wide, one = ConstraintNoise.begin(torch.zeros(200, 1, dtype=D), 200), 0, torch.ones(200, 2, dtype=D)
    for k in range(300):
        z = torch.randn(200, 2, generator=g, dtype=D) * (30.0 if k % 50 == 0 else 1.0)
        noise = noise.update(z, 0.5 * one, 0.5 * one, 3.0, one[:, 0] > 0)
        wide += int((noise.turn.walk_factors > 2).sum())
    assert wide < 0.005 * 300 * 400
    for _ in range(20):
        noise = noise.update(one, 0.5 * one, 0.5 * one, 3.0, one[:, 0] > 0)
    assert (noise.turn.walk_factors > 1).double().mean() > 0.8
