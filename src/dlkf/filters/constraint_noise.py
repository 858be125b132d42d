"""How far a car breaks the vehicle constraints, and by what factor their variance is to change for it.

While fixes hold the filter, the innovation z of a row across the car (:mod:`dlkf.filters.constraints`) shows what
roads, tyres and the mount do. Some of that lasts for seconds, so a row a second with the variance of white noise would
be too exact, and the 1σ σ that is best in outages is larger than z alone would have it:

    E[z²] = ``USUAL`` (H P Hᵀ + σ²)

The variance of the rows is σ² times

    f = (``FIRST`` + Σ z²/(USUAL (H P Hᵀ + σ²))) / (FIRST + Σ 1),    ``LEAST`` ≤ f ≤ ``MOST``

with the sums over the last ``MEMORY`` fixes in motion, sideways and down apart. A square counts with at most that of
the innovation from which on the row's own 1σ grows.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

USUAL = 0.5  # of the variance of z, where σ fits
FIRST = 30.0  # fixes for which σ counts as it is set
MEMORY = 300.0  # fixes
LEAST, MOST = 0.4, 30.0  # a worse road may come: little below 1


class ConstraintNoise(NamedTuple):
    """Running sums over fixes in motion."""

    squares: Tensor  # (B, 2) of z² over its usual variance, sideways and down
    fixes: Tensor  # (B, 1) how many

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> ConstraintNoise:
        """Before the first fix."""
        return cls(like.new_zeros(batch_size, 2), like.new_zeros(batch_size, 1))

    @property
    def factor(self) -> Float[Tensor, "B 2"]:
        """f, on the variance of the rows."""
        return ((FIRST + self.squares) / (FIRST + self.fixes)).clamp(LEAST, MOST)

    def after(
        self,
        z: Float[Tensor, "B 2"],
        of_state: Float[Tensor, "B 2"],
        variance: Float[Tensor, "B 2"],
        sigmas: float,
        learns: Bool[Tensor, " B"],
    ) -> ConstraintNoise:
        """After an update interval that counts where it ``learns``; H P Hᵀ, σ² of a row a second, and of how many σ in
        force an innovation counts at most."""
        counts = learns.to(z.dtype).unsqueeze(-1)
        keep = 1 - counts / MEMORY
        most = sigmas**2 * (of_state + self.factor * variance)
        square = torch.minimum(z.square(), most) / (USUAL * (of_state + variance))
        return ConstraintNoise(keep * self.squares + counts * square, keep * self.fixes + counts)
