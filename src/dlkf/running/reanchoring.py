"""The tangent frame follows the car: state and memory of a filter, from one frame to another.

Gravity in a tangent frame is exact within some 100 km of its origin. On longer drives the origin is moved, and
everything with axes or an origin in n goes with it: vectors by C_new←old, positions through ECEF, covariances by
blocks. The solution stays what it was, to rounding and the curvature that the linear model of a window leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.adaptive import AdaptiveNoise
from dlkf.filters.coasting import Coasting
from dlkf.filters.fix_noise import FixNoise
from dlkf.filters.gating import CoarseMemory, GateMemory
from dlkf.filters.learned import LearnedMemory
from dlkf.filters.learned_kalman import LearnedKalmanMemory
from dlkf.filters.model_based import InsMemory, KalmanMemory
from dlkf.filters.plus import PlusMemory
from dlkf.filters.position_errors import PositionErrors
from dlkf.filters.stationarity import PositionSpan
from dlkf.filters.virtual_outages import VirtualOutage
from dlkf.navigation.earth import TangentFrame, tangent_frame
from dlkf.navigation.error_model import WindowModel
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import PVA, NavState
from dlkf.running.memory_rules import ANEW, Rules, begin_anew, change_memory


@dataclass(frozen=True)
class FrameChange:
    """From the tangent frames ``old`` to ``new``, one per batch element."""

    old: TangentFrame
    new: TangentFrame

    @cached_property
    def turn(self) -> Float[Tensor, "b 3 3"]:
        """C_new←old, float64."""
        return self.new.C_en.mT @ self.old.C_en

    def vectors(self, u: Float[Tensor, "*b n"]) -> Float[Tensor, "*b n"]:
        """Vectors in n, three columns each."""
        return (u.reshape(len(u), -1, 3) @ self.turn.to(u.dtype).mT).reshape(u.shape)

    def errors(self, dx: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Error states that begin with position, velocity and attitude."""
        return torch.cat((self.vectors(dx[:, PVA]), dx[:, PVA.stop :]), -1)

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

    def covariances(self, P: Float[Tensor, "b k n n"]) -> Float[Tensor, "b k n n"]:
        """Likewise."""
        return torch.stack([self.covariance(each) for each in P.unbind(1)], 1)

    def forget(self, x: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """A position that is to equal no other: a frozen receiver shows one fix later."""
        return torch.full_like(x, torch.nan)

    def variances(self, R: Float[Tensor, "b n"]) -> Float[Tensor, "b n"]:
        """Variances of vectors whose components are taken as uncorrelated, three columns each."""
        return (R.unflatten(-1, (-1, 3)) @ self.turn.square().to(R.dtype).mT).flatten(1)


def frame_at(state: NavState, frame: TangentFrame) -> TangentFrame:
    """Tangent frames whose origins are the positions of ``state`` in ``frame``."""
    llh = geodetic_from_ecef(frame.to_ecef(state.p_n))
    return tangent_frame(*llh, frame.earth_rate_n.dtype).to(frame.C_en.device)


RULES: Rules = {
    InsMemory: {},
    KalmanMemory: {"P": FrameChange.covariance},
    WindowModel: lambda change, old, fresh: replace(fresh, density=old.density),
    AdaptiveNoise: {"Q": FrameChange.covariance, "R": FrameChange.variances},
    Coasting: {"velocity": FrameChange.forget},
    GateMemory: {"innovation": FrameChange.vectors, "fix": FrameChange.forget},
    CoarseMemory: {"fix": FrameChange.fixes, "place": FrameChange.forget, "moved": FrameChange.vectors},
    PositionSpan: begin_anew,  # the height of its place is not kept
    LearnedMemory: {
        "origin": ANEW,  # features of the frame ``ned`` hold the position from there: near zero again, as in training
        "posterior": FrameChange.state, "difference": FrameChange.vectors, "correction": FrameChange.vectors,
        "fix": FrameChange.fixes,
    },
    LearnedKalmanMemory: {},
    PlusMemory: {},
    VirtualOutage: {"drift": FrameChange.errors, "P": FrameChange.covariance, "white": FrameChange.covariances},
    PositionErrors: {"residual": FrameChange.vectors, "change": FrameChange.vectors},
    FixNoise: {"residual": FrameChange.vectors, "apart": FrameChange.vectors},
}  # fmt: skip


def reanchor(memory: Any, change: FrameChange, fresh: Any) -> Any:
    """A filter's memory in the new frame; ``fresh`` is what its ``begin`` gives there.

    TypeError for a memory whose axes are not known here (:func:`can_reanchor`).
    """
    return change_memory(RULES, change, memory, fresh)


def can_reanchor(memory: Any) -> bool:
    """Whether a memory can go to another frame; a filter that cannot keeps the frame it started in."""
    return memory is None or type(memory) in RULES
