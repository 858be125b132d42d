"""Fixes that scatter by more than they claim: by what factors, of positions and velocities, horizontal and down.

The trajectory of a virtual outage (:mod:`dlkf.filters.virtual_outages`) knows nothing of the fixes, and its errors grow
smoothly: with e the fixes' positions less its own, Δ³e = eₖ − 3 eₖ₋₁ + 3 eₖ₋₂ − eₖ₋₃ keeps nothing of a wrong velocity
or acceleration, and nothing of the filter. Velocities are held by the sensors over an interval far better than most
receivers measure them: of these the innovation z less the residual r = z − H dx of the one before serves, which also
shows a velocity that lags behind. For white noise of variance w s², s² = σ² + ``FLOOR``² (the motion of a car, of which
some is left in Δ³e),

    E[(Δ³e)²] = 20 w s² of positions,    E[(zₖ − rₖ₋₁)²] = 2 w σ² of velocities

and the variance of a fix is σ² + (w − 1) s². An outlier is in four of the Δ³e, and e has a step where another virtual
outage begins; so ln w of positions is a running quantile, a low one: it moves by ``STEP`` over the number of fixes, up
by the share ``QUANTILE`` of it where the square is above that quantile of χ², else down by the rest. Of velocities w is
a running mean, where a square counts with at most ``LARGEST``² w. A 1σ below the claimed one is
:mod:`dlkf.filters.position_errors`' matter.

Earlier fixes were taken for more exact than they are where w is larger than ever (by ``LEEWAY`` at first, since w is
uncertain then): of their information only the share (largest w before) / w was justified, which
:func:`dlkf.filters.receiver.discount_information` corrects for the states that a few false fixes decide.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.velocity_fit import FIT_STD, scale_std
from dlkf.filters.gating import OF_PART, PARTS, average_by_part
from dlkf.filters.integration import Covariances, Epoch
from dlkf.filters.virtual_outages import VirtualOutage
from dlkf.navigation.state import POSITION, VELOCITY

FIRST_FIXES = 10.0  # that the claimed 1σ counts for, or what the start has found
MEMORY = 300.0  # fixes
STEP, QUANTILE = 20.0, 0.3  # of ln w, over the number of fixes
LIMITS = (0.3567, 0.1485)  # the quantile of χ² of two components, over two, and of one
LARGEST = 3.0  # σ: the most that a change of a velocity's error counts
LEEWAY = 2.0  # over w at the start, below which no information is discounted
FLOOR = 3 * (FIT_STD,) + 3 * (0.0,)  # m
DIFFERENCES = (20.0, 20.0, 2.0, 2.0)  # sums of the squared coefficients of Δ³ and Δ
HORIZONTAL = [0, 2]  # of the parts of a fix
SUCCESSIVE = (4.0, 4.0, 3.0, 3.0)  # fixes from which on one counts: Δ³ takes four, and a start's velocity is off


class FixNoise(NamedTuple):
    """The last fixes, and running w over those of successive update intervals, by parts of a fix."""

    apart: Tensor  # (B, 3, 3) m, e of the last three fixes, the latest first
    residual: Tensor  # (B, 3) m/s, of the last velocity after its update
    successive: Tensor  # (B, 4) fixes up to the last
    variance: Tensor  # (B, 4) w
    fixes: Tensor  # (B, 4) what w counts for
    largest: Tensor  # (B, 2) largest w so far, of horizontal positions and velocities

    @classmethod
    def begin(cls, like: Tensor, size: int, noise: Float[Tensor, "B 2"] | None = None) -> FixNoise:
        """Before the first fix; ``noise``: √w of positions and velocities as the start has it."""
        zeros, parts = like.new_zeros, like.new_zeros(size, 4)
        variance = parts + 1.0 if noise is None else noise.square().repeat_interleave(2, -1)
        largest = LEEWAY * variance[:, HORIZONTAL].clamp_min(1.0)
        return cls(zeros(size, 3, 3), zeros(size, 3), parts, variance, parts + FIRST_FIXES, largest)

    @property
    def kept(self) -> Float[Tensor, "B 2"]:
        """Share of the information of all earlier positions and velocities that the last fix leaves."""
        return self.largest / torch.maximum(self.largest, self.variance[:, HORIZONTAL])

    def inflate_fix(self, epoch: Epoch) -> Epoch:
        """The epoch with the 1σ of its fix as large as they have scattered."""
        scatter = self.variance.clamp_min(1.0).sqrt()[:, OF_PART]
        return epoch._replace(fix=epoch.fix._replace(std=scale_std(epoch.fix.std, scatter, FLOOR)))

    def update(self, claimed: Epoch, c: Covariances, outage: VirtualOutage) -> FixNoise:
        """After an update of the filter and of the virtual outage; ``claimed`` is the epoch with the fix's own 1σ, and
        ``c`` has the H of all components, both before any gate."""
        used = claimed.used
        residual = claimed.z - torch.bmm(c.H, c.dx.unsqueeze(-1)).squeeze(-1)
        apart = residual[:, POSITION] + torch.bmm(c.H[:, POSITION], outage.drift.unsqueeze(-1)).squeeze(-1)
        one, two, three = self.apart.unbind(1)
        change = torch.cat((apart - 3 * one + 3 * two - three, claimed.z[:, VELOCITY] - self.residual), -1)
        variance = claimed.fix.std.square() + change.new_tensor(FLOOR).square()
        square = average_by_part(torch.where(used, change.square() / variance, 0.0))
        square = square / square.new_tensor(DIFFERENCES)

        successive = torch.where(used[:, PARTS], self.successive + 1, 0.0)
        counts = successive >= successive.new_tensor(SUCCESSIVE)
        fixes = (self.fixes + 1).clamp_max(MEMORY)
        above = square > square.new_tensor(2 * LIMITS) * self.variance
        step = STEP * torch.where(above, QUANTILE, QUANTILE - 1)
        quantile = (self.variance * torch.exp(step / fixes)).clamp_min(1.0)
        square = torch.minimum(square, LARGEST**2 * self.variance.clamp_min(1.0))
        mean = self.variance + (square - self.variance) / fixes
        variance = torch.cat((quantile[:, :2], mean[:, 2:]), -1)
        return FixNoise(
            torch.stack((apart, one, two), 1), residual[:, VELOCITY], successive,
            torch.where(counts, variance, self.variance), torch.where(counts, fixes, self.fixes),
            torch.maximum(self.largest, self.variance[:, HORIZONTAL]),
        )  # fmt: skip
