"""Adaptive Q and R from innovations and residuals (Akhlaghi, Zhou and Huang 2017, IEEE PESGM).

    R ← α R + (1 − α) (ε εᵀ + H P⁺ Hᵀ)     ε = z − H dx, the residual after the update
    Q ← α Q + (1 − α) K d dᵀ Kᵀ             d = z, the innovation; K d is the correction

per GNSS fix, α the ``forgetting`` factor (0.3 in the paper); with the covariance after the update E[ε εᵀ] + H P⁺ Hᵀ
is R (Mohamed and Schwarz 1999). R keeps its diagonal; where fixes are further apart
than an epoch, Q is what each epoch contributes. Between fixes and in an outage the last Q and R hold.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SMALLEST_VARIANCE = 1e-6  # m², (m/s)²
SETTLE_FIXES = 30  # the first corrections are of the start's errors and not of noise


class AdaptiveNoise(NamedTuple):
    """The adapted noise, in force where and once it is ``settled``."""

    Q: Tensor  # (B, n, n) of one epoch
    R: Tensor  # (B, 6)
    settled: Tensor  # (B,) bool
    fixes: Tensor  # (B,) so far
    epochs: Tensor  # (B,) since the last fix
    forgetting: Tensor  # (1,) α, share of the past, the same for all drives

    @classmethod
    def begin(cls, like: Tensor, states: int, forgetting: float) -> AdaptiveNoise:
        """Nothing learned yet; ``like`` (B, …) gives batch and precision."""
        B, zeros = len(like), like.new_zeros
        R, zero = zeros(B, 6), zeros(B)
        return cls(zeros(B, states, states), R, zero > 0, zero, zero, like.new_tensor([forgetting]))

    def update(
        self, z: Float[Tensor, "B 6"], used: Bool[Tensor, "B 6"], H: Float[Tensor, "B 6 n"], R: Float[Tensor, "B 6"],
        P: Float[Tensor, "B n n"], dx: Float[Tensor, "B n"], Q: Float[Tensor, "B n n"],
    ) -> AdaptiveNoise:  # fmt: skip
        """After an update to P by dx, of a filter that ran with Q and R; ``H`` has zero rows where nothing was used."""
        epochs = self.epochs + 1
        has_fix = used.any(-1)
        fixes = self.fixes + has_fix
        learns = has_fix & (fixes > SETTLE_FIXES)
        a = self.forgetting
        residual = z - (H @ dx.unsqueeze(-1)).squeeze(-1)
        seen = residual.square() + (H @ P @ H.mT).diagonal(dim1=-2, dim2=-1)
        adapted_R = (a * R + (1 - a) * seen).clamp_min(SMALLEST_VARIANCE)
        adapted_Q = a * Q + (1 - a) * (dx.unsqueeze(-1) * dx.unsqueeze(-2)) / epochs[:, None, None]
        return self._replace(
            Q=torch.where(learns[:, None, None], adapted_Q, Q),
            R=torch.where(used & learns.unsqueeze(-1), adapted_R, R),
            settled=self.settled | learns, fixes=fixes, epochs=torch.where(has_fix, 0.0, epochs),
        )  # fmt: skip
