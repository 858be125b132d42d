"""A rounded measurement against the posterior on a grid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import ndtr

from dlkf.filters.aids.rounding import WIDE, rounded_measurement

HALF = 0.5 / 3.6


@pytest.mark.parametrize("dtype,within", [(torch.float64, 1e-6), (torch.float32, 2e-3)])
@pytest.mark.parametrize("sigma,tau", [(0.02, 0.03), (0.1, 0.03), (0.1, 0.1), (0.4, 0.05), (0.02, 0.2)])
def test_moments_are_those_of_the_posterior(sigma, tau, dtype, within):
    z = np.array([-0.3, -0.15, -0.05, 0.0, 0.1, 0.14, 0.2])
    of = lambda x: torch.full((len(z),), x, dtype=dtype)  # noqa: E731
    innovation, R = (
        x.double().numpy() for x in rounded_measurement(torch.tensor(z, dtype=dtype), HALF, of(sigma**2), of(tau**2))
    )
    gain = sigma**2 / (sigma**2 + R)
    s = np.linspace(-9 * sigma, 9 * sigma, 20001)
    for k, value in enumerate(z):
        if abs(value) - HALF > 4 * np.hypot(sigma, tau):
            continue  # refused by the gate
        p = np.exp(-0.5 * (s / sigma) ** 2) * (ndtr((value + HALF - s) / tau) - ndtr((value - HALF - s) / tau))
        mean = (p * s).sum() / p.sum()
        variance = (p * (s - mean) ** 2).sum() / p.sum()
        assert gain[k] * innovation[k] == pytest.approx(mean, abs=within * sigma + 1e-6 * sigma / gain[k])
        assert sigma**2 * (1 - gain[k]) == pytest.approx(variance, rel=1e-5 + within)


def test_a_wide_prediction_sees_noise_of_a_step():
    S, tau = torch.tensor([(2 * WIDE * HALF) ** 2]).double(), torch.tensor([0.01]).double()
    innovation, R = rounded_measurement(torch.tensor([0.75]).double(), HALF, S, tau)
    assert float(innovation) == 0.75 and float(R) == pytest.approx(0.01 + (2 * HALF) ** 2 / 12)


def test_a_prediction_inside_learns_little_and_one_at_the_edge_much():
    S, tau = torch.full((2,), 0.03**2).double(), torch.full((2,), 1e-3).double()
    _, R = rounded_measurement(torch.tensor([0.0, HALF]).double(), HALF, S, tau)
    assert R[0] > 30 * R[1]
