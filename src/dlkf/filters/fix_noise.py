"""Fixes that scatter by more than they claim: factors on their 1σ, of positions and velocities, horizontal and down.

With the innovation z of a fix and the residual r = z − H dx of the one before after its update, the error of a
component has changed by u = (zₖ − rₖ₋₁) / σ, and by what the filter drifts in an update interval. Of a variance w in
units of σ²

    E[uₖ uₖ₋₁] = −w,    ½ E[uₖ²] = w

The first holds for white noise alone, whatever the filter drifts by from one fix to the next; it serves for positions,
which a wrong velocity carries along. Velocities are held by the sensors over an interval far better than most
receivers measure them, so of these the second serves: it also shows a velocity that lags behind. Running means give w;
u counts with at most ``LARGEST`` √w, so that a few outliers do not make all fixes noisy. A 1σ below the claimed one is
:mod:`dlkf.filters.position_errors`' matter.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dlkf.filters.gating import OF_PART, PARTS, by_part
from dlkf.filters.integration import Covariances, Epoch

CLAIMED_FIXES = 10.0  # that the claimed 1σ counts for before anything is known
MEMORY = 300.0  # fixes
LARGEST = 3.0  # σ: the most that a change of the error counts


class FixNoise(NamedTuple):
    """The last fix, and running means over pairs of fixes in successive update intervals, by parts of a fix."""

    residual: Tensor  # (B, 6) m, m/s, of the last fix after its update
    change: Tensor  # (B, 6) u
    successive: Tensor  # (B, 4) fixes up to the last
    variance: Tensor  # (B, 4) w
    fixes: Tensor  # (B, 4) what the means count for

    @classmethod
    def begin(cls, like: Tensor, size: int) -> FixNoise:
        """Before the first fix."""
        components, parts = like.new_zeros(size, 6), like.new_zeros(size, 4)
        return cls(components, components, parts, parts + 1.0, parts + CLAIMED_FIXES)

    def inflated(self, epoch: Epoch) -> Epoch:
        """The epoch with the 1σ of its fix as large as its errors have been."""
        factor = self.variance.clamp_min(1.0).sqrt()[:, OF_PART]
        return epoch._replace(fix=epoch.fix._replace(std=epoch.fix.std * factor))

    def after(self, claimed: Epoch, c: Covariances) -> FixNoise:
        """After an update of the filter; ``claimed`` is the epoch with the fix's own 1σ, before any gate."""
        used = claimed.used
        change = torch.where(used, (claimed.z - self.residual) / claimed.fix.std, 0.0)
        size, largest = by_part(change.square()).sqrt(), LARGEST * self.variance.clamp_min(1.0).sqrt()
        change = change * (largest / torch.maximum(size, largest))[:, OF_PART]
        white, square = -by_part(change * self.change), 0.5 * by_part(change.square())
        successive = torch.where(used[:, PARTS], self.successive + 1, 0.0)
        counts = successive >= 3  # two changes of the error
        fixes = (self.fixes + 1).clamp_max(MEMORY)
        variance = self.variance + (torch.cat((white[:, :2], square[:, 2:]), -1) - self.variance) / fixes
        residual = claimed.z - torch.bmm(c.H, c.dx.unsqueeze(-1)).squeeze(-1)
        return FixNoise(
            torch.where(used, residual, 0.0), change, successive, torch.where(counts, variance, self.variance),
            torch.where(counts, fixes, self.fixes),
        )  # fmt: skip
