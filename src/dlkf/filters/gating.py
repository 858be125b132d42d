"""Innovation gating: fixes that contradict the filter are left out, and the filter gives in when it is wrong.

Position and velocity of a fix are tested apart: zᵀ S⁻¹ z against χ² (Groves sect. 17.3). A filter that has become
sure of a wrong position would refuse good fixes for ever; so when fixes in a row are refused that agree with each
other, its position and velocity are opened up to them. A receiver that repeats the same fix while the car moves is
frozen and not believed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.stats import chi2
from torch import Tensor

from dlkf.filters.integration import Epoch

PATIENCE = 5  # refused fixes that agree with each other before the filter gives in
AGREEMENT_SIGMAS, AGREEMENT_SPEED = 6.0, 2.0  # two refusals agree within 6σ of the fixes + 2 m/s · time
FROZEN_SPEED = 1.0  # m/s: above, a fix cannot be the same twice


class GateMemory(NamedTuple):
    """What the gate remembers between epochs."""

    refused: Tensor  # (B,) agreeing refusals in a row
    innovation: Tensor  # (B, 3) of the last refused position
    age: Tensor  # (B,) s since then
    fix: Tensor  # (B, 6) the last fix offered


@dataclass(frozen=True)
class Gate:
    """χ² gate with recovery; ``probability`` is that of passing a good fix."""

    probability: float

    def begin(self, like: Tensor) -> GateMemory:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        zeros = like.new_zeros
        B = len(like)
        return GateMemory(zeros(B), zeros(B, 3), zeros(B), torch.full_like(zeros(B, 6), torch.nan))

    def judge(
        self, memory: GateMemory, epoch: Epoch, S: Float[Tensor, "B 6 6"], variance: Float[Tensor, "B 6"]
    ) -> tuple[GateMemory, Bool[Tensor, "B 6"], Float[Tensor, "B 6"]]:
        """Which components pass, and the variance to open P by where the filter gives in (else zero).

        ``S`` is the innovation covariance with unit rows where a component is not offered, ``variance`` the fix's.
        """
        used, z = epoch.used, epoch.z
        position, velocity = used[:, :3].any(-1), used[:, 3:].any(-1)
        offered = position | velocity
        frozen = (epoch.fix.value == memory.fix)[:, :3].all(-1) & position
        frozen &= epoch.window.end.v_n.norm(dim=-1) > FROZEN_SPEED
        fits = torch.stack([self._fits(z[:, k], S[:, k, k], used[:, k]) for k in (slice(0, 3), slice(3, 6))], -1)
        age = memory.age + epoch.dt * epoch.imu.shape[1]
        spread = AGREEMENT_SIGMAS * (2 * variance[:, :3]).sum(-1).sqrt() + AGREEMENT_SPEED * age
        agrees = (z[:, :3] - memory.innovation).norm(dim=-1) < spread
        wrong = position & ~fits[:, 0] & ~frozen
        count = torch.where(wrong, torch.where(agrees & (memory.refused > 0), memory.refused + 1, 1.0), memory.refused)
        count = torch.where(position & fits[:, 0] & ~frozen, 0.0, count)
        yields = (count >= PATIENCE).unsqueeze(-1)
        passed = (fits.repeat_interleave(3, -1) | yields) & used & ~frozen.unsqueeze(-1)
        opened = torch.where(yields & passed, z * z, 0.0)
        memory = GateMemory(
            torch.where(yields[:, 0], 0.0, count),
            torch.where(wrong.unsqueeze(-1), z[:, :3], memory.innovation),
            torch.where(wrong, 0.0, age),
            torch.where(offered.unsqueeze(-1), epoch.fix.value, memory.fix),
        )
        return memory, passed, opened

    def _fits(self, z: Tensor, S: Tensor, used: Tensor) -> Tensor:
        nis = (z * torch.cholesky_solve(z.unsqueeze(-1), torch.linalg.cholesky(S)).squeeze(-1)).sum(-1)
        return nis <= z.new_tensor(self._limits)[used.sum(-1)]

    @cached_property
    def _limits(self) -> tuple[float, ...]:
        """Highest normalised innovation squared by the number of components."""
        return (0.0, *(float(x) for x in chi2.ppf(self.probability, [1, 2, 3])))
