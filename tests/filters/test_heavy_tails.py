"""A prior with heavy tails: exact against a filter that had the wider one, deaf to a walk, and what it is worth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.filters.build import build_filter
from dlkf.filters.heavy_tails import FREEDOM, MOST, HeavyTails, vertical_scale, widen_prior
from dlkf.filters.integration import integrate
from dlkf.filters.kalman_update import kalman_update
from dlkf.filters.model_based import Mbkf
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import ErrorStates

from .test_constraints import slipping

D, FIXED = torch.float64, torch.tensor([True])
UNIT = ImuSpec(
    "unit", SensorErrors(1e-3, 0.02, 1e-4, 3600.0, 3e-3, 3e-3), SensorErrors(7e-5, 1e-3, 1e-5, 3600.0, 5e-3, 3e-3)
)


def test_a_prior_widened_after_the_fact_is_one_that_was_as_wide_from_the_start():
    """Five states, twelve measurements of some of them, the prior of one widened after seven."""
    g = torch.Generator().manual_seed(3)
    H, R = torch.randn(2, 12, 5, generator=g, dtype=D), torch.rand(2, 12, generator=g, dtype=D) + 0.1
    z, A = 3 * torch.randn(2, 12, generator=g, dtype=D), torch.randn(2, 5, 5, generator=g, dtype=D)
    A[:, 3] = A[:, :, 3] = 0.0
    start = A @ A.mT
    narrow, wide = (start.clone() for _ in range(2))
    narrow[:, 3, 3], wide[:, 3, 3] = 0.25, torch.tensor([2.0, 0.5], dtype=D)

    def run(P, x, rows):
        for i in rows:
            h = H[:, i : i + 1]
            dx, _, P = kalman_update(P, h, R[:, i : i + 1], z[:, i : i + 1] - (h @ x.unsqueeze(-1)).squeeze(-1))
            x = x + dx
        return P, x

    P, x = run(narrow, torch.zeros(2, 5, dtype=D), range(7))
    P, change = widen_prior(P, x[:, 3], 3, torch.full((2,), 0.25, dtype=D), wide[:, 3, 3])
    P, x = run(P, x + change, range(7, 12))
    expected, of_wide = run(wide, torch.zeros(2, 5, dtype=D), range(12))
    assert torch.allclose(P, expected) and torch.allclose(x, of_wide)


@pytest.mark.parametrize("matrix", ["scale", "full"])
def test_the_state_is_that_of_the_vertical_gyroscope(matrix):
    states = ErrorStates(matrix)
    dx, error = torch.zeros(1, states.count, dtype=D), ImuError(torch.zeros(1, 6, dtype=D))
    dx[:, vertical_scale(states)] = 0.25
    found = error.update(dx, states).at(torch.tensor([[1.0, 2.0, 3.0, 5.0, 7.0, 2.0]], dtype=D))
    assert torch.equal(found, torch.tensor([[0.0, 0, 0, 0, 0, 0.5]], dtype=D))


@pytest.mark.parametrize("matrix", ["scale", "full"])
def test_a_prior_widens_with_what_is_found_and_with_nothing_else(matrix):
    states = ErrorStates(matrix)
    k, nothing = vertical_scale(states), ImuError(torch.zeros(1, 6, dtype=D))
    tails = HeavyTails.begin(torch.full((1, states.imu), 0.1, dtype=D), states)
    P, dx = 0.01 * torch.eye(states.count, dtype=D)[None], torch.zeros(1, states.count, dtype=D)
    grown = P.clone()
    grown[:, k, k] = 0.04  # as of a walk
    for unchanged in (P, grown):
        after, same, change = tails.update(unchanged, dx, nothing, states, FIXED)
        assert torch.equal(after.variance, tails.start) and torch.equal(same, unchanged) and torch.equal(change, dx)
    known, moved = 1e-6 * P, dx.clone()
    moved[:, k] = 0.2
    error = nothing.update(moved, states)
    found, _, _ = tails.update(known, 0.25 * moved, error, states, FIXED)
    assert float(found.variance) == pytest.approx((FREEDOM * 0.01 + 0.25**2) / (FREEDOM + 1), rel=1e-5)
    back, _, _ = found.update(known, dx, nothing, states, FIXED)
    assert torch.equal(back.variance, found.variance)
    most, _, _ = tails.update(known, 9 * moved, error, states, FIXED)
    assert float(most.variance) == pytest.approx(MOST**2 * 0.01)
    alone, _, _ = tails.update(known, moved, error, states, ~FIXED)
    assert torch.equal(alone.variance, tails.start)


def heading_error(batch, estimator: Mbkf) -> float:
    """At the end [rad], RMS."""
    with torch.no_grad():
        solution = integrate(batch, estimator)
    C = solution.posterior.C_nb[:, -1] @ batch.truth.C_nb[:, -1].mT
    return float(torch.atan2(C[:, 1, 0], C[:, 0, 0]).square().mean().sqrt())


def test_a_gyroscope_that_is_three_per_cent_off_is_found():
    """After 20 s with fixes and 40 s without; and one that is right costs nothing."""
    batch = slipping(24, 60, (0.0, 0.0, 0.8, 0.0, 0.0))
    batch = replace(batch, imu=batch.imu - batch.true_imu_error.unsqueeze(2))
    batch.available[:, 20:] = False
    factor = torch.ones(6, dtype=D)
    factor[5] = 1.03
    plain = build_filter("mbkf33_car", UNIT)
    assert isinstance(plain, Mbkf)
    heavy = replace(plain, heavy_tails=True)
    wrong = replace(batch, imu=batch.imu * factor)
    assert heading_error(wrong, heavy) < 0.5 * heading_error(wrong, plain)
    right = heading_error(batch, heavy), heading_error(batch, plain)
    assert right[0] == pytest.approx(right[1], rel=0.02) and right[0] < math.radians(1)
