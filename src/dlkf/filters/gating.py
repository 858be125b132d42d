"""Innovation gating: outliers among the fixes are left out, and a filter that is wrong follows fixes that agree.

The four parts of a fix, position and velocity, horizontal and down, are tested apart. With k components and S the
predicted variance of the innovation z, a part is an outlier where

    d² = (1/k) Σ z² / S > (χ²ₖ / k) max(s², 1),

χ²ₖ the quantile of the probability that a good one passes (Groves sect. 17.3). With an outlying horizontal position the
whole fix is left out. s² is the usual d² over the median of χ²_k/k: its logarithm moves by ``USUAL_STEP`` up or down
with every fix (a running median, which outliers hardly move). A filter or a receiver that claims too small a 1σ has
large innovations all the time, and loses no fixes for that; an outlier is one that is larger than usual.

A filter that is sure of a wrong position would refuse good fixes; so with ``PATIENCE`` in a row that agree with each
other they pass, and z² is added to the variance: the position is elsewhere, for whichever reason, and attitude and
biases need not explain it. Velocities do not pass in this way while positions in the same fixes show that they are
wrong: those are no outliers, but would be if the filter had moved with the refused velocities. Nor do such velocities
become usual. A receiver that repeats the same fix while the car moves is frozen, and not used until it changes; one
that extrapolates its last fix neither (:mod:`dlkf.filters.coasting`).

A filter that has agreed with the fixes for ``STEADY_S`` is not wrong from one second to the next; a receiver is, for
some seconds at a time: multipath, a wrong ambiguity, or a tunnel in which it goes on by itself. So for ``HOLD_S`` it
does not follow fixes that agree with each other alone; nor do they become usual, and positions beside such velocities
are left out. After an outage of ``HOLD_S`` it follows as before.

Filters without that gate have a coarse one that cannot be switched off (:class:`CoarseGate`): a fix ``COARSE_SIGMAS``
off, such as the first one after a tunnel, is left out, and so are the fixes of a frozen receiver: positions that are
the same to the bit while the filter has moved, or those that coast. On data whose noise is as stated it never acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.branches import may_branch
from dlkf.filters.coasting import Coasting, acceleration_variance
from dlkf.filters.integration import Epoch
from dlkf.navigation.state import POSITION, PV, VELOCITY

PATIENCE = 2  # refused fixes in a row that agree with each other before the filter follows them
HOLD_S, STEADY_S = 10.0, 20.0  # s that it does not, after so long with hardly a refusal
REFUSAL = 5.0  # intervals, by which a refusal by itself shortens that time
AGREEMENT_SIGMAS, AGREEMENT_RATES = 6.0, (5.0, 2.0)  # two refusals agree within 6σ of the fixes + 5 m/s, 2 m/s² · time
FLOOR = 0.05  # m, m/s added to 1σ of an innovation
USUAL_STEP = 0.3  # per fix, by which the logarithm of the usual squared innovation follows
FIRST_USUAL = 2.0  # of that logarithm: a filter's first seconds may be worse than it knows
PARTS, OF_PART = [0, 2, 3, 5], [0, 0, 1, 2, 2, 3]  # a component of each part; the part of each component
MEDIANS = (0.6931, 0.4549, 0.6931, 0.4549)  # of d² of each part: of χ² of two and of one degree of freedom
FROZEN_SPEED = 1.0  # m/s: above, a fix cannot be the same twice
FROZEN_M, FROZEN_SIGMAS = 1.0, 5.0  # of the filter's motion, beyond which a fix cannot be the same for the coarse gate
FROZEN_KEEP = 0.9  # of that motion per fix that was used: errors of a stationary car's velocity do not add up
COARSE_SIGMAS, COARSE_FLOOR = 20.0, (2.0, 0.5)  # m, m/s added to 1σ of position and velocity: an error, no noise
COARSE_PATIENCE = 2  # refused fixes that agree with each other before such a filter recovers
COARSE_AGREEMENT = 2.0  # m/s beyond their 1σ that two of them may differ by
MOST_DOUBT = 25.0  # factor on P at most: what was wrong is as a rule attitude or a bias
COARSE_JUMP = 1000.0  # m: beyond, P is inflated; less is a filter's own drift, whose shape P has
UNKNOWN_SPEED = 60.0  # m/s: of a car between two fixes without velocity
NEAR = COARSE_SIGMAS * COARSE_FLOOR[1] / 3**0.5  # m, m/s: with no component beyond, nothing is refused


def chi2_quantile(probability, degrees: int | float):
    """What χ² of ``degrees`` stays below with ``probability``; scipy.stats has it too and takes a second to load."""
    from scipy.special import gammaincinv

    return 2 * gammaincinv(degrees / 2, probability)


class GateMemory(NamedTuple):
    """Memory of the gate between epochs; parts are position horizontal and down, velocity horizontal and down."""

    usual: Tensor  # (B, 4) ln s² of each part, ≥ 0
    refused: Tensor  # (B, 2) agreeing refusals in a row, of positions and of velocities
    innovation: Tensor  # (B, 6) of the last refused ones
    age: Tensor  # (B, 2) s since then
    fix: Tensor  # (B, 3) the last position offered
    frozen: Tensor  # (B,) bool: it did not move with the car
    steady: Tensor  # (B, 2) s with hardly a refusal, of positions and of velocities
    lost: Tensor  # (B, 2) s since the last that was not refused
    coasting: Coasting
    limits: Tensor  # (1, 4) of d² of each part over s², the same for all drives


class Verdict(NamedTuple):
    """The coarse gate's verdict on a fix; P becomes ``factor`` · P with ``shift`` added to position and velocity."""

    passed: Tensor  # (B, 6) bool
    shift: Tensor  # (B, 6) variance
    factor: Tensor  # (B,) ≥ 1

    def inflate_covariance(self, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """P inflated where the filter follows refused fixes, unchanged elsewhere."""
        wide = self.factor[:, None, None] * P
        wide[:, PV, PV] += torch.diag_embed(self.shift)
        return wide


class CoarseMemory(NamedTuple):
    """Memory of the coarse gate between epochs."""

    refused: Tensor  # (B,) agreeing refusals in a row
    fix: Tensor  # (B, 6) the last refused one
    moves: Tensor  # (B,) bool: it had a velocity
    age: Tensor  # (B,) s since then
    place: Tensor  # (B, 3) the last position offered
    moved: Tensor  # (B, 3) m, how far the filter has moved while it was the same
    frozen: Tensor  # (B,) bool: further than a fix can be the same
    coasting: Coasting


@runtime_checkable
class FixGate(Protocol):
    """What a filter asks of a gate; its memory may be anything."""

    def begin(self, like: Tensor) -> Any:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        ...

    def screen_fix(
        self, memory: Any, epoch: Epoch, P: Float[Tensor, "B n n"], R: Float[Tensor, "B 6"]
    ) -> tuple[Any, Epoch, Float[Tensor, "B n n"]]:
        """The epoch without what is refused, and P of the update before, inflated where the filter is to follow."""
        ...


@dataclass(frozen=True)
class CoarseGate:
    """Leaves out a fix whose position is ``COARSE_SIGMAS`` · √(P + R + floor²) off, and a velocity likewise.

    P is that of the update before, position's grown by velocity's over the update interval. Refused fixes are compared
    with each other, not with the filter: with ``COARSE_PATIENCE`` in a row whose positions and velocities agree they
    pass, so that a filter that is itself wrong loses one fix; beyond ``COARSE_JUMP`` P is inflated.
    A position that stays the same to the bit while the filter moves by ``FROZEN_M`` and ``FROZEN_SIGMAS`` is left out.
    """

    def begin(self, like: Tensor) -> CoarseMemory:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        B, zeros = len(like), like.new_zeros
        nowhere = torch.full_like(zeros(B, 3), torch.nan)
        nothing = zeros(B) > 0
        return CoarseMemory(
            zeros(B), zeros(B, 6), nothing, zeros(B), nowhere, zeros(B, 3), nothing.clone(), Coasting.begin(like)
        )  # fmt: skip

    def screen_fix(
        self, memory: CoarseMemory, epoch: Epoch, P: Float[Tensor, "B n n"], R: Float[Tensor, "B 6"]
    ) -> tuple[CoarseMemory, Epoch, Float[Tensor, "B n n"]]:
        """The epoch without what is refused, and P, inflated where the gate recovers; it judges by the fix's own 1σ,
        not by the ``R`` that the filter takes it for."""
        with torch.no_grad():
            span, variance = epoch.span_s, P.diagonal(dim1=-2, dim2=-1)
            grown = torch.cat((variance[:, :3] + span * span * variance[:, 3:6], variance[:, 3:6]), -1)
            memory = self._find_frozen(memory, epoch, grown)._replace(coasting=memory.coasting.update(epoch, P))
        stale = memory.frozen.unsqueeze(-1) | memory.coasting.found
        quiet = ~(memory.refused > 0) & ~stale.any(-1)
        if may_branch(epoch.z) and float(epoch.z.detach().abs().max()) <= NEAR and bool(quiet.all()):
            return memory, epoch, P
        offered = epoch.used & ~stale.repeat_interleave(3, -1)
        epoch = epoch._replace(z=epoch.z * offered, fix=epoch.fix._replace(used=offered))
        with torch.no_grad():
            memory, verdict = self._judge(memory, epoch, grown)
        fix = epoch.fix._replace(used=verdict.passed)
        return memory, epoch._replace(z=epoch.z * verdict.passed, fix=fix), verdict.inflate_covariance(P)

    @staticmethod
    def _find_frozen(memory: CoarseMemory, epoch: Epoch, grown: Float[Tensor, "B 6"]) -> CoarseMemory:
        """The memory after the position of a fix was compared with the last one."""
        position, place = epoch.used[:, :3].any(-1), epoch.fix.value[:, :3]
        same = (place == memory.place).all(-1)
        keep = torch.where(position & ~memory.frozen, FROZEN_KEEP, 1.0).unsqueeze(-1)
        moved = keep * memory.moved + (epoch.window.end.p_n - epoch.start.p_n)
        moved = torch.where((position & ~same).unsqueeze(-1), 0.0, moved)
        square = moved.square().sum(-1)
        frozen = same & (square > FROZEN_M**2) & (square > FROZEN_SIGMAS**2 * grown[:, :3].sum(-1))
        return memory._replace(
            place=torch.where(position.unsqueeze(-1), place, memory.place),
            moved=moved,
            frozen=torch.where(position, frozen, memory.frozen),
        )

    def _judge(self, memory: CoarseMemory, epoch: Epoch, grown: Float[Tensor, "B 6"]) -> tuple[CoarseMemory, Verdict]:
        z, used, span = epoch.z, epoch.used, epoch.span_s
        R, age = epoch.fix.std.square(), memory.age + span
        floor = torch.cat([torch.full_like(z[:, :3], x * x) for x in COARSE_FLOOR], -1)
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
            shift=torch.where(jumps.unsqueeze(-1) & passes, z * z, 0.0),
            factor=torch.where(jumps, mean.clamp(1.0, MOST_DOUBT), 1.0),
        )
        return memory._replace(
            refused=torch.where(yields, 0.0, refused),
            fix=torch.where(wrong.unsqueeze(-1), epoch.fix.value, memory.fix),
            moves=torch.where(wrong, moves, memory.moves),
            age=torch.where(wrong, 0.0, age),
        ), verdict

    @staticmethod
    def _agrees(memory: CoarseMemory, fix: Tensor, moves: Tensor, R: Tensor, age: Tensor) -> Tensor:
        """Whether the way from the last refused position is that of the mean of both velocities."""
        known = (moves & memory.moves).unsqueeze(-1)
        way = torch.where(known, 0.5 * (fix[:, 3:] + memory.fix[:, 3:]) * age.unsqueeze(-1), 0.0)
        spread = AGREEMENT_SIGMAS * (2 * R[:, :3]).sum(-1).sqrt() + COARSE_AGREEMENT * age
        spread = spread + torch.where(known.squeeze(-1), 0.0, UNKNOWN_SPEED * age)
        return (fix[:, :3] - memory.fix[:, :3] - way).norm(dim=-1) < spread


@dataclass(frozen=True)
class Gate:
    """Refuses outliers; ``probability`` is that of passing a good part of a fix, ``usual`` ln s² before the first."""

    probability: float
    usual: float = FIRST_USUAL

    def begin(self, like: Tensor) -> GateMemory:
        """Nothing refused yet; ``like`` (B, …) gives batch and precision."""
        B, zeros = len(like), like.new_zeros
        limits = like.new_tensor([[self._limits[k] for k in (2, 1, 2, 1)]])
        nowhere = torch.full_like(zeros(B, 3), torch.nan)
        usual = zeros(B, 4) + self.usual
        nothing = zeros(B) > 0
        return GateMemory(
            usual, zeros(B, 2), zeros(B, 6), zeros(B, 2), nowhere, nothing, zeros(B, 2), zeros(B, 2),
            Coasting.begin(like), limits,
        )  # fmt: skip

    def screen_fix(
        self, memory: GateMemory, epoch: Epoch, P: Float[Tensor, "B n n"], R: Float[Tensor, "B 6"]
    ) -> tuple[GateMemory, Epoch, Float[Tensor, "B n n"]]:
        """The epoch without what is refused, and P, inflated where the filter follows refused fixes.

        ``P`` is that of the update before, ``R`` (B, 6) the variance of the fix.
        """
        with torch.no_grad():
            memory, passed, shift = self._judge(memory, epoch, P, R)
        P = P.clone()
        P[:, PV, PV] += torch.diag_embed(shift)
        return memory, epoch._replace(z=epoch.z * passed, fix=epoch.fix._replace(used=passed)), P

    def _judge(self, memory: GateMemory, epoch: Epoch, P: Tensor, R: Tensor) -> tuple[GateMemory, Tensor, Tensor]:
        """What passes (B, 6), and the variance that P is to have added."""
        z, used, span = epoch.z, epoch.used, epoch.span_s
        position = used[:, :3].any(-1)
        same = (epoch.fix.value[:, :3] == memory.fix).all(-1) & position
        frozen = same & (memory.frozen | (epoch.window.end.v_n.norm(dim=-1) > FROZEN_SPEED))
        coasting = memory.coasting.update(epoch, P)
        S = _predicted_variance(epoch, P) + R + FLOOR * FLOOR
        square = average_by_part(torch.where(used, z.square() / S, 0.0))
        offered = used[:, PARTS] & ~(frozen.unsqueeze(-1) | coasting.found)[:, [0, 0, 1, 1]]
        limit = memory.limits * torch.exp(memory.usual)
        outlier = offered & (square > limit)
        wrong = torch.stack((outlier[:, :2].any(-1), outlier[:, 2:].any(-1)), -1)

        age = memory.age + span
        change = (z - memory.innovation).unflatten(-1, (2, 3))
        drift = z[:, 3:] * used[:, 3:] * age[:, :1]  # as far as the velocity of the fix contradicts the filter's
        apart = torch.minimum(change.norm(dim=-1), torch.stack((change[:, 0] - drift, change[:, 1]), 1).norm(dim=-1))
        spread = AGREEMENT_SIGMAS * (2 * R).unflatten(-1, (2, 3)).sum(-1).sqrt() + age.new_tensor(AGREEMENT_RATES) * age
        agrees = (apart < spread) & (memory.refused > 0)
        refused = torch.where(agrees, memory.refused + 1, torch.ones_like(age))
        seen = torch.stack((offered[:, :2].any(-1), offered[:, 2:].any(-1)), -1)
        refused = torch.where(wrong, refused, torch.where(seen, 0.0, memory.refused))
        follows = wrong & (refused >= PATIENCE)
        # with refused velocities, positions would be off by so much: where they are not, the filter is right
        way = z[:, 3:] * used[:, 3:] * (span * refused[:, 1:])
        far = average_by_part(torch.cat((z[:, :3] - way, way), -1).square() / S)[:, :2]
        fits = offered[:, :2] & ~outlier[:, :2] & (far > limit[:, :2])
        denied = torch.stack((torch.zeros_like(position), (outlier[:, 2:] & fits).any(-1)), -1)
        lost = memory.lost + span
        holds = (memory.steady > STEADY_S) & (lost < HOLD_S - 0.5 * span)
        follows = follows & ~denied & ~holds
        held = wrong & ~denied & holds & (refused >= PATIENCE)
        of_parts, of_components = follows[:, [0, 0, 1, 1]], follows[:, [0, 0, 0, 1, 1, 1]]

        passed = offered & (~outlier | of_parts)
        passed = passed & (passed[:, :1] | ~offered[:, :1]) & ~held[:, 1:]
        passed = passed[:, OF_PART] & used
        good, late = seen & ~wrong, lost >= HOLD_S - 0.5 * span
        agreed = torch.where(memory.refused > 0, span, lost)
        gained = torch.where(good, agreed, torch.where(wrong & ~agrees, -REFUSAL * span, 0.0))
        anew = follows | (good & late) | coasting.found
        steady = torch.where(anew, 0.0, (memory.steady + gained).clamp(0.0, 2 * STEADY_S))
        more = square > square.new_tensor(MEDIANS) * torch.exp(memory.usual)
        usual = (memory.usual + torch.where(more, USUAL_STEP, -USUAL_STEP)).clamp_min(0.0)
        return GateMemory(
            torch.where(offered & ~(denied | held)[:, [0, 0, 1, 1]], usual, memory.usual),
            torch.where(follows, 0.0, refused),
            torch.where(wrong[:, [0, 0, 0, 1, 1, 1]], z, memory.innovation),
            torch.where(wrong, 0.0, age),
            torch.where(position.unsqueeze(-1), epoch.fix.value[:, :3], memory.fix),
            torch.where(position, frozen, memory.frozen),
            steady,
            torch.where(good, 0.0, lost),
            coasting,
            memory.limits,
        ), passed, torch.where(of_components & passed, z * z, 0.0)  # fmt: skip

    @cached_property
    def _limits(self) -> tuple[float, ...]:
        """Of the mean over so many components."""
        return (0.0, *(float(chi2_quantile(self.probability, k)) / k for k in (1, 2)))


def average_by_part(x: Float[Tensor, "B 6"]) -> Float[Tensor, "B 4"]:
    """Means over the components of each part."""
    return torch.stack((0.5 * (x[:, 0] + x[:, 1]), x[:, 2], 0.5 * (x[:, 3] + x[:, 4]), x[:, 5]), -1)


def _predicted_variance(epoch: Epoch, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B 6"]:
    """Variance of position and velocity at the end of the window, of P at its start: to first order, correlations left
    out."""
    span, variance = epoch.span_s, P.diagonal(dim1=-2, dim2=-1)
    acceleration = acceleration_variance(epoch, P)
    velocity = variance[:, VELOCITY] + span**2 * acceleration.unsqueeze(-1)
    position = variance[:, POSITION] + span**2 * variance[:, VELOCITY] + 0.25 * span**4 * acceleration.unsqueeze(-1)
    return torch.cat((position, velocity), -1)
