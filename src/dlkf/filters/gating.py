"""Innovation gating: fixes that contradict the filter are left out, and a filter that is wrong recovers (inflates P).

Position and velocity of a fix are tested apart: zᵀ S⁻¹ z against χ² (Groves sect. 17.3). A filter that has become
sure of a wrong position would refuse good fixes for ever; so when fixes in a row are refused that agree with each
other, its covariance is inflated and they pass. An error of attitude or a bias takes more than one of them to correct:
those that follow and agree pass likewise, until as many have passed the test. A receiver that repeats the same fix
while the car moves is frozen, and not used until it changes.

Filters without that gate have a coarse one that cannot be switched off (:class:`CoarseGate`): a fix ``COARSE_SIGMAS``
off, such as the first one after a tunnel, is left out. On data whose noise is as stated it never acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.branches import may_branch
from dlkf.filters.integration import Epoch
from dlkf.navigation.compiled import is_recorded
from dlkf.navigation.state import PV

PATIENCE = 5  # refused fixes that agree with each other before the filter recovers
MOST_DOUBT = 25.0  # factor on P at most: what was wrong is as a rule attitude or a bias
AGREEMENT_SIGMAS, AGREEMENT_SPEED = 6.0, 2.0  # two refusals agree within 6σ of the fixes + 2 m/s · time
FROZEN_SPEED = 1.0  # m/s: above, a fix cannot be the same twice
COARSE_SIGMAS, COARSE_FLOOR = 20.0, (2.0, 0.5)  # m, m/s added to 1σ of position and velocity: an error, no noise
COARSE_PATIENCE = 2  # refused fixes that agree with each other before such a filter recovers
COARSE_JUMP = 1000.0  # m: beyond, P is inflated; less is a filter's own drift, whose shape P has
UNKNOWN_SPEED = 60.0  # m/s: of a car between two fixes without velocity
NEAR = COARSE_SIGMAS * COARSE_FLOOR[1] / 3**0.5  # m, m/s: with no component beyond, nothing is refused


def chi2_quantile(probability, degrees: int | float):
    """What χ² of ``degrees`` stays below with ``probability``; scipy.stats has it too and takes a second to load."""
    from scipy.special import gammaincinv

    return 2 * gammaincinv(degrees / 2, probability)


class GateMemory(NamedTuple):
    """Memory of the gate between epochs."""

    refused: Tensor  # (B,) agreeing refusals in a row, less what has passed since
    innovation: Tensor  # (B, 3) of the last refused position; 0 once the filter has moved there
    age: Tensor  # (B,) s since then
    fix: Tensor  # (B, 6) the last fix offered
    frozen: Tensor  # (B,) bool: it did not move with the car
    limits: Tensor  # (1, 4) highest normalised innovation squared by the number of components, for all drives


class Verdict(NamedTuple):
    """A gate's verdict on a fix; P is to become ``factor`` · P with ``shift`` added to position and velocity."""

    passed: Tensor  # (B, 6) bool
    used: Tensor  # (B,) bool: its position passed, or its velocity where that is all there is
    shift: Tensor  # (B, 6) variance
    factor: Tensor  # (B,) ≥ 1

    def inflated(self, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """P inflated where the filter recovers, unchanged elsewhere."""
        wide = self.factor[:, None, None] * P
        wide[:, PV, PV] += torch.diag_embed(self.shift)
        return wide


class CoarseMemory(NamedTuple):
    """Memory of the coarse gate between epochs."""

    refused: Tensor  # (B,) agreeing refusals in a row
    fix: Tensor  # (B, 6) the last refused one
    moves: Tensor  # (B,) bool: it had a velocity
    age: Tensor  # (B,) s since then


@dataclass(frozen=True)
class CoarseGate:
    """Leaves out a fix whose position is ``COARSE_SIGMAS`` · √(P + R + floor²) off, and a velocity likewise.

    P is that of the update before, position's grown by velocity's over the update interval. Refused fixes are compared
    with each other, not with the filter: with ``COARSE_PATIENCE`` in a row whose positions and velocities agree they
    pass, so that a filter that is itself wrong loses one fix; beyond ``COARSE_JUMP`` P is inflated as
    :class:`Gate` does.
    """

    def begin(self, like: Tensor) -> CoarseMemory:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        B, zeros = len(like), like.new_zeros
        return CoarseMemory(zeros(B), zeros(B, 6), zeros(B) > 0, zeros(B))

    def screened(
        self, memory: CoarseMemory, epoch: Epoch, P: Float[Tensor, "B n n"]
    ) -> tuple[CoarseMemory, Epoch, Float[Tensor, "B n n"]]:
        """The epoch without what is refused, and P, inflated where the gate recovers."""
        if may_branch(epoch.z) and float(epoch.z.detach().abs().max()) <= NEAR and not bool(memory.refused.any()):
            return memory, epoch, P
        with torch.no_grad():
            memory, verdict = self._judge(memory, epoch, P.diagonal(dim1=-2, dim2=-1))
        fix = epoch.fix._replace(used=verdict.passed)
        return memory, epoch._replace(z=epoch.z * verdict.passed, fix=fix), verdict.inflated(P)

    def _judge(
        self, memory: CoarseMemory, epoch: Epoch, variance: Float[Tensor, "B n"]
    ) -> tuple[CoarseMemory, Verdict]:
        z, used, span = epoch.z, epoch.used, epoch.dt * epoch.imu.shape[1]
        R, age = epoch.fix.std.square(), memory.age + span
        floor = torch.cat([torch.full_like(z[:, :3], x * x) for x in COARSE_FLOOR], -1)
        grown = torch.cat((variance[:, :3] + span * span * variance[:, 3:6], variance[:, 3:6]), -1)
        squares = torch.where(used, z.square() / (grown + R + floor), 0.0)
        position = used[:, :3].any(-1)
        wrong = squares[:, :3].sum(-1) > COARSE_SIGMAS**2
        fast = squares[:, 3:].sum(-1) > COARSE_SIGMAS**2
        moves = used[:, 3:].any(-1)
        agrees = self._agrees(memory, epoch.fix.value, moves, R, age) & (memory.refused > 0)
        refused = torch.where(agrees, memory.refused + 1, torch.ones_like(memory.refused))
        refused = torch.where(wrong, refused, torch.where(position, 0.0, memory.refused))
        yields = refused >= COARSE_PATIENCE
        passes = torch.stack((~wrong | yields, ~(wrong | fast) | yields), -1).repeat_interleave(3, -1) & used
        jumps = yields & (z[:, :3].norm(dim=-1) > COARSE_JUMP)
        mean = squares.sum(-1) / used.sum(-1).clamp_min(1)
        verdict = Verdict(
            passes,
            used=passes.any(-1),
            shift=torch.where(jumps.unsqueeze(-1) & passes, z * z, 0.0),
            factor=torch.where(jumps, mean.clamp(1.0, MOST_DOUBT), 1.0),
        )
        return CoarseMemory(
            torch.where(yields, 0.0, refused),
            torch.where(wrong.unsqueeze(-1), epoch.fix.value, memory.fix),
            torch.where(wrong, moves, memory.moves),
            torch.where(wrong, 0.0, age),
        ), verdict

    @staticmethod
    def _agrees(memory: CoarseMemory, fix: Tensor, moves: Tensor, R: Tensor, age: Tensor) -> Tensor:
        """Whether the way from the last refused position is that of the mean of both velocities."""
        known = (moves & memory.moves).unsqueeze(-1)
        way = torch.where(known, 0.5 * (fix[:, 3:] + memory.fix[:, 3:]) * age.unsqueeze(-1), 0.0)
        spread = AGREEMENT_SIGMAS * (2 * R[:, :3]).sum(-1).sqrt() + AGREEMENT_SPEED * age
        spread = spread + torch.where(known.squeeze(-1), 0.0, UNKNOWN_SPEED * age)
        return (fix[:, :3] - memory.fix[:, :3] - way).norm(dim=-1) < spread


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
        """What passes, and by how much P is inflated where the filter recovers.

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
        fewer = (memory.refused - 1).clamp_min(0.0)
        refused = torch.where(wrong, refused, torch.where(position & ~frozen, fewer, memory.refused))
        yields = wrong & (refused >= PATIENCE)
        passed = (fits.repeat_interleave(3, -1) | yields.unsqueeze(-1)) & used & ~frozen.unsqueeze(-1)
        nis = torch.where(used, z.square() / S.diagonal(dim1=-2, dim2=-1), 0.0).sum(-1) / used.sum(-1).clamp_min(1)
        verdict = Verdict(
            passed,
            used=torch.where(position, passed[:, :3].any(-1), passed.any(-1)),
            shift=torch.where(yields.unsqueeze(-1) & passed, z * z, 0.0),
            factor=torch.where(yields, nis.clamp(1.0, MOST_DOUBT), 1.0),
        )
        return GateMemory(
            refused.clamp_max(PATIENCE),
            torch.where(wrong.unsqueeze(-1), torch.where(yields.unsqueeze(-1), 0.0, z[:, :3]), memory.innovation),
            torch.where(wrong, 0.0, age),
            torch.where(offered.unsqueeze(-1), epoch.fix.value, memory.fix),
            torch.where(position, frozen, memory.frozen),
            memory.limits,
        ), verdict

    def _agrees(self, memory: GateMemory, z: Tensor, used: Tensor, variance: Tensor, age: Tensor) -> Tensor:
        """Whether a position agrees with the last refused one: as far off, or further by the velocity that the
        fix contradicts the filter by."""
        change = z[:, :3] - memory.innovation
        explained = (z[:, 3:] * used[:, 3:]) * age.unsqueeze(-1)
        spread = AGREEMENT_SIGMAS * (2 * variance[:, :3]).sum(-1).sqrt() + AGREEMENT_SPEED * age
        near = (change.norm(dim=-1) < spread) | ((change - explained).norm(dim=-1) < spread)
        return near & (memory.refused > 0)

    def _fits(self, z: Tensor, S: Tensor, used: Tensor, limits: Tensor) -> Tensor:
        factor = torch.linalg.cholesky_ex(S, check_errors=not is_recorded())[0]
        nis = (z * torch.cholesky_solve(z.unsqueeze(-1), factor).squeeze(-1)).sum(-1)
        return nis <= limits[0, used.sum(-1)]

    @cached_property
    def _limits(self) -> tuple[float, ...]:
        return (0.0, *(float(chi2_quantile(self.probability, components)) for components in (1, 2, 3)))
