"""Errors of a receiver's positions: which part of its 1σ is white, and how fast the rest moves.

A receiver's 1σ covers all of an error; multipath, orbits and atmosphere change over tens of seconds. A filter that
treats that part as white noise averages over it and becomes overconfident in its velocity. Other receivers claim ten
times the error that they have. With the innovation z of a fix and the residual r = z − H dx of the one before after
its update, the error has changed by

    u = (zₖ − rₖ₋₁) / σ,

σ as it is in force (:mod:`dlkf.filters.fix_noise`), and by what the filter's velocity is off. White noise of variance
w beside a walk of variance q per interval, in units of σ², has E[uₖ²] = 2 w + q + P_v Δt² / σ² and E[uₖ uₖ₋₁] = −w,
so running means of both products give w and q. Of few fixes the mean of u²/2 is far less scattered; it is no smaller
than w and limits it, so a receiver that claims ten times its error is known after a few fixes. What is not white is a
first-order Gauss-Markov process of the receiver, a state of the filter (:mod:`dlkf.filters.slow_errors`), with a
correlation time of ``SLOW_S`` = T and the variance s² = (q T / 2Δt) σ², at most (1 − w) (``LARGEST_SLOW`` σ)². White
noise alone shows a q of c = √(4/n) w horizontally and √(8/n) w vertically after n fixes; so q counts with the weight
q² / (q² + c²).

So the filter's position does not follow an error of the receiver that it can tell from a motion of the car. It cannot
in the first fixes, nor in those after an outage, where multipath is worst: a position that comes from them is given up
again as fast as the errors change. Until ``YOUNG_S`` after them, and less so for as long again, the states are zero and
the position walks by q σ² per interval. The variance that the states have then, s² or while fixes have shown little
(1 − w) σ² ``UNKNOWN`` / n, is in the position as well, with the opposite sign: so far it had followed the error.

The noise of a fix is half the mean square by which the error changes in ``NOISE_S``, w + q ``NOISE_S`` / (2 Δt), where
that is less than claimed. It rises at once where the last changes are larger (``QUICK`` fixes). Fixes of a stationary
car count only where the carrier phase gives them: other receivers hold their position then. Horizontal and vertical
errors have means of their own. The 1σ of a position has what the states lack of the part that is not white beside the
filter's own.

All this is of errors of the usual σ. Where a receiver says that a fix is worse, before a tunnel or when it loses RTK,
that fix shows nothing of where the slow error has gone: of its σ² only what is below (``USUAL`` u)² has the factor and
the walk, the rest is white noise as claimed. ln u² follows ln σ² with a time constant of ``RISE_S`` upwards, ``FALL_S``
downwards. Changes of the error to such a fix, or between two whose σ differ by more than ``USUAL``, do not count.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.integration import Covariances, Epoch
from dlkf.filters.slow_errors import ErrorChange
from dlkf.filters.stationarity import CARRIER_STD
from dlkf.navigation.state import POSITION, VELOCITY

LARGEST_SLOW, SLOW_S = 3.0, 40.0  # σ, s
YOUNG_S, LOST_S = 15.0, 10.5  # s of fixes before slow errors are states; s without, after which they begin anew
CHANCE = (4.0, 8.0)  # n q² / w² of white noise alone, of two components and of one
UNKNOWN = 40.0  # fixes for which slow errors may be as large as stated
USUAL_FIXES = 20.0  # that white noise as claimed counts for before anything is known
FEW_FIXES = 3.0  # the same of the mean square alone
MEMORY, QUICK = 300.0, 10.0  # fixes
LARGEST = 5.0  # σ: the most that a change of the error counts
NOISE_S = 4.0  # an error that takes longer to change is no noise
MOVING = 1.0  # m/s: slower cars are left out, but for receivers of ``CARRIER_STD``
LEAST_STD = 0.02  # m, the least 1σ of a fix that is made smaller than claimed
USUAL, RISE_S, FALL_S = 2.0, 60.0, 5.0  # σ over the usual one, s
PART = [0, 0, 1]  # of a position's components: horizontal, vertical


class PositionErrors(NamedTuple):
    """The last fix, and running means over pairs of fixes in successive update intervals."""

    residual: Tensor  # (B, 3) m, of the last fix after its update
    change: Tensor  # (B, 3) u
    successive: Tensor  # (B, 2) fixes up to the last; as below, horizontal and vertical
    white: Tensor  # (B, 2) w
    walk: Tensor  # (B, 2) q
    square: Tensor  # (B, 2) mean of u² / 2
    recent: Tensor  # (B, 2) mean of (u² − P_v Δt² / σ²) / 2 over the last fixes
    fixes: Tensor  # (B, 2) what the means count for
    slow: Tensor  # (B, 3) m², variance of the last fix that is not white
    last: Tensor  # (B, 2) m², σ² of the last fix
    usual: Tensor  # (B, 2) m², u²; inf: none yet
    modelled: Tensor  # (B, 2) s² of the states, of σ² of a usual fix
    fixed_s: Tensor  # (B,) s since the first fix, or the first one after an outage

    @classmethod
    def begin(cls, like: Tensor, size: int) -> PositionErrors:
        """Before the first fix."""
        zero, zeros = like.new_zeros(size, 2), like.new_zeros(size, 3)
        return cls(
            zeros, zeros, zero, zero + 1.0, zero, zero + 1.0, zero, zero + USUAL_FIXES, zeros, zero, zero + math.inf,
            zero, zero[:, 0],
        )  # fmt: skip

    @property
    def white_share(self) -> Float[Tensor, "B 2"]:
        """Variance of the white noise over that in force, not above that of the changes."""
        return torch.minimum(self.white, self.square).clamp_min(0.0)

    def advance(self, epoch: Epoch, since_fix: Float[Tensor, " B"]) -> tuple[PositionErrors, ErrorChange]:
        """In an update interval that begins ``since_fix`` seconds after the last fix."""
        span, fixes = epoch.span_s, self.fixes
        share, walk = 1 - self.white_share.clamp_max(1.0), self.walk.clamp_min(0.0)
        largest = share * LARGEST_SLOW**2 * (2 * span / SLOW_S)  # q of the largest slow errors
        by_chance = self.white_share.square() * fixes.new_tensor(CHANCE) / fixes
        q = torch.minimum(walk.pow(3) / (walk.square() + by_chance).clamp_min(1e-12), largest)
        size = q * (SLOW_S / (2 * span))  # s²/σ²
        first = torch.maximum(size, share * (UNKNOWN / fixes).clamp_max(1.0))
        lost = since_fix > LOST_S
        fixed_s = torch.where(lost, 0.0, self.fixed_s + span)
        old, before = ((x / YOUNG_S - 1).clamp(0.0, 1.0).unsqueeze(-1) for x in (fixed_s, self.fixed_s))
        usual = torch.minimum(self.usual, self.last)  # m²
        variance, followed = ((x * usual)[:, PART] for x in (old * size, (old - before).clamp_min(0.0) * first))
        kept = math.exp(-span / SLOW_S)
        of_position = ((1 - old) * torch.minimum(walk, largest) * usual)[:, PART]
        change = ErrorChange(
            torch.where(lost.unsqueeze(-1), 0.0, torch.full_like(self.slow, kept)), (1 - kept**2) * variance,
            followed, torch.where(epoch.used[:, POSITION], of_position, 0.0),
        )  # fmt: skip
        return self._replace(modelled=old * size, fixed_s=fixed_s), change

    def noise(self, epoch: Epoch, position_std: Float[Tensor, ""]) -> Float[Tensor, "B 4"]:
        """Factors on the 1σ of position, horizontal and down, and of velocity (1), of a filter that takes positions
        for ``position_std`` times as noisy as claimed."""
        intervals = NOISE_S / epoch.span_s
        slow = self.white_share + 0.5 * intervals * self.walk.clamp_min(0.0)
        share = self._usual_share(epoch)
        factor = (1 - share * (1 - torch.maximum(slow, 0.5 * self.recent))).clamp_min(1e-6).sqrt()
        least = LEAST_STD / (position_std * epoch.fix.std[:, [0, 2]]).clamp_min(LEAST_STD)
        factor = torch.maximum(factor, least).clamp_max(1.0)
        return torch.cat((factor, torch.ones_like(factor)), -1)

    def _usual_share(self, epoch: Epoch) -> Float[Tensor, "B 2"]:
        """Of the σ² of a fix, what is below (``USUAL`` s)²."""
        return (USUAL**2 * self.usual / _of_parts(epoch)).clamp_max(1.0)

    def add_slow_std(self, std: Float[Tensor, "B k"]) -> Float[Tensor, "B k"]:
        """1σ of the states with that of the position by which the receiver is off for long and which no state has."""
        modelled = (self.modelled * torch.minimum(self.usual, self.last))[:, PART]
        position = (std[:, POSITION].square() + (self.slow - modelled).clamp_min(0.0)).sqrt()
        return torch.cat((position, std[:, POSITION.stop :]), -1)

    def update(
        self, epoch: Epoch, c: Covariances, estimated: Float[Tensor, "B 3"], corrected: Float[Tensor, "B 3"]
    ) -> PositionErrors:
        """After an update of the filter; ``estimated`` are the slow errors before it, ``corrected`` what it has added
        to them: the errors of the fixes are counted from the position without."""
        used = epoch.used[:, POSITION]
        z = epoch.z[:, POSITION] + torch.where(used, estimated, 0.0)
        std = torch.where(used, epoch.fix.std[:, POSITION], 1.0)
        change = (z - self.residual) / std
        size = torch.stack((change[:, :2].norm(dim=-1), change[:, 2].abs()), -1)
        change = change * (LARGEST / size.clamp_min(LARGEST))[:, PART]
        successive = torch.where(torch.stack((used[:, :2].all(-1), used[:, 2]), -1), self.successive + 1, 0.0)
        square, product = (_parts(change * x) for x in (change, self.change))
        span = epoch.span_s
        of_velocity = c.predicted.diagonal(dim1=-2, dim2=-1)[:, VELOCITY] * (span / std).square()
        fixes = (self.fixes + 1).clamp_max(MEMORY)
        white = self.white - (product + self.white) / fixes
        excess = square - _parts(of_velocity)
        walk = self.walk + (excess + 2 * product - self.walk) / fixes
        recent = self.recent + (0.5 * excess - self.recent) / QUICK
        square = self.square + (0.5 * square - self.square) / (fixes - USUAL_FIXES + FEW_FIXES)
        shown = (epoch.window.end.v_n.norm(dim=-1) > MOVING) | (std[:, :2].amax(-1) < CARRIER_STD)
        variance = _of_parts(epoch)
        alike = (variance < USUAL**2 * self.last) & (self.last < USUAL**2 * variance)
        fits = alike & (variance < USUAL**2 * self.usual)
        counts = (successive >= 3) & shown.unsqueeze(-1) & fits  # two changes of the error
        residual = z - torch.bmm(c.H[:, POSITION], c.dx.unsqueeze(-1)).squeeze(-1) + corrected
        found = PositionErrors(
            torch.where(used, residual, 0.0), change, successive, torch.where(counts, white, self.white),
            torch.where(counts, walk, self.walk), torch.where(counts, square, self.square),
            torch.where(counts, recent, self.recent), torch.where(counts, fixes, self.fixes), self.slow,
            torch.where(used[:, [0, 2]], variance, self.last), self.usual, self.modelled, self.fixed_s,
        )  # fmt: skip
        slow = ((1 - found.white_share.clamp_max(1.0)) * self._usual_share(epoch))[:, PART] * std.square()
        rise, fall = (-math.expm1(-span / seconds) for seconds in (RISE_S, FALL_S))
        usual = self.usual * torch.exp(torch.where(variance > self.usual, rise, fall) * (variance / self.usual).log())
        usual = torch.where(self.usual.isinf(), variance, usual)
        return found._replace(
            slow=torch.where(used, slow, self.slow), usual=torch.where(used[:, [0, 2]], usual, self.usual)
        )


def _of_parts(epoch: Epoch) -> Float[Tensor, "B 2"]:
    """σ² of a position, horizontal and down [m²]; 1 where there is none."""
    return torch.where(epoch.used[:, [0, 2]], epoch.fix.std[:, [0, 2]], 1.0).square()


def _parts(x: Float[Tensor, "B 3"]) -> Float[Tensor, "B 2"]:
    """Mean of the horizontal components, and the vertical one."""
    return torch.stack((0.5 * x[:, :2].sum(-1), x[:, 2]), -1)
