"""Over a gap of the IMU: state and memory of a filter, from an update interval before it to the end of one after it.

The strapdown goes on with samples that fill the gap (:func:`fill_gap`): forward and lateral acceleration and yaw rate
on the line between the samples before and after it, vertical acceleration, roll and pitch rate as in the last seconds,
since a car keeps its tilt. What the car did otherwise is added to the covariance. Per axis, in a gap of T seconds
(residuals of gaps cut into drives of ``kitti``, ``rtkx``, ``wid``, ``wid_mru`` and ``linkoping``):

    velocity 0.2 T^1.5 m/s, vertical 0.1 T^0.5 m/s     roll, pitch 0.6 T^0.5 °     yaw 1.0 T² °

There is no measurement at the end of such a stretch. What a memory holds of successive update intervals begins anew;
IMU errors, mounting angles, levels of noise and of vibration stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.learned import LearnedMemory
from dlkf.filters.learned_kalman import LearnedKalmanMemory
from dlkf.filters.model_based import InsMemory, KalmanMemory
from dlkf.filters.plus import PlusMemory
from dlkf.filters.stationarity import LastSecond, PositionSpan, Rest
from dlkf.filters.vibration_speed import VibrationMemory
from dlkf.filters.virtual_outages import VirtualOutage
from dlkf.navigation.attitude import skew
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import ATTITUDE, POSITION, STATES, VELOCITY, NavState
from dlkf.running.memory_rules import ANEW, Rules, begin_anew, change_memory

LONGEST_BRIDGE_S = 3.0  # s, gaps of the IMU
LINE = (True, True, False, False, False, True)  # columns of a sample that go on the line across a gap
LEVEL_STD, VERTICAL_STD = 0.2, 0.1  # m/s after a second, growing as T^1.5 and T^0.5
TILT_STD, YAW_STD = math.radians(0.6), math.radians(1.0)  # rad after a second, growing as T^0.5 and T²
OF_POSITION, CORRELATION = 0.5, 0.8  # 1σ of position over T times that of velocity, and how the two go together
# noise of the samples themselves, rough: m/s and rad after a second, growing as T^0.5
SAMPLES_VELOCITY_STD, SAMPLES_ATTITUDE_STD = 0.03, math.radians(0.1)


@dataclass(frozen=True)
class Stretch:
    """Some update intervals without a measurement: the states at both ends, and how long it takes in seconds before,
    in and after the gap."""

    start: NavState
    end: NavState
    seconds: Tensor  # (B, 3)
    frame: TangentFrame

    @cached_property
    def force(self) -> Float[Tensor, "B 3"]:
        """Mean specific force in n [m/s²]."""
        span = self.seconds.sum(-1, keepdim=True)
        return (self.end.v_n - self.start.v_n) / span - self.frame.gravity(self.start.p_n)

    def transition(self, seconds: Float[Tensor, " B"], like: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """Φ of so many seconds of constant specific force: δp' = δv, δv' = −[f×] δh."""
        Phi = torch.zeros_like(like)
        Phi.diagonal(dim1=-2, dim2=-1).fill_(1.0)
        t = seconds.to(like.dtype)[:, None, None]
        gained = -skew(self.force).to(like.dtype) * t
        Phi[:, POSITION, VELOCITY] = t * torch.eye(3, dtype=like.dtype, device=like.device)
        Phi[:, VELOCITY, ATTITUDE] = gained
        Phi[:, POSITION, ATTITUDE] = 0.5 * t * gained
        return Phi

    def noise(self, like: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """Covariance of what the car did in the gap beyond what fills it."""
        T, span = self.seconds[:, 1:2].to(like.dtype), self.seconds.sum(-1, keepdim=True).to(like.dtype)
        level, down = (LEVEL_STD**2 * T**3), (VERTICAL_STD**2 * T)
        velocity = torch.cat((level, level, down), -1)
        tilt, yaw = TILT_STD**2 * T, YAW_STD**2 * T**4
        Q, arm = torch.zeros_like(like), OF_POSITION * T
        diagonal = Q.diagonal(dim1=-2, dim2=-1)
        diagonal[:, POSITION] = velocity * arm**2
        diagonal[:, VELOCITY] = velocity + SAMPLES_VELOCITY_STD**2 * span
        diagonal[:, ATTITUDE] = torch.cat((tilt, tilt, yaw), -1) + SAMPLES_ATTITUDE_STD**2 * span
        across = torch.diag_embed(CORRELATION * velocity * arm)
        Q[:, POSITION, VELOCITY] = across
        Q[:, VELOCITY, POSITION] = across
        return Q

    def covariance(self, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
        """P of error states that begin with position, velocity and attitude, at the end of the stretch."""
        before, gap, after = self.seconds.unbind(-1)
        Phi = self.transition(before + gap, P)
        P = Phi @ P @ Phi.mT + self.noise(P)
        Phi = self.transition(after, P)
        P = Phi @ P @ Phi.mT
        return 0.5 * (P + P.mT)

    def state(self, before: NavState) -> NavState:
        """The state at its end."""
        return self.end

    def time(self, before: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
        """A time [s] at its end."""
        return before + self.seconds.sum(-1).to(before.dtype)


def fill_gap(before: np.ndarray, after: np.ndarray, usual: np.ndarray, count: int) -> np.ndarray:
    """``count`` samples (count, 6) between the last samples ``before`` a gap (k, 6) and the first ``after`` it.

    ``usual`` (6,) is the mean of the last seconds. Columns of ``LINE`` are linear between the two means.
    """
    share = (np.arange(count) + 1.0)[:, None] / (count + 1)
    line = before.mean(0) + share * (after.mean(0) - before.mean(0))
    return np.where(LINE, line, usual)


def _bridge_plus(stretch: Stretch, memory: PlusMemory, fresh: PlusMemory) -> PlusMemory:
    """With a new virtual outage, and without the residuals of the last fixes; what is known of noise stays."""
    kalman = bridge(memory.kalman, stretch, fresh.kalman)
    return memory._replace(
        kalman=kalman, elapsed=stretch.time(memory.elapsed), since_fix=stretch.time(memory.since_fix),
        outage=VirtualOutage.begin(kalman.P)._replace(evidence=memory.outage.evidence),
        errors=memory.errors._replace(residual=fresh.errors.residual, successive=fresh.errors.successive),
        fix_noise=memory.fix_noise._replace(successive=fresh.fix_noise.successive),
    )  # fmt: skip


RULES: Rules = {
    InsMemory: {"since_fix_s": Stretch.time},
    KalmanMemory: {"P": Stretch.covariance},
    PositionSpan: begin_anew,
    LastSecond: begin_anew,
    Rest: begin_anew,
    VibrationMemory: {"block": ANEW, "last_sample": ANEW, "age": Stretch.time},
    LearnedMemory: {"posterior": Stretch.state, "elapsed": Stretch.time, "since_fix": Stretch.time},
    LearnedKalmanMemory: {},
    PlusMemory: _bridge_plus,
}


def bridge(memory: Any, stretch: Stretch, fresh: Any) -> Any:
    """A filter's memory at the end of a stretch; ``fresh`` is what its ``begin`` gives there.

    TypeError for a memory of which it is not known here what a gap changes (:func:`can_bridge`).
    """
    return change_memory(RULES, stretch, memory, fresh)


def can_bridge(memory: Any) -> bool:
    """Whether a filter goes on after a gap of the IMU; one that cannot starts over."""
    return memory is None or type(memory) in RULES


def bridge_std(std: Float[Tensor, "B 15"], before: Any, after: Any) -> Float[Tensor, "B 15"]:
    """1σ of the states at the end of a stretch, from that at its start and the memories at both."""
    P, Q = find_covariance(before), find_covariance(after)
    if P is None or Q is None:
        return std
    added = (Q - P).diagonal(dim1=-2, dim2=-1)[:, :STATES]
    return (std.square() + added).clamp_min(0).sqrt()


def find_covariance(memory: Any) -> Float[Tensor, "B n n"] | None:
    """Of the error states of a Kalman filter, or one with a network round it; None without."""
    return getattr(getattr(memory, "kalman", memory), "P", None)
