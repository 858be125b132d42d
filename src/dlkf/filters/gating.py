"""Innovation gating: fixes that contradict the filter are left out, and the filter gives in when it is wrong.

Position and velocity of a fix are tested apart: zᵀ S⁻¹ z against χ² (Groves sect. 17.3). A filter that has become
sure of a wrong position would refuse good fixes for ever; so when fixes in a row are refused that agree with each
other, its covariance is opened up to them. A receiver that repeats the same fix while the car moves is frozen, and not
believed until it says something else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.special import gammaincinv
from torch import Tensor

from dlkf.filters.integration import Epoch

PATIENCE = 5  # refused fixes that agree with each other before the filter gives in
MOST_DOUBT = 25.0  # factor on P at most: what was wrong is as a rule attitude or a bias
AGREEMENT_SIGMAS, AGREEMENT_SPEED = 6.0, 2.0  # two refusals agree within 6σ of the fixes + 2 m/s · time
FROZEN_SPEED = 1.0  # m/s: above, a fix cannot be the same twice


def chi2_quantile(probability, degrees: int):
    """What χ² of ``degrees`` stays below with ``probability``; scipy.stats has it too and takes a second to load."""
    return 2 * gammaincinv(degrees / 2, probability)


class GateMemory(NamedTuple):
    """What the gate remembers between epochs."""

    refused: Tensor  # (B,) agreeing refusals in a row
    innovation: Tensor  # (B, 3) of the last refused position
    age: Tensor  # (B,) s since then
    fix: Tensor  # (B, 6) the last fix offered
    frozen: Tensor  # (B,) bool: it did not move with the car
    limits: Tensor  # (1, 4) highest normalised innovation squared by the number of components, for all drives


class Verdict(NamedTuple):
    """What a gate says of a fix; P is to become ``factor`` · P with ``shift`` added to position and velocity."""

    passed: Tensor  # (B, 6) bool
    used: Tensor  # (B,) bool: its position passed, or its velocity where that is all there is
    shift: Tensor  # (B, 6) variance
    factor: Tensor  # (B,) ≥ 1

    def opened(self, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """P where the filter gives in, as it was elsewhere."""
        wide = self.factor[:, None, None] * P
        return wide + torch.nn.functional.pad(torch.diag_embed(self.shift), (0, P.shape[-1] - 6) * 2)


@dataclass(frozen=True)
class Gate:
    """χ² gate with recovery; ``probability`` is that of passing a good fix."""

    probability: float

    def begin(self, like: Tensor) -> GateMemory:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        zeros = like.new_zeros
        B, limits = len(like), like.new_tensor([self._limits])
        return GateMemory(
            zeros(B), zeros(B, 3), zeros(B), torch.full_like(zeros(B, 6), torch.nan), zeros(B) > 0, limits
        )

    def judge(
        self, memory: GateMemory, epoch: Epoch, S: Float[Tensor, "B 6 6"], variance: Float[Tensor, "B 6"]
    ) -> tuple[GateMemory, Verdict]:
        """What passes, and how far P is to be opened where the filter gives in.

        ``S`` is the innovation covariance with unit rows where a component is not offered, ``variance`` the fix's.
        """
        used, z = epoch.used, epoch.z
        position, velocity = used[:, :3].any(-1), used[:, 3:].any(-1)
        offered = position | velocity
        same = (epoch.fix.value == memory.fix)[:, :3].all(-1) & position
        frozen = same & (memory.frozen | (epoch.window.end.v_n.norm(dim=-1) > FROZEN_SPEED))
        fits = torch.stack(
            [self._fits(z[:, k], S[:, k, k], used[:, k], memory.limits) for k in (slice(0, 3), slice(3, 6))], -1
        )
        age = memory.age + epoch.dt * epoch.imu.shape[1]
        wrong = position & ~fits[:, 0] & ~frozen
        refused = torch.where(self._agrees(memory, z, used, variance, age), memory.refused + 1, 1.0)
        refused = torch.where(wrong, refused, torch.where(position & ~frozen, 0.0, memory.refused))
        yields = refused >= PATIENCE
        passed = (fits.repeat_interleave(3, -1) | yields.unsqueeze(-1)) & used & ~frozen.unsqueeze(-1)
        surprise = torch.where(used, z.square() / S.diagonal(dim1=-2, dim2=-1), 0.0).sum(-1) / used.sum(-1).clamp_min(1)
        verdict = Verdict(
            passed,
            used=torch.where(position, passed[:, :3].any(-1), passed.any(-1)),
            shift=torch.where(yields.unsqueeze(-1) & passed, z * z, 0.0),
            factor=torch.where(yields, surprise.clamp(1.0, MOST_DOUBT), 1.0),
        )
        return GateMemory(
            torch.where(yields, 0.0, refused),
            torch.where(wrong.unsqueeze(-1), z[:, :3], memory.innovation),
            torch.where(wrong, 0.0, age),
            torch.where(offered.unsqueeze(-1), epoch.fix.value, memory.fix),
            torch.where(position, frozen, memory.frozen),
            memory.limits,
        ), verdict

    def _agrees(self, memory: GateMemory, z: Tensor, used: Tensor, variance: Tensor, age: Tensor) -> Tensor:
        """Whether a position says what the last refused one said: as far off, or farther by the velocity that the
        fix says the filter is wrong by."""
        change = z[:, :3] - memory.innovation
        explained = (z[:, 3:] * used[:, 3:]) * age.unsqueeze(-1)
        spread = AGREEMENT_SIGMAS * (2 * variance[:, :3]).sum(-1).sqrt() + AGREEMENT_SPEED * age
        near = (change.norm(dim=-1) < spread) | ((change - explained).norm(dim=-1) < spread)
        return near & (memory.refused > 0)

    def _fits(self, z: Tensor, S: Tensor, used: Tensor, limits: Tensor) -> Tensor:
        factor = torch.linalg.cholesky_ex(S, check_errors=not torch.compiler.is_compiling())[0]
        nis = (z * torch.cholesky_solve(z.unsqueeze(-1), factor).squeeze(-1)).sum(-1)
        return nis <= limits[0, used.sum(-1)]

    @cached_property
    def _limits(self) -> tuple[float, ...]:
        return (0.0, *(float(chi2_quantile(self.probability, components)) for components in (1, 2, 3)))
