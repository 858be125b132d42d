"""Biases that have changed, by corrections that keep their sign.

Where a Kalman filter's noise is right, the corrections of successive fixes are independent, of a bias

    eₖ = dxₖ / √(P⁻ − P⁺) ~ N(0, 1),    t = Σ fⁿ⁻ᵏ eₖ / √(Σ f²⁽ⁿ⁻ᵏ⁾) ~ N(0, 1)

with f the share of the past that is kept. White noise of a sensor that is larger than assumed makes the e larger, of
either sign. A bias that has changed gives them one sign until the filter has found it, which takes minutes where the
walk of the bias is much smaller than the change. So where |t| is above ``LIMIT``, the 1σ of the walk is multiplied by
(|t| / LIMIT)^``POWER``. An e counts with at most ``LARGEST``, and the sum of squares begins as after many fixes: the
first fixes after a start and single outliers show nothing. A test for jumps with an answer that grows with the evidence
instead of an estimate of the jump (Willsky 1976, "A survey of design methods for failure detection in dynamic
systems"). The same test finds a mounting that has turned (:mod:`dlkf.filters.constraint_noise`) and a wheel whose scale
has changed (:mod:`dlkf.filters.aids.wheel_speed`), with e of their innovations.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.integration import Covariances
from dlkf.navigation.state import IMU

LIMIT, POWER = 3.0, 4.0
MEMORY, SPACING_S = 20.0, 1.0  # fixes; those closer to each other than this count for their share of it
LARGEST = 3.0  # of |e|


class SignTest(NamedTuple):
    """Fading sums over the fixes."""

    total: Tensor  # (B, k) Σ fⁿ⁻ᵏ e
    weight: Tensor  # (B, 1) Σ f²⁽ⁿ⁻ᵏ⁾

    @classmethod
    def begin(cls, like: Tensor, size: int, count: int) -> SignTest:
        """Before the first fix, for so many walks."""
        return cls(like.new_zeros(size, count), like.new_full((size, 1), MEMORY / 2))

    @property
    def walk_factors(self) -> Float[Tensor, "B k"]:
        """On the 1σ of the walks; at least 1."""
        return ((self.total / self.weight.sqrt()).abs() / LIMIT).clamp_min(1.0).pow(POWER)

    def update(self, e: Float[Tensor, "B k"], counts: Bool[Tensor, " B"], share: Float[Tensor, " B"]) -> SignTest:
        """With numbers of unit variance, of drives that count; ``share`` of a fix by which the past fades."""
        keep, counts = 1 - share.unsqueeze(-1) / MEMORY, counts.unsqueeze(-1)
        return SignTest(
            torch.where(counts, keep * self.total + e.clamp(-LARGEST, LARGEST), self.total),
            torch.where(counts, keep.square() * self.weight + 1, self.weight),
        )


def normalise_corrections(c: Covariances) -> Float[Tensor, "B 6"]:
    """e of the biases of accelerometers and gyroscopes."""
    lost = (c.predicted - c.updated)[:, IMU, IMU].diagonal(dim1=-2, dim2=-1)
    return c.dx[:, IMU] / lost.clamp_min(1e-18).sqrt()
