"""How far a car breaks the vehicle constraints, and by what factor their variance is to change for it.

While fixes hold the filter, the innovation z of a row across the car (:mod:`dlkf.filters.constraints`) shows what roads,
tyres and the mount do. Some of that lasts for seconds, so rows of one a second that were right as white noise would be
taken for too exact, and the 1σ σ that is best in outages is larger than z alone would have it:

    E[z²] = ``USUAL`` (H P Hᵀ + σ²)

The variance of the rows is σ² times

    f = (``FIRST_S`` + Σ z²/(USUAL (H P Hᵀ + σ²))) / (FIRST_S + Σ 1),    ``LEAST`` ≤ f ≤ ``MOST``

with the sums over the last ``MEMORY_S`` of motion with fixes, sideways and down apart. A square counts with at most that
of the innovation from which on the row's own 1σ grows.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

USUAL = 0.5  # of the variance of z, where σ fits
FIRST_S = 30.0  # for which σ counts as it is set
MEMORY_S = 300.0
LEAST, MOST = 0.4, 30.0  # a worse road may come: little below 1


class ConstraintNoise(NamedTuple):
    """Running sums of the squares and of the time."""

    squares: Tensor  # (B, 2) s, of z² over its usual variance, sideways and down
    moved: Tensor  # (B, 1) s in motion with fixes

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> ConstraintNoise:
        """Before the first fix."""
        return cls(like.new_zeros(batch_size, 2), like.new_zeros(batch_size, 1))

    @property
    def factor(self) -> Float[Tensor, "B 2"]:
        """f, on the variance of the rows."""
        return ((FIRST_S + self.squares) / (FIRST_S + self.moved)).clamp(LEAST, MOST)

    def after(
        self, z: Float[Tensor, "B 2"], variance: Float[Tensor, "B 2"], most: Float[Tensor, "B 2"],
        learns: Bool[Tensor, " B"], span: float,
    ) -> ConstraintNoise:  # fmt: skip
        """After ``span`` seconds that count where it ``learns``: ``variance`` is H P Hᵀ + σ² of a row a second, and
        ``most`` what a square counts at most."""
        time = span * learns.to(z.dtype).unsqueeze(-1)
        keep = 1 - time / MEMORY_S
        square = torch.minimum(z.square(), most) / (USUAL * variance)
        return ConstraintNoise(keep * self.squares + time * square, keep * self.moved + time)
