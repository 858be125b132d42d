"""The tangent frame follows the car: state and memory of a filter, from one frame to another.

Gravity in a tangent frame is exact within some 100 km of its origin. On longer drives the origin is moved, and
everything with axes or an origin in n goes with it: vectors by C_new←old, positions through ECEF, covariances by
blocks. The solution stays what it was, to rounding and the curvature that the linear model of a window leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, singledispatch
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters import constraints, learned, learned_kalman, model_based, plus
from dlkf.filters.gating import GateMemory
from dlkf.navigation.earth import TangentFrame, tangent_frame
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import PVA, NavState


@dataclass(frozen=True)
class FrameChange:
    """From the tangent frames ``old`` to ``new``, one per batch element."""

    old: TangentFrame
    new: TangentFrame

    @cached_property
    def turn(self) -> Float[Tensor, "b 3 3"]:
        """C_new←old, float64."""
        return self.new.C_en.mT @ self.old.C_en

    def vectors(self, u: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Vectors in n, three columns each."""
        return (u.unflatten(-1, (-1, 3)) @ self.turn.to(u.dtype).mT).flatten(1)

    def fixes(self, x: Float[Tensor, "b 6"]) -> Float[Tensor, "b 6"]:
        """Positions and velocities."""
        p = self.new.from_ecef(self.old.to_ecef(x[:, :3])).to(x.dtype)
        return torch.cat((p, self.vectors(x[:, 3:])), -1)

    def state(self, x: NavState) -> NavState:
        """Position, velocity and attitude."""
        pv = self.fixes(torch.cat((x.p_n, x.v_n), -1))
        return NavState(pv[:, :3], pv[:, 3:], self.turn.to(pv.dtype) @ x.C_nb)

    def covariance(self, P: Float[Tensor, "b n n"]) -> Float[Tensor, "b n n"]:
        """Covariance of error states that begin with position, velocity and attitude."""
        turn = torch.eye(P.shape[-1], dtype=P.dtype, device=P.device).repeat(len(P), 1, 1)
        for first in range(PVA.start, PVA.stop, 3):
            turn[:, first : first + 3, first : first + 3] = self.turn
        P = turn @ P @ turn.mT
        return 0.5 * (P + P.mT)

    def variances(self, R: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Variances of vectors whose components are taken as uncorrelated, three columns each."""
        return (R.unflatten(-1, (-1, 3)) @ self.turn.square().to(R.dtype).mT).flatten(1)


def frame_at(state: NavState, frame: TangentFrame) -> TangentFrame:
    """Tangent frames whose origins are the positions of ``state`` in ``frame``."""
    llh = geodetic_from_ecef(frame.to_ecef(state.p_n))
    return tangent_frame(*llh, frame.earth_rate_n.dtype).to(frame.C_en.device)


@singledispatch
def reanchor(memory: Any, change: FrameChange, fresh: Any) -> Any:
    """A filter's memory in the new frame; ``fresh`` is what its ``begin`` gives there.

    TypeError for a memory whose axes are not known here (:func:`can_reanchor`).
    """
    raise TypeError(f"no rule for a memory of type {type(memory).__name__}")


def can_reanchor(memory: Any) -> bool:
    """Whether a memory can go to another frame; a filter that cannot keeps the frame it started in."""
    return reanchor.dispatch(type(memory)) is not reanchor.dispatch(object)


@reanchor.register
def _(memory: None, change: FrameChange, fresh: None) -> None:
    return None


@reanchor.register
def _(
    memory: model_based.KalmanMemory, change: FrameChange, fresh: model_based.KalmanMemory
) -> model_based.KalmanMemory:
    gate, noise = memory.fix.gate, memory.noise
    if isinstance(gate, GateMemory):  # NaN: equal to no other fix, so a frozen receiver shows one fix later
        gate = gate._replace(innovation=change.vectors(gate.innovation), fix=torch.full_like(gate.fix, torch.nan))
    else:
        nowhere = torch.full_like(gate.place, torch.nan)
        gate = gate._replace(fix=change.fixes(gate.fix), place=nowhere, moved=change.vectors(gate.moved))
    if noise is not None:
        noise = noise._replace(Q=change.covariance(noise.Q), R=change.variances(noise.R))
    sources = tuple(
        reanchor(old, change, new) if can_reanchor(old) else old for old, new in zip(memory.sources, fresh.sources)
    )
    windows = replace(fresh.windows, density=memory.windows.density)
    return memory._replace(
        P=change.covariance(memory.P), windows=windows, fix=memory.fix._replace(gate=gate),
        sources=sources, noise=noise,
    )  # fmt: skip


@reanchor.register
def _(memory: constraints.CarMemory, change: FrameChange, fresh: constraints.CarMemory) -> constraints.CarMemory:
    """Without the place of the last fix, whose height is not kept: a span of some seconds begins anew."""
    return memory._replace(liveliness=memory.liveliness._replace(span=fresh.liveliness.span))


@reanchor.register
def _(memory: learned.LearnedMemory, change: FrameChange, fresh: learned.LearnedMemory) -> learned.LearnedMemory:
    """The filter's memory of states and fixes; the network's stays.

    In the heading frame that is the same solution. The features of the frame ``ned`` hold the position from the
    origin, which begins again near zero, as in the segments that the network was trained on.
    """
    return memory._replace(
        origin=fresh.origin,
        posterior=change.state(memory.posterior),
        difference=change.vectors(memory.difference),
        correction=change.vectors(memory.correction),
        fix=torch.where(memory.had_fix, change.fixes(memory.fix), memory.fix),
    )


@reanchor.register
def _(
    memory: learned_kalman.LearnedKalmanMemory, change: FrameChange, fresh: learned_kalman.LearnedKalmanMemory
) -> learned_kalman.LearnedKalmanMemory:
    network = reanchor(memory.network, change, fresh.network)
    return memory._replace(network=network, kalman=reanchor(memory.kalman, change, fresh.kalman))


@reanchor.register
def _(memory: plus.PlusMemory, change: FrameChange, fresh: plus.PlusMemory) -> plus.PlusMemory:
    """The Kalman filter's part, its virtual outage and the last fix; the network's memory has axes of the body."""
    outage = memory.outage
    drift = torch.cat((change.vectors(outage.drift[:, PVA]), outage.drift[:, PVA.stop :]), -1)
    white = torch.stack([change.covariance(Q) for Q in outage.white.unbind(1)], 1)
    outage = outage._replace(drift=drift, P=change.covariance(outage.P), white=white)
    of_fix = memory.errors
    of_fix = of_fix._replace(residual=change.vectors(of_fix.residual), change=change.vectors(of_fix.change))
    noise = memory.fix_noise
    apart = change.vectors(noise.apart.flatten(1)).unflatten(1, (3, 3))
    noise = noise._replace(residual=change.vectors(noise.residual), apart=apart)
    kalman = reanchor(memory.kalman, change, fresh.kalman)
    return memory._replace(kalman=kalman, outage=outage, errors=of_fix, fix_noise=noise)
