"""Slow errors of positions as states: their covariance, and what they are good for."""

import math
from dataclasses import replace

import torch

from dlkf.filters.integration import integrate
from dlkf.filters.shipped import trained_filter
from dlkf.filters.slow_errors import NAMES, ErrorChange, add_columns
from dlkf.filters.smoother import smooth
from dlkf.navigation.state import POSITION, ErrorStates

from .test_constraints import slipping
from .test_gating import hidden

STD, TAU = 2.0, 60.0  # m, s
STATES = ErrorStates(others=("wheel_scale", *NAMES))


def change() -> ErrorChange:
    return ErrorChange(*torch.rand(4, 2, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))


def test_the_covariance_is_that_of_its_equation():
    """F P Fᵀ + G Gᵀ with F = diag(1, …, κ, …) and a column of G for each variance: of the process in the states, of
    the walk in the position, of what was followed in both with opposite signs."""
    A = torch.randn(2, STATES.count, STATES.count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    P, first = A @ A.mT, STATES.of(NAMES[0]).start
    for follows in (True, False):
        c = change()
        eye = torch.eye(STATES.count, dtype=torch.float64)
        at, of = eye[:, POSITION], eye[:, first : first + 3]
        F = eye - of @ of.mT + of @ torch.diag_embed(c.kept) @ of.mT
        parts = [(of, c.added), (at, c.walk), *([(at - of, c.followed)] if follows else [])]
        expected = F @ P @ F.mT + sum(G @ torch.diag_embed(x) @ G.mT for G, x in parts)
        torch.testing.assert_close(c.propagate(P, first, follows=follows), expected)
        torch.testing.assert_close(c.add_decay(eye.expand(2, -1, -1), first), F)


def test_what_was_followed_changes_no_innovation():
    """Position and error in common, with opposite signs: a fix is as probable as before."""
    P, first = torch.eye(STATES.count, dtype=torch.float64).repeat(2, 1, 1), STATES.of(NAMES[0]).start
    H = add_columns(torch.eye(6, STATES.count, dtype=torch.float64).repeat(2, 1, 1), STATES)
    c = change()._replace(kept=torch.ones(2, 3).double(), added=torch.zeros(2, 3), walk=torch.zeros(2, 3))
    after = c.propagate(P, first)
    torch.testing.assert_close(H @ after @ H.mT, H @ P @ H.mT)
    assert (after[:, POSITION, POSITION].diagonal(dim1=1, dim2=2) > 1.0).all()


def wandering(T: int, seed: int = 3, cars: int = 4):
    """Cars whose positions are off by 2 m (1σ) that change over a minute, as claimed, and the errors."""
    g, keep = torch.Generator().manual_seed(seed), math.exp(-1 / TAU)
    errors, now = torch.zeros(cars, T, 3, dtype=torch.float64), torch.randn(cars, 3, generator=g)
    for k in range(T):
        errors[:, k] = now = keep * now + math.sqrt(1 - keep**2) * torch.randn(cars, 3, generator=g)
    batch = slipping(cars, T, (0.0,) * 5)
    gnss, std = batch.gnss.clone(), batch.gnss_std.clone()
    gnss[..., :3] += STD * errors
    std[..., :3] = STD
    return replace(batch, gnss=gnss, gnss_std=std), STD * errors


@torch.inference_mode()
def solve(batch):
    return integrate(batch, trained_filter("plus"))


def test_a_position_does_not_follow_the_receivers_slow_errors():
    """After five minutes of fixes the position is less than 0.6 times as far off as the receiver, as it says."""
    batch, errors = wandering(600)
    solution = solve(batch)
    late = slice(300, 600)
    off, receiver = (x[:, late, :2] for x in (solution.posterior.p_n - batch.truth.p_n, errors))
    assert off.square().mean() < 0.6**2 * receiver.square().mean()
    assert 0.2 < (off / solution.std[:, late, :2]).square().mean() < 1.5


def test_a_smoothed_position_is_closer_and_as_sure_as_it_is():
    """The decay of the states is in Φ: in the middle of ten minutes less than 0.8 of the filter's error."""
    batch, _ = wandering(600)
    with torch.inference_mode():
        filtered, smoothed = solve(batch), smooth(batch, trained_filter("plus"))
    middle = slice(200, 400)
    before, after = ((x.posterior.p_n - batch.truth.p_n)[:, middle, :2] for x in (filtered, smoothed))
    assert after.square().mean() < 0.8**2 * before.square().mean()
    assert 0.2 < (after / smoothed.std[:, middle, :2]).square().mean() < 2.0


def test_the_first_fixes_after_an_outage_are_given_up_again():
    """15 m off, which decays within some seconds: twenty seconds later the position is where the fixes are."""
    batch, _ = wandering(400)
    gnss = batch.gnss.clone()
    gnss[:, 310:, 0] += 15.0 * torch.exp(-torch.arange(90.0, dtype=gnss.dtype) / 5)
    batch = hidden(replace(batch, gnss=gnss), slice(270, 310))
    off = (solve(batch).posterior.p_n - gnss[..., :3])[:, :, 0].abs()
    assert off[:, 330:335].max() < 1.0
