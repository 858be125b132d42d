"""A prior with heavy tails for the scale factor of the vertical gyroscope, which decides how far a bend turns a car.

Data sheets allow 1 to 3 %, and most units are right to some thousandths. A Gaussian prior wide enough for the worst
makes every first minute worse; a narrow one holds the bad unit back for minutes. So the prior of the error x is
Student's t with ν degrees of freedom, a Gaussian whose variance is itself unknown, which is found by expectation
maximisation (Lange, Little & Taylor 1989): with x and P the filter's estimate and its variance,

    σ² = (ν σ₀² + x² + P) / (ν + 1),    at most (``MOST`` σ₀)²

A constant error's prior is one measurement of 0 among the others. To widen it from σ² to σ₁² is to take away
g = 1/σ² − 1/σ₁² of information, exact at any time for a linear filter (:func:`widen_prior`):

    P⁺ = P + c p pᵀ,   dx = c x p,   c = g / (1 − g pᵢ),   p the column of x in P, pᵢ its own entry

The prior becomes wider alone, never narrower, and only where a fix was used. A bias has none: fixes that are wrong look
like one, and a prior that follows them leads the filter astray (docs/results/plus_development.md).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import IMU, ErrorStates

FREEDOM = 1.0  # ν
MOST = 3.0  # of σ₀
SHARE = 0.9  # of the information about an error, that its prior has at most


class HeavyTails(NamedTuple):
    """Variances of the prior, at the start and in force."""

    start: Tensor  # (B,)
    variance: Tensor  # (B,)

    @classmethod
    def begin(cls, sigma: Float[Tensor, "B m"], states: ErrorStates) -> HeavyTails:
        """With the 1σ of the IMU's errors at the start."""
        variance = sigma[:, vertical_scale(states) - IMU.start].square()
        return cls(variance, variance.clone())

    def update(
        self, P: Float[Tensor, "B n n"], dx: Float[Tensor, "B n"], error: ImuError, states: ErrorStates,
        fixed: Bool[Tensor, " B"],
    ) -> tuple[HeavyTails, Float[Tensor, "B n n"], Float[Tensor, "B n"]]:  # fmt: skip
        """After an update by ``dx`` to P of a filter that had the IMU ``error``: prior, P and correction.

        Where no fix was used it stays: constraints alone would lead a filter astray.
        """
        k, before = vertical_scale(states), self.variance
        x, p = _select_scale(error) + dx[:, k], torch.minimum(P[:, k, k], before)  # a walk is no evidence
        found = ((FREEDOM * self.start + x.square() + p) / (FREEDOM + 1)).minimum(MOST**2 * self.start)
        variance = torch.where(fixed, torch.maximum(before, found), before)
        P, change = widen_prior(P, x, k, before, variance)
        return HeavyTails(self.start, variance), P, dx + change


def vertical_scale(states: ErrorStates) -> int:
    """Where the scale factor of the vertical gyroscope stands among the states."""
    return states.of_matrix.start + len(states.elements) + states.elements.index((2, 2))


def _select_scale(error: ImuError) -> Float[Tensor, " B"]:
    """Its estimate."""
    if error.matrix is None:
        return torch.zeros_like(error.bias[:, 5])
    return error.matrix[:, 5] if error.matrix.ndim == 2 else error.matrix[:, 1, 2, 2]


def widen_prior(
    P: Float[Tensor, "B n n"], x: Float[Tensor, " B"], k: int, before: Float[Tensor, " B"], after: Float[Tensor, " B"]
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"]]:
    """P and correction of the states where state k, estimated as x, had a prior of 0 with another variance."""
    column = P[:, k]  # P is symmetric, and its rows lie in memory
    known = before > 0
    less = torch.where(known, 1 / torch.where(known, before, 1.0) - 1 / torch.where(known, after, 1.0), 0.0)
    c = less / (1 - (less * column[:, k]).clamp_max(SHARE))
    P = P + c[:, None, None] * column.unsqueeze(-1) * column.unsqueeze(1)
    return P, (c * x).unsqueeze(-1) * column
