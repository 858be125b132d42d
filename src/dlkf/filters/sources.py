"""Measurement sources of a Kalman filter: each gives rows of one common update per epoch.

A source is a class with two methods, in a file of its own; it needs no change of the package::

    @dataclass(frozen=True)
    class SpeedLimit:                                    # in speed_limit.py, somewhere on PYTHONPATH
        imu: ImuSpec
        tuning: Tuning
        states: ErrorStates

        def begin(self, batch: Batch) -> None:
            return None                                  # no memory

        def rows(self, epoch: Epoch, memory: None, prediction: Predicted) -> tuple[Measurement | None, None]:
            v = epoch.window.end.v_n
            speed = v.norm(dim=-1, keepdim=True)
            H = v.new_zeros(len(v), 1, self.states.count)
            H[:, 0, self.states.velocity] = v / speed.clamp_min(1.0)
            return Measurement(36.0 - speed, H, torch.full_like(speed, 1.0), speed > 36.0), None

and every command takes it behind a filter's name: ``model=mbkf21_nhc+speed_limit:SpeedLimit``. One that belongs to a
sensor names its table of the dataset (``table``) and the error states that it adds (``parameters``), as wheel speed,
heading and barometer do (:mod:`dlkf.filters.aids`); ``docs/developing.md`` has an example. One without a table may name
``columns`` of the output and give them by ``describe(epoch, memory, rows, P)``, as speed from vibration does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.adaptive import AdaptiveNoise
from dlkf.filters.gating import CoarseMemory, FixGate, GateMemory
from dlkf.filters.integration import Epoch
from dlkf.filters.receiver import add_columns, has_receiver
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import skew
from dlkf.navigation.error_model import mask_rows, measurement_matrix
from dlkf.navigation.state import ATTITUDE, GYRO, VELOCITY, ErrorStates


class Measurement(NamedTuple):
    """Rows of a Kalman update: innovation z = h − h(x̂), its H (error = truth − estimate), variance, which count."""

    z: Tensor  # (B, m)
    H: Tensor  # (B, m, n)
    R: Tensor  # (B, m)
    used: Tensor  # (B, m) bool


class Parameter(NamedTuple):
    """A quantity that a source estimates as an error state of its own: its value and 1σ at the start, the 1σ of its
    random walk per √s, and the largest value that an estimate may have."""

    std: float
    walk: float = 0.0
    start: float = 0.0
    largest: float = math.inf


class Predicted(NamedTuple):
    """The filter's estimates at the end of a window, before it updates."""

    P: Tensor  # (B, n, n)
    structure: Tensor | None = None  # (B, 5) of the car, where it has such states
    noise: AdaptiveNoise | None = None
    parameters: Mapping[str, Tensor] = {}  # (B,) each, of the sources by name
    rolling: Tensor | None = None  # (B,) bool: a wheel that agrees with the filter turns; None: no wheel
    stopped: Tensor | None = None  # (B,) bool: it agrees and does not turn


def predicted_variance(P: Float[Tensor, "B n n"], H: Float[Tensor, "B m n"]) -> Float[Tensor, "B m"]:
    """Variance of a source's prediction, the diagonal of H P Hᵀ."""
    return ((H @ P) * H).sum(-1)


def aid_of(epoch: Epoch, name: str) -> Float[Tensor, "B 5"] | None:
    """The row of a further sensor in the epoch (:data:`dlkf.data.aids.ROW`), None where no drive has it."""
    return None if epoch.fix.aids is None else epoch.fix.aids.get(name)


@runtime_checkable
class Source(Protocol):
    """A source of measurements; its memory may be anything."""

    def begin(self, batch: Batch) -> Any:
        """Memory at the start of a batch."""
        ...

    def rows(self, epoch: Epoch, memory: Any, prediction: Predicted, /) -> tuple[Measurement | None, Any]:
        """Rows of this epoch's update, None for none in any segment, and the memory after it."""
        ...


@dataclass(frozen=True)
class SensorSource:
    """A source made with an IMU, factors and states. By itself it brings states alone: no memory and no rows."""

    imu: object
    tuning: Tuning
    states: ErrorStates

    @property
    def code(self) -> SensorSource:
        """Without the numbers that the memory carries."""
        return type(self)(None, Tuning(), self.states)

    def begin(self, batch: Batch) -> Any:
        """Memory before the first measurement."""
        return None

    def rows(self, epoch: Epoch, memory: Any, prediction: Predicted) -> tuple[Measurement | None, Any]:
        """No rows."""
        return None, memory


def describe_aid(epoch: Epoch, name: str, rows: Measurement | None, P: Float[Tensor, "B n n"]) -> Float[Tensor, "B 3"]:
    """Of a further sensor's first row: innovation, its 1σ (NaN where there was no sample), whether it counted."""
    seen = aid_of(epoch, name)
    return describe_row(epoch, rows, P, None if seen is None else seen[:, 4] > 0)


def describe_row(
    epoch: Epoch, rows: Measurement | None, P: Float[Tensor, "B n n"], seen: Bool[Tensor, " B"] | None
) -> Float[Tensor, "B 3"]:
    """Of the first row: innovation, its 1σ (NaN where it was not ``seen``), whether it counted."""
    if rows is None or seen is None:
        return epoch.z.new_tensor([[torch.nan, torch.nan, 0.0]]).expand(len(epoch.z), -1)
    std = (predicted_variance(P, rows.H[:, :1]) + rows.R[:, :1]).sqrt()
    said = torch.where(seen.unsqueeze(-1), torch.cat((rows.z[:, :1], std), -1), torch.nan)
    return torch.cat((said, rows.used[:, :1].to(said.dtype)), -1)


def _look_back(H: Float[Tensor, "B 6 n"], epoch: Epoch, lag: Float[Tensor, " B"]) -> Float[Tensor, "B 6 n"]:
    """H of a fix ``lag`` seconds λ before the window's end, with s the velocity gained since from specific force:

    δh(t − λ) = δh + λ C ζ
    δv(t − λ) = δv + [s×] δh + λ C ε + λ/2 [s×] C ζ
    δp(t − λ) = δp − λ δv − λ/2 ([s×] δh + λ C ε + λ/3 [s×] C ζ).
    """
    H, lag = H.clone(), lag[:, None, None]
    end = epoch.window.end
    gained = end.v_n - epoch.at_fix.v_n - lag[:, 0] * epoch.window.gravity
    H[..., GYRO] += lag * (H[..., ATTITUDE].clone() @ end.C_nb)
    tilt = skew(gained)
    turned = 0.5 * lag * (tilt @ end.C_nb)
    columns = torch.cat((tilt, lag * end.C_nb, turned), -1)
    H[:, 3:6, ATTITUDE.start : GYRO.stop] += columns
    columns = torch.cat((columns[..., :6], (2 / 3) * turned), -1)
    H[:, :3, ATTITUDE.start : GYRO.stop] -= 0.5 * lag * columns
    H[:, :3, VELOCITY] = -lag * torch.eye(3, dtype=H.dtype, device=H.device)
    return H


class FixMemory(NamedTuple):
    """What belongs to the receiver."""

    scale: Tensor  # (1, 2, 6) factor and floor of the fixes' stds, the same for all drives
    gate: CoarseMemory | GateMemory


@dataclass(frozen=True)
class GnssFix:
    """Position and velocity of GNSS, with lever arm and lag; a gate refuses outliers first."""

    tuning: Tuning
    states: ErrorStates
    gate: FixGate

    def begin(self, batch: Batch) -> FixMemory:
        """Factors on the stds; nothing refused yet."""
        t = self.tuning
        scale = [[t.position_std] * 3 + [t.velocity_std] * 3, [t.position_floor] * 3 + [t.velocity_floor] * 3]
        like = {"dtype": batch.imu.dtype, "device": batch.imu.device}
        return FixMemory(torch.tensor([scale], **like), self.gate.begin(batch.imu))

    def screen_fix(
        self, memory: FixMemory, epoch: Epoch, P: Float[Tensor, "B n n"], noise: AdaptiveNoise | None
    ) -> tuple[FixMemory, Epoch, Float[Tensor, "B n n"]]:
        """The epoch without what the gate refuses, and P of the update before, inflated where it follows such fixes."""
        gate, epoch, P = self.gate.screen_fix(memory.gate, epoch, P, self.variance(epoch, memory, noise))
        return memory if gate is memory.gate else memory._replace(gate=gate), epoch, P

    def rows(self, epoch: Epoch, memory: FixMemory, noise: AdaptiveNoise | None) -> Measurement:
        """Six rows, of which those count that the receiver offers."""
        H, R = mask_rows(self.matrix(epoch), self.variance(epoch, memory, noise), epoch.used)
        return Measurement(epoch.z * epoch.used, H, R, epoch.used)

    def variance(self, epoch: Epoch, memory: FixMemory, noise: AdaptiveNoise | None) -> Float[Tensor, "B 6"]:
        """Of all components, used or not."""
        scale, floor = memory.scale[0]
        R = torch.maximum(scale * epoch.fix.std, floor).square()
        if noise is not None:
            R = torch.where(noise.settled.unsqueeze(-1), noise.R, R)
        factors = None if epoch.advice is None else epoch.advice.fix_std
        return R if factors is None else R * factors.square()

    def matrix(self, epoch: Epoch) -> Float[Tensor, "B 6 n"]:
        """H of all components, used or not."""
        H = measurement_matrix(epoch.at_fix, epoch.rate_at_fix_b, epoch.lever_arm_b, epoch.frame, self.states.count)
        if epoch.fix.lag is not None:
            H = _look_back(H, epoch, epoch.fix.lag)
        return add_columns(H, epoch, self.states) if has_receiver(self.states) else H
