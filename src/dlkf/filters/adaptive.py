"""Adaptive Q and R from innovations and residuals (Akhlaghi, Zhou and Huang 2017, IEEE PESGM).

    R ← α R + (1 − α) (ε εᵀ + H P⁻ Hᵀ)     ε = z − H dx, the residual after the update
    Q ← α Q + (1 − α) K d dᵀ Kᵀ             d = z, the innovation

per GNSS fix, α the ``forgetting`` factor (0.3 in the paper). R keeps its diagonal; where fixes are further apart
than an epoch, Q is what each epoch contributes. Between fixes and in an outage the last Q and R hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.integration import Epoch

SMALLEST_VARIANCE = 1e-6  # m², (m/s)²


class AdaptiveNoise(NamedTuple):
    """The adapted noise; R holds where a component has been ``known`` by a fix."""

    Q: Tensor | None  # (B, n, n) of one epoch
    R: Tensor  # (B, 6)
    known: Tensor  # (B, 6) bool
    epochs: Tensor  # (B,) since the last fix


@dataclass(frozen=True)
class Adaptation:
    """Recursive estimation of Q and R; ``forgetting`` α is the share of the past."""

    forgetting: float

    def learned(
        self,
        noise: AdaptiveNoise | None,
        epoch: Epoch,
        used: Bool[Tensor, "B 6"],
        H: Float[Tensor, "B 6 n"],
        predicted: Float[Tensor, "B n n"],
        K: Float[Tensor, "B n 6"],
        dx: Float[Tensor, "B n"],
        Q: Float[Tensor, "B n n"],
    ) -> AdaptiveNoise:
        """The noise after an epoch; ``H`` has zero rows and ``K`` zero columns where nothing was used."""
        if noise is None:
            noise = AdaptiveNoise(None, torch.ones_like(epoch.z), torch.zeros_like(used), epoch.z.new_zeros(len(used)))
        epochs = noise.epochs + 1
        has_fix = used.any(-1)
        if not bool(has_fix.any()):
            return noise._replace(epochs=epochs)
        a = self.forgetting
        residual = epoch.z - (H @ dx.unsqueeze(-1)).squeeze(-1)
        seen = residual.square() + (H @ predicted @ H.mT).diagonal(dim1=-2, dim2=-1)
        R = torch.where(noise.known, a * noise.R + (1 - a) * seen, seen).clamp_min(SMALLEST_VARIANCE)
        push = (K @ torch.where(used, epoch.z, 0.0).unsqueeze(-1))
        adapted = a * Q + (1 - a) * (push @ push.mT) / epochs[:, None, None]
        return AdaptiveNoise(
            torch.where(has_fix[:, None, None], adapted, Q),
            torch.where(used, R, noise.R),
            noise.known | used,
            torch.where(has_fix, 0.0, epochs),
        )
