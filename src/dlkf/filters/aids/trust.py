"""Whether a sensor's measurement counts: one that contradicts the filter is left out, and a sensor that goes on doing
so is doubted until it has agreed for a while with a filter whose own prediction is good.

A wheel that slips contradicts for seconds. One that is dead, doubled or in another unit contradicts for good; but in an
outage the filter's own uncertainty grows until anything agrees with it. So a doubted sensor has to agree where the
filter's prediction is good, which without the sensor means under GNSS.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

GATE_SIGMAS = 4.0  # an innovation beyond so many of its 1σ is refused
FULL_SIGMAS = 2.0  # beyond so many it counts less, as (FULL σ / z)²
PATIENCE = 10.0  # refusals in a row after which a sensor is doubted
PROBATION = 5.0  # agreements in a row with a filter whose own prediction is good, after which it no longer is


class Trust(NamedTuple):
    """What a sensor has earned so far."""

    refused: Tensor  # (B,) refusals in a row
    doubted: Tensor  # (B,) bool
    agreed: Tensor  # (B,) agreements in a row while doubted

    @classmethod
    def begin(cls, like: Tensor, drives: int) -> Trust:
        """Nothing against it."""
        zeros = like.new_zeros(drives)
        return cls(zeros, zeros > 0, zeros)


def judge(
    trust: Trust, seen: Bool[Tensor, " B"], z: Float[Tensor, " B"], variance: Float[Tensor, " B"],
    knows: Bool[Tensor, " B"], plausible: Bool[Tensor, " B"],
) -> tuple[Trust, Bool[Tensor, " B"], Float[Tensor, " B"]]:  # fmt: skip
    """Trust after a measurement, whether it counts, and by what its variance R grows.

    ``z`` is the innovation and ``variance`` S its own; ``knows``: the filter's prediction is good by itself;
    ``plausible``: nothing else contradicts.
    """
    squared = z.square() / variance
    fits = (squared < GATE_SIGMAS**2) & plausible
    refused = torch.where(seen, torch.where(fits, 0.0, trust.refused + 1.0), trust.refused)
    agreed = torch.where(seen & knows & fits & trust.doubted, trust.agreed + 1.0, trust.agreed)
    agreed = torch.where(seen & ~fits, 0.0, agreed)
    cleared = agreed >= PROBATION
    doubted = (trust.doubted | (refused >= PATIENCE)) & ~cleared
    after = Trust(refused, doubted, torch.where(cleared, 0.0, agreed))
    return after, seen & fits & ~doubted, (squared / FULL_SIGMAS**2).clamp_min(1.0)
