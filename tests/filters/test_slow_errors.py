"""Slow errors of positions as states: what becomes of them in time, in the rows of a fix and at a start."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.filters.aids.attach import add_sources
from dlkf.filters.aids.receiver import SlowErrors
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.plus import ANY_MEMS, PlusConfig, PlusFilter
from dlkf.filters.slow_errors import WANDER_S, let_decay, let_wander, of_slow_errors, select_slow_errors, split_start
from dlkf.navigation.imu_errors import imu_spec
from dlkf.navigation.state import POSITION

from .scene import scene

D = torch.float64


@pytest.fixture(scope="module")
def kalman():
    return add_sources(build_filter("mbkf15", imu_spec(ANY_MEMS)), [SlowErrors])


def test_with_fixes_it_becomes_the_stationary_process_and_without_them_it_stays(kalman):
    """The variance of a Gauss-Markov process that w drives: v / (1 − exp(−2 T / τ)); the rest of P decays with it."""
    slow, variance = of_slow_errors(kalman.states), torch.tensor([[0.04, 0.04, 0.09]], dtype=D)
    P = torch.eye(18, dtype=D)[None].clone()
    P[:, slow, slow] = 0
    P[:, 0, slow.start] = P[:, slow.start, 0] = 0.3
    for _ in range(400):
        P = let_wander(let_decay(P, kalman.states, 1.0), variance, torch.tensor([True]), kalman.states, 1.0)
    want = variance / (1 - math.exp(-2 / WANDER_S))
    assert torch.allclose(P[:, slow, slow], torch.diag_embed(want), rtol=1e-6)
    assert float(P[0, 0, slow.start]) == pytest.approx(0.3 * math.exp(-400 / WANDER_S))
    after = let_wander(let_decay(P, kalman.states, 1.0), 0 * variance, torch.tensor([False]), kalman.states, 1.0)
    assert torch.allclose(after[:, slow, slow], P[:, slow, slow])


def test_at_a_start_from_a_fix_position_and_slow_error_are_one(kalman):
    """Their sum, which is the fix, is as certain as it was."""
    slow, P = of_slow_errors(kalman.states), torch.diag_embed(torch.linspace(0.1, 2.0, 18, dtype=D))[None]
    P[:, slow, slow] = 0
    split = split_start(P, kalman.states)
    H = torch.zeros(1, 3, 18, dtype=D)
    H[:, :, POSITION] = H[:, :, slow] = torch.eye(3, dtype=D)
    assert torch.allclose(H @ split @ H.mT, H @ P @ H.mT)
    assert torch.allclose(split[:, POSITION, POSITION], 2 * P[:, POSITION, POSITION])


def test_a_receiver_that_wanders_is_averaged_over():
    """Errors of 2 m that wander over 40 s, claimed as 1 m: after five minutes positions are closer than the fixes, and
    no filter that takes them for white noise is; what the states hold is a part of what the receiver is off."""
    g, errors = torch.Generator().manual_seed(3), torch.zeros(6, 400, 3, dtype=D)
    now, decay = 2 * torch.randn(6, 3, generator=g, dtype=D), math.exp(-1 / WANDER_S)
    for k in range(400):
        errors[:, k] = now
        now = decay * now + 2 * math.sqrt(1 - decay**2) * torch.randn(6, 3, generator=g, dtype=D)
    batch = scene(6, 400, seed=5, position_std=1e-3)
    gnss, std = batch.gnss.clone(), batch.gnss_std.clone()
    gnss[..., :3] += errors
    std[..., :3] = 1.0
    batch = replace(batch, gnss=gnss, gnss_std=std)
    model = PlusFilter(PlusConfig.from_mapping({"base": "mbkf15", "network": {"hidden": 16}})).eval()
    for p in model.parameters():
        torch.nn.init.zeros_(p)
    with torch.inference_mode():
        found = integrate(batch, model)
    off = (found.posterior.p_n - batch.truth.p_n)[:, 200:, :2]
    assert off.square().mean().sqrt() < 0.8 * errors[:, 200:, :2].square().mean().sqrt()
    states = found.aids[..., : len(model.states.others)].flatten(0, 1)
    slow = select_slow_errors(states, model.states).unflatten(0, (6, 400))[:, 200:]
    together = torch.corrcoef(torch.stack((slow[..., :2].flatten(), errors[:, 200:, :2].flatten())))[0, 1]
    assert together > 0.6
