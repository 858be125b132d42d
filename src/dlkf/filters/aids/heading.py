"""Heading of a dual-antenna receiver, with the angle between the antennas and the IMU's forward axis as a state.

With f = C_nb e₁, the heading is ψ = atan2(f_E, f_N), and C = exp([δh×]) Ĉ turns it by

    δψ = δh_D − f_D (f_N δh_N + f_E δh_E) / (f_N² + f_E²)

The tangent frame's North differs from North at the car by the convergence of the meridians, e tan φ / R, with e the
way East. Both are written with the Earth's axis in n, (cos φ, 0, −sin φ) or the same turned about down
(:func:`dlkf.data.augmentation.turn_frames`): a measured heading is the angle from the first axis of n.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from dlkf.data.aid_tables import STANDARD, AidTable
from dlkf.data.drive import Batch
from dlkf.filters.aids.stretch import stack_limits, stretch_weights, weighted_mean
from dlkf.filters.aids.trust import Trust, judge
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Measurement, Parameter, Predicted, SensorSource, aid_of, predicted_variance

DEFAULT_STD, LEAST_STD = math.radians(0.5), math.radians(0.1)
KNOWS = math.radians(5.0)  # 1σ: a filter whose heading is better than this can detect a wrong one


class HeadingMemory(NamedTuple):
    """Memory of the receiver."""

    factor: Tensor  # (1,) on its 1σ, the same for all drives
    trust: Trust


class DualAntennaHeading(SensorSource):
    """One row: the heading at the last sample of the update interval."""

    table: ClassVar[AidTable] = STANDARD["heading"]
    parameters: ClassVar[Mapping[str, Parameter]] = {"heading_offset": Parameter(std=0.03, walk=1e-6)}

    def begin(self, batch: Batch) -> HeadingMemory:
        """Memory before the first measurement."""
        return HeadingMemory(batch.imu.new_tensor([self.tuning.heading_std]), Trust.begin(batch.imu, batch.size[0]))

    def rows(
        self, epoch: Epoch, memory: HeadingMemory, prediction: Predicted
    ) -> tuple[Measurement | None, HeadingMemory]:
        """The row, and what the receiver has earned by it."""
        said = aid_of(epoch, self.table.name)
        if said is None:
            return None, memory
        value, std, lag, span, count = said.unbind(-1)
        seen, samples = count > 0, epoch.corrected.shape[1]
        weights = stretch_weights(lag.clamp_max(samples * epoch.dt), torch.zeros_like(span), samples, epoch.dt)
        forward = stack_limits(epoch.start.C_nb[..., 0], epoch.window.C_nb[..., 0])
        north, east, down = weighted_mean(weights, forward).unbind(-1)
        axis, p_n, level = epoch.frame.axis_n, epoch.window.end.p_n, north.square() + east.square()
        eastward = axis[:, 0] * p_n[:, 1] - axis[:, 1] * p_n[:, 0]  # · cos φ
        convergence = -eastward * axis[:, 2] / (axis[:, :2].square().sum(-1) * epoch.frame.radius)
        expected = torch.atan2(east, north) + convergence + prediction.parameters["heading_offset"]
        turn = value - expected
        z = torch.atan2(torch.sin(turn), torch.cos(turn))
        H = north.new_zeros(len(north), 1, self.states.count)
        tilt = -down / level.clamp_min(1e-3)
        H[:, 0, self.states.attitude] = torch.stack((tilt * north, tilt * east, torch.ones_like(tilt)), -1)
        H[:, 0, self.states.of("heading_offset")] = 1.0
        R = (memory.factor * torch.where(std > 0, std.clamp_min(LEAST_STD), DEFAULT_STD)).square()
        unsure = predicted_variance(prediction.P, H)[:, 0]
        trust, used, excess = judge(memory.trust, seen, z, unsure + R, unsure < KNOWS**2, level > 0.5)
        rows = Measurement(z.unsqueeze(-1), H, (R * excess).unsqueeze(-1), used.unsqueeze(-1))
        return rows, memory._replace(trust=trust)
