"""Whether a running filter is lost: far from fixes that agree with each other, or at an impossible position or speed.

Gates inside filters judge one fix by the filter. Here fixes that passed the physical limits (:mod:`dlkf.data.limits`)
judge the filter: if its position is far off in ``LOST_FIXES`` of them in a row, over ``LOST_S`` seconds, or less far in
more of them, it must start over with an alignment. So a filter whose attitude was ruined by damaged samples comes back,
a gated one too, which would refuse good fixes for ever.

Two kinds of fixes do not count. One that is further from the last one, as seen from the filter, than from the filter
agrees with neither: errors of a receiver between houses. One of a receiver that repeats its last position, as many do
in a tunnel, says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.data.limits import ESTIMATE_HEIGHTS_M, ESTIMATE_M_S, LOST_FIXES, LOST_M, LOST_S, LOST_SHARE, LOST_SIGMAS
from dlkf.filters.integration import BatchSolution


class LossWatch(NamedTuple):
    """Fixes in a row that lie far off and agree with each other, the sum of their shares (:func:`far_off`), the time
    [s] of the first of them, the place of the last fix, and what the last one of the row is off by [m]."""

    count: int = 0
    total: float = 0.0
    since: float = 0.0
    place: tuple[float, ...] = ()
    off: tuple[float, ...] = ()

    def update(self, t: float, share: float, place: Sequence[float], off: Sequence[float]) -> LossWatch:
        """After a fix at ``t`` [s]; ``place`` is its position, in any axes, ``off`` its innovation."""
        if (place := tuple(place)) == self.place:
            return self
        if share == 0:
            return LossWatch(place=place)
        off = tuple(off)
        if self.off and math.dist(off, self.off) > math.hypot(*off):
            return self._replace(place=place, off=off)
        return LossWatch(self.count + 1, self.total + share, self.since if self.count else t, place, off)

    def is_lost(self, t: float) -> bool:
        """Whether that is enough at ``t`` [s]."""
        return self.total >= LOST_FIXES and (t - self.since) * self.total >= LOST_S * self.count


def far_off(innovation: Tensor, std: Tensor) -> Tensor:
    """How far positions (…, 6) are off, as a share of what fixes of this 1σ (…, 6) can be off: 0 below ``LOST_SHARE``,
    at most 1."""
    limit = (LOST_SIGMAS * std[..., :3].norm(dim=-1)).clamp_min(LOST_M)
    share = innovation[..., :3].norm(dim=-1) / limit
    return torch.where(share > LOST_SHARE, share.clamp_max(1.0), 0.0)


def is_impossible(v_n: Tensor, p_n: Tensor, origin_height: Tensor) -> Tensor:
    """Whether velocities (…, 3) [m/s] and positions [m] in a tangent frame are none of a car.

    The height is that of the origin plus what lies above the tangent plane and the Earth's curvature below it.
    """
    height = origin_height - p_n[..., 2] + p_n[..., :2].square().sum(-1) / 2 / 6.371e6
    return (v_n.norm(dim=-1) > ESTIMATE_M_S) | (height < ESTIMATE_HEIGHTS_M[0]) | (height > ESTIMATE_HEIGHTS_M[1])


def find_first_loss(batch: Batch, row: int, solution: BatchSolution) -> int | None:
    """The first epoch at whose end the filter of one drive of a batch was lost; None: never."""
    n = int(batch.present[row].sum())
    state = solution.posterior
    nowhere = is_impossible(state.v_n[row, :n], state.p_n[row, :n], batch.frame.height[row].to(state.p_n))
    at = int(torch.nonzero(nowhere)[0]) if bool(nowhere.any()) else None
    offered = (batch.gnss_valid[row, :n, :3].any(-1) & batch.available[row, :n]).to(state.p_n.device)
    far = far_off(solution.innovation[row, :n], batch.gnss_std[row, :n].to(state.p_n)) * offered
    if float(far.sum()) < LOST_FIXES:
        return at
    watch = LossWatch()
    for k in torch.nonzero(offered).flatten().tolist():
        t = k * batch.epoch_s
        off = solution.innovation[row, k, :3].tolist()
        watch = watch.update(t, float(far[k]), batch.gnss[row, k, :3].tolist(), off)
        if watch.is_lost(t):
            return k if at is None else min(at, k)
    return at
