"""Fixes of GNSS as a source of a Kalman filter, with lever arm, age, and a gate of outliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters import slow_errors
from dlkf.filters.adaptive import AdaptiveNoise
from dlkf.filters.gating import CoarseMemory, FixGate, GateMemory
from dlkf.filters.integration import Epoch
from dlkf.filters.receiver import add_columns, has_receiver
from dlkf.filters.sources import Measurement
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import skew
from dlkf.navigation.error_model import mask_rows, measurement_matrix
from dlkf.navigation.state import ATTITUDE, GYRO, VELOCITY, ErrorStates


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
        factors = None if epoch.noise is None else epoch.noise.fix_std
        return R if factors is None else R * factors.square()

    def matrix(self, epoch: Epoch) -> Float[Tensor, "B 6 n"]:
        """H of all components, used or not."""
        H = measurement_matrix(epoch.at_fix, epoch.rate_at_fix_b, epoch.lever_arm_b, epoch.frame, self.states.count)
        if epoch.fix.lag is not None:
            H = _look_back(H, epoch, epoch.fix.lag)
        if has_receiver(self.states):
            H = add_columns(H, epoch, self.states)
        return slow_errors.add_columns(H, self.states) if slow_errors.has_slow_errors(self.states) else H


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
