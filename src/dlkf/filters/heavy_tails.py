"""Priors with heavy tails for the vertical gyroscope, which alone decides the heading of a car: its bias and scale.

Data sheets allow a scale factor 3 % off and turn-on biases of several °/s, and most units are far better. A Gaussian
prior wide enough for the worst makes every short history worse; a narrow one holds the bad unit back for minutes. So
the prior of an error x is Student's t with ν degrees of freedom, a Gaussian whose variance is itself unknown, which is
found by expectation maximisation (Lange, Little & Taylor 1989): with x and P the filter's estimate and its variance,

    σ² = (ν σ₀² + x² + P) / (ν + 1)

A constant error's prior is one measurement of 0 among the others. To widen it from σ² to σ₁² is to take away
g = 1/σ² − 1/σ₁² of information, exact at any time for a linear filter (:func:`widen_prior`):

    P⁺ = P + c p pᵀ,   dx = c x p,   c = g / (1 − g pᵢ),   p the column of x in P, pᵢ its own entry

The prior becomes wider alone, never narrower, and only where a fix was used.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import GYRO, IMU, ErrorStates

FREEDOM = 1.0  # ν
MOST = 0.9  # of the information about an error, that its prior may have


class HeavyTails(NamedTuple):
    """Variances of the priors, at the start and in force."""

    start: Tensor  # (B, k)
    variance: Tensor  # (B, k)

    @classmethod
    def begin(cls, sigma: Float[Tensor, "B m"], states: ErrorStates) -> HeavyTails:
        """With the 1σ of the IMU's errors at the start."""
        variance = torch.stack([sigma[:, k - IMU.start].square() for k in vertical_states(states)], -1)
        return cls(variance, variance.clone())

    def after(
        self, P: Float[Tensor, "B n n"], dx: Float[Tensor, "B n"], error: ImuError, states: ErrorStates,
        fixed: Bool[Tensor, " B"],
    ) -> tuple[HeavyTails, Float[Tensor, "B n n"], Float[Tensor, "B n"]]:  # fmt: skip
        """After an update by ``dx`` to P of a filter that had the IMU ``error``: priors, P and correction.

        Where no fix was used they stay: constraints alone would lead a filter astray.
        """
        found = []
        for k, start, before, x in zip(
            vertical_states(states), self.start.unbind(-1), self.variance.unbind(-1), vertical_errors(error, states)
        ):
            x, p = x + dx[:, k], torch.minimum(P[:, k, k], before)  # a walk is no evidence
            variance = torch.maximum(before, (FREEDOM * start + x.square() + p) / (FREEDOM + 1))
            variance = torch.where(fixed, variance, before)
            P, change = widen_prior(P, x, k, before, variance)
            dx = dx + change
            found.append(variance)
        return HeavyTails(self.start, torch.stack(found, -1)), P, dx


def vertical_states(states: ErrorStates) -> tuple[int, ...]:
    """Bias of the vertical gyroscope, and its scale factor where a filter has one."""
    bias = GYRO.stop - 1
    if not states.elements:
        return (bias,)
    return bias, states.of_matrix.start + len(states.elements) + states.elements.index((2, 2))


def vertical_errors(error: ImuError, states: ErrorStates) -> tuple[Tensor, ...]:
    """Estimates (B,) of :func:`vertical_states`."""
    bias = error.bias[:, 5]
    if not states.elements:
        return (bias,)
    if error.matrix is None:
        return bias, torch.zeros_like(bias)
    return bias, error.matrix[:, 5] if error.matrix.ndim == 2 else error.matrix[:, 1, 2, 2]


def widen_prior(
    P: Float[Tensor, "B n n"], x: Float[Tensor, " B"], k: int, before: Float[Tensor, " B"], after: Float[Tensor, " B"]
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"]]:
    """P and correction of the states where state k, estimated as x, had a prior of 0 with another variance."""
    column = P[:, :, k]
    known = before > 0
    less = torch.where(known, 1 / torch.where(known, before, 1.0) - 1 / torch.where(known, after, 1.0), 0.0)
    c = less / (1 - (less * column[:, k]).clamp_max(MOST))
    P = P + c[:, None, None] * column.unsqueeze(-1) * column.unsqueeze(1)
    return P, (c * x).unsqueeze(-1) * column
