"""How far a car breaks the vehicle constraints, and by what factor their variance is to change for it.

While fixes hold the filter, the innovation z of a row across the car (:mod:`dlkf.filters.constraints`) shows what
roads, tyres and the mount do. Its mean square over its variance

    m = (``FIRST`` ``EXPECTED`` + Σ z²/(H P Hᵀ + σ²)) / (FIRST + Σ 1)

over the last ``MEMORY`` fixes in motion, sideways and down apart, would be 1 for rows with white noise of variance σ².
But what roads and tyres do lasts for seconds, and the σ that is best in outages is larger: with m between ``LOW`` and
``HIGH`` it fits. Beyond, the variance is σ² m/HIGH or σ² m/LOW, within ``LEAST`` and ``MOST`` times σ². z² is capped at
9 (H P Hᵀ + f σ²), f the factor in force.

The mean itself shows a mount that has turned: an IMU that is not bolted down, a phone in its holder. Its innovations
keep their sign until the filter has found the new mounting, whose states hardly walk; the biases would take it instead.
So the sign is tested as that of the corrections of a bias (:mod:`dlkf.filters.bias_steps`), with e = z/√(H P Hᵀ + σ²),
and the walks of mounting yaw (sideways) and pitch (down) are multiplied as theirs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.bias_steps import SignTest

FIRST, EXPECTED = 10.0, 0.25  # fixes for which a mean of so much counts at the start
MEMORY = 300.0  # fixes
LOW, HIGH = 0.1, 0.5  # of m, where σ fits
LEAST, MOST = 0.1, 10.0


class ConstraintNoise(NamedTuple):
    """Running sums over fixes in motion."""

    squares: Tensor  # (B, 2) of z² over its variance, sideways and down
    fixes: Tensor  # (B, 1) how many, those long ago less
    turn: SignTest  # of the mounting in yaw and pitch

    @classmethod
    def begin(cls, like: Tensor, batch_size: int) -> ConstraintNoise:
        """Before the first fix."""
        zeros = like.new_zeros
        return cls(zeros(batch_size, 2), zeros(batch_size, 1), SignTest.begin(like, batch_size, 2))

    @property
    def factor(self) -> Float[Tensor, "B 2"]:
        """On the variance of the rows."""
        mean = (FIRST * EXPECTED + self.squares) / (FIRST + self.fixes)
        return torch.maximum(mean / HIGH, (mean / LOW).clamp_max(1.0)).clamp(LEAST, MOST)

    def update(
        self,
        z: Float[Tensor, "B 2"],
        of_state: Float[Tensor, "B 2"],
        variance: Float[Tensor, "B 2"],
        sigmas: float,
        learns: Bool[Tensor, " B"],
    ) -> ConstraintNoise:
        """Sums after an update interval; only drives that ``learns`` marks count. ``of_state`` is H P Hᵀ, ``variance``
        σ² of a row a second, ``sigmas`` how many σ in force an innovation counts at most."""
        counts = learns.to(z.dtype).unsqueeze(-1)
        keep = 1 - counts / MEMORY
        most = sigmas**2 * (of_state + self.factor * variance)
        square = torch.minimum(z.square(), most) / (of_state + variance)
        turn = self.turn.update(z / (of_state + variance).sqrt(), learns, torch.ones_like(z[:, 0]))
        return ConstraintNoise(keep * self.squares + counts * square, keep * self.fixes + counts, turn)
