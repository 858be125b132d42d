"""Biases that have changed, by corrections that keep their sign.

Where a Kalman filter's noise is right, the corrections of successive fixes are independent, of a bias

    eₖ = dxₖ / √(P⁻ − P⁺) ~ N(0, 1),    t = Σ fⁿ⁻ᵏ eₖ / √(Σ f²⁽ⁿ⁻ᵏ⁾) ~ N(0, 1)

with f the share of the past that is kept. White noise of a sensor that is larger than assumed makes the e larger, of
either sign. A bias that has changed gives them one sign until the filter has found it, which takes minutes where the
walk of the bias is much smaller than the change. So where |t| is above ``LIMIT``, the 1σ of the walk is multiplied by
(|t| / LIMIT)^``POWER``. An e counts with at most ``LARGEST``, and the sum of squares begins as after many fixes: the
first fixes after a start and single outliers show nothing. A test for jumps with an answer that grows with the evidence
instead of an estimate of the jump (Willsky 1976, "A survey of design methods for failure detection in dynamic
systems").
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


class BiasSteps(NamedTuple):
    """Fading sums over the fixes, of the biases of accelerometers and gyroscopes."""

    total: Tensor  # (B, 6) Σ fⁿ⁻ᵏ e
    weight: Tensor  # (B, 6) Σ f²⁽ⁿ⁻ᵏ⁾

    @classmethod
    def begin(cls, like: Tensor, size: int) -> BiasSteps:
        """Before the first fix."""
        return cls(like.new_zeros(size, 6), like.new_full((size, 6), MEMORY / 2))

    def walk_factors(self) -> Float[Tensor, "B 2 3"]:
        """On the 1σ of the walks, of accelerometers and gyroscopes by axis; at least 1."""
        return widen_walk(self.total / self.weight.sqrt()).unflatten(-1, (2, 3))

    def update(self, c: Covariances, interval_s: Float[Tensor, " B"], fixed: Bool[Tensor, " B"]) -> BiasSteps:
        """After the correction of an epoch, ``interval_s`` after the last fix; unchanged without a fix."""
        lost = (c.predicted - c.updated)[:, IMU, IMU].diagonal(dim1=-2, dim2=-1)
        e = (c.dx[:, IMU] / lost.clamp_min(1e-18).sqrt()).clamp(-LARGEST, LARGEST)
        keep = 1 - (interval_s / SPACING_S).clamp_max(1.0).unsqueeze(-1) / MEMORY
        fixed = fixed.unsqueeze(-1)
        return BiasSteps(
            torch.where(fixed, keep * self.total + e, self.total),
            torch.where(fixed, keep.square() * self.weight + 1, self.weight),
        )


def widen_walk(t: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
    """Factors on the 1σ of walks; at least 1."""
    return (t.abs() / LIMIT).clamp_min(1.0).pow(POWER)
