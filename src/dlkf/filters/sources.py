"""Where a Kalman filter's measurements come from: every source gives rows of one common update per epoch.

A source is a class with two methods, in a file of its own; it needs no change of the package::

    @dataclass(frozen=True)
    class SpeedLimit:                                    # in speed_limit.py, somewhere on PYTHONPATH
        imu: ImuSpec
        tuning: Tuning
        states: ErrorStates

        def begin(self, batch: Batch) -> None:
            return None                                  # nothing to remember

        def rows(self, epoch: Epoch, memory: None, believed: Believed) -> tuple[Measurement | None, None]:
            v = epoch.window.end.v_n
            speed = v[:, :2].norm(dim=-1, keepdim=True)
            H = v.new_zeros(len(v), 1, self.states.count)
            H[:, 0, 3:5] = v[:, :2] / speed.clamp_min(1.0)
            return Measurement(36.0 - speed, H, torch.full_like(speed, 1.0), speed > 36.0), None

and every command takes it behind a filter's name: ``model=mbkf21_nhc+speed_limit:SpeedLimit``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.adaptive import AdaptiveNoise
from dlkf.filters.gating import Gate, GateMemory
from dlkf.filters.integration import Epoch
from dlkf.filters.tuning import Tuning
from dlkf.navigation.error_model import masked, measurement_matrix


class Measurement(NamedTuple):
    """Rows of a Kalman update: innovation z = h − h(x̂), its H (error = truth − estimate), variance, which count."""

    z: Tensor  # (B, m)
    H: Tensor  # (B, m, n)
    R: Tensor  # (B, m)
    used: Tensor  # (B, m) bool


class Believed(NamedTuple):
    """What the filter believes at the end of a window, before it updates."""

    P: Tensor  # (B, n, n)
    structure: Tensor | None = None  # (B, 5) of the car, where it has such states
    noise: AdaptiveNoise | None = None


@runtime_checkable
class Source(Protocol):
    """A source of measurements; its memory may be anything."""

    def begin(self, batch: Batch) -> Any:
        """Memory at the start of a batch."""
        ...

    def rows(self, epoch: Epoch, memory: Any, believed: Believed, /) -> tuple[Measurement | None, Any]:
        """Rows of this epoch's update, None for none in any piece, and the memory after it."""
        ...


class FixMemory(NamedTuple):
    """What belongs to the receiver."""

    scale: Tensor  # (1, 2, 6) factor and floor of the fixes' stds, the same for all drives
    gate: GateMemory | None = None


class FixRows(NamedTuple):
    """The six rows of GNSS and what its gate made of them and of the filter's covariance."""

    rows: Measurement
    variance: Tensor  # (B, 6) of all components, used or not
    offered: tuple[Tensor, Tensor]  # H and R before the gate
    P: Tensor  # (B, n, n), opened where the filter gives in
    accepted: Tensor | None  # (B,) bool; None: without a gate


@dataclass(frozen=True)
class GnssFix:
    """Position and velocity of GNSS, with lever arm and lag; a ``gate`` may refuse them."""

    tuning: Tuning
    states: int
    gated: bool = False

    @cached_property
    def gate(self) -> Gate:
        """Built once: its limits are quantiles that take longer than an epoch."""
        return Gate(self.tuning.gate)

    def begin(self, batch: Batch) -> FixMemory:
        """Factors on the stds; nothing refused yet."""
        t = self.tuning
        scale = [[t.position_std] * 3 + [t.velocity_std] * 3, [t.position_floor] * 3 + [t.velocity_floor] * 3]
        gate = self.gate.begin(batch.imu) if self.gated else None
        return FixMemory(torch.tensor([scale], dtype=batch.imu.dtype, device=batch.imu.device), gate)

    def rows(self, epoch: Epoch, memory: FixMemory, believed: Believed) -> tuple[FixRows, FixMemory]:
        """Six rows, of which those count that the receiver offers and the gate lets pass."""
        P, R = believed.P, self._variance(epoch, memory, believed)
        fix = Measurement(epoch.z, self._matrix(epoch), R, epoch.used)
        H, R = offered = masked(fix.H, fix.R, fix.used)
        if memory.gate is None:
            return FixRows(Measurement(fix.z * fix.used, H, R, fix.used), fix.R, offered, P, None), memory
        S = H @ P @ H.mT + torch.diag_embed(R)
        gate, verdict = self.gate.judge(memory.gate, epoch, S, fix.R)
        H, R = masked(fix.H, fix.R, verdict.passed)
        rows = Measurement(fix.z * verdict.passed, H, R, verdict.passed)
        return FixRows(rows, fix.R, offered, verdict.opened(P), verdict.used), memory._replace(gate=gate)

    def _matrix(self, epoch: Epoch) -> Float[Tensor, "B 6 n"]:
        H = measurement_matrix(epoch.at_fix, epoch.rate_at_fix_b, epoch.lever_arm_b, epoch.frame, self.states)
        if epoch.fix.lag is not None:  # δp at the fix = δp at the window's end − lag · δv
            H = H.clone()
            H[:, 0, 3] = H[:, 1, 4] = H[:, 2, 5] = -epoch.fix.lag
        return H

    def _variance(self, epoch: Epoch, memory: FixMemory, believed: Believed) -> Float[Tensor, "B 6"]:
        scale, floor = memory.scale[0]
        R = torch.maximum(scale * epoch.fix.std, floor).square()
        if believed.noise is not None:
            R = torch.where(believed.noise.settled.unsqueeze(-1), believed.noise.R, R)
        factors = None if epoch.advice is None else epoch.advice.fix_std
        return R if factors is None else R * factors.square()
