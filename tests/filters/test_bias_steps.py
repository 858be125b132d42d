"""A step of a bias shows in the sign of its corrections: found after one, silent without, and of its own axis."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from pipelines.studies.ablations.plus_parts import parts

from dlkf.filters.bias_steps import LARGEST, LIMIT, MEMORY, POWER, SPACING_S, SignTest, normalise_corrections
from dlkf.filters.integration import Covariances, integrate
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.state import IMU

from .test_constraints import slipping

D = torch.float64


def corrected(e: torch.Tensor, dt: float = 1.0, lost: float = 1e-4, fixed: bool = True) -> SignTest:
    """After corrections (n, B, 6) of so many of their 1σ."""
    steps = SignTest.begin(e, e.shape[1], 6)
    P = torch.eye(15, dtype=D).expand(e.shape[1], -1, -1)
    for one in e:
        dx = torch.zeros(e.shape[1], 15, dtype=D)
        dx[:, IMU] = one * math.sqrt(lost)
        c = Covariances(P, P, (1 - lost) * P, P[:, :6], P[:, 0, :6], dx)
        share = torch.full((e.shape[1],), min(1.0, dt / SPACING_S), dtype=D)
        steps = steps.update(normalise_corrections(c), torch.full((e.shape[1],), fixed), share)
    return steps


def test_the_statistic_has_a_variance_of_one():
    """Independent corrections of their own variance, 0.973 as they are cut at 3, whatever the time between fixes."""
    e = torch.randn(200, 400, 6, generator=torch.Generator().manual_seed(0), dtype=D)
    for dt in (0.2, 10.0):
        steps = corrected(e, dt)
        t = steps.total / steps.weight.sqrt()
        assert float(t.var()) == pytest.approx(0.973, abs=0.1)
        assert float((steps.walk_factors > 1).double().mean()) < 0.004


def test_corrections_of_one_sign_make_the_walk_of_that_bias_grow():
    e = torch.zeros(200, 2, 6, dtype=D)
    e[:, 0, 5], e[:, 1, 1] = 2.0, -2.0
    found = corrected(e).walk_factors
    f, n = 1 - 1 / MEMORY, len(e)
    t = 2.0 * (1 - f**n) / (1 - f) / math.sqrt(f ** (2 * n) * MEMORY / 2 + (1 - f ** (2 * n)) / (1 - f**2))
    expected = torch.ones(2, 6, dtype=D)
    expected[0, 5] = expected[1, 1] = (t / LIMIT) ** POWER
    assert torch.allclose(found, expected)


def test_noise_of_either_sign_and_single_outliers_show_nothing():
    e = torch.zeros(100, 2, 6, dtype=D)
    e[::2, 0], e[1::2, 0] = 10.0, -10.0  # a hundred times the variance
    e[[0, 50], 1] = 1e3
    assert torch.equal(corrected(e).walk_factors, torch.ones(2, 6, dtype=D))


def test_the_first_fixes_show_nothing():
    assert torch.equal(corrected(torch.full((3, 1, 6), LARGEST, dtype=D)).walk_factors, torch.ones(1, 6, dtype=D))


def test_epochs_without_a_fix_are_no_evidence():
    assert torch.equal(
        corrected(torch.full((50, 1, 6), LARGEST, dtype=D), fixed=False).total, torch.zeros(1, 6, dtype=D)
    )


@pytest.mark.whole
def test_an_outage_after_a_step_is_bridged():
    """0.3 °/s or 0.3 m/s² a minute before an outage of 30 s, against the walks as set."""
    batch, cars = slipping(4, 140, (0.0,) * 5), (slice(0, 2), slice(2, 4))
    imu, available = batch.imu.clone(), torch.ones_like(batch.available)
    imu[:2, 50:, :, 5] += math.radians(0.3)
    imu[2:, 50:, :, 0] += 0.3
    available[:, 110:] = False
    batch = replace(batch, imu=imu, available=available)
    filters = (trained_filter("plus"), parts("plus")["walks as set"])
    with torch.no_grad():
        off = [(integrate(batch, f).posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1) for f in filters]
    rms = [[float(e[some].square().mean().sqrt()) for some in cars] for e in off]
    assert rms[0][0] < rms[1][0] / 5 and rms[0][1] < 0.75 * rms[1][1]
