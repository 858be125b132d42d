"""Heading of a dual-antenna receiver, with the angle between the antennas and the IMU's forward axis as a state.

With f = C_nb e₁, the heading is ψ = atan2(f_E, f_N), and C = exp([δh×]) Ĉ turns it by

    δψ = δh_D − f_D (f_N δh_N + f_E δh_E) / (f_N² + f_E²)

Its noise may be larger than stated. Successive innovations z show how large, whatever else is wrong for longer: ln w of
the factor w ≥ 1 on its variance R is a running median, which outliers hardly move. It goes up by ``STEP`` / 2 over the
number of measurements where (zₖ − zₖ₋₁)² is above the median 2 · 0.455 w R, else down, to a 1σ of ``MOST_STD`` at most.

The tangent frame's North differs from North at the car by the convergence of the meridians, e tan φ / R, with e the
way East. Both are written with the Earth's axis in n, (cos φ, 0, −sin φ) or the same turned about down: a measured
heading is the angle from the first axis of n.
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
FIRST, MEMORY = 10.0, 300.0  # measurements that the stated 1σ counts for, and over which w forgets
STEP, MEDIAN = 20.0, 0.4549  # of ln w, over the number of measurements; of χ² of one component
MOST_STD = math.radians(4.0)  # which noise may reach; an error beyond is one of mounting


class HeadingMemory(NamedTuple):
    """Memory of the receiver."""

    factor: Tensor  # (1,) on its 1σ, the same for all drives
    trust: Trust
    variance: Tensor  # (B,) w, factor on the variance of its noise
    counted: Tensor  # (B,) measurements that it is of
    last: Tensor  # (B,) z, NaN where the last update interval had none


class DualAntennaHeading(SensorSource):
    """One row: the heading at the last sample of the update interval."""

    table: ClassVar[AidTable] = STANDARD["heading"]
    parameters: ClassVar[Mapping[str, Parameter]] = {"heading_offset": Parameter(std=0.03, walk=1e-6)}

    def begin(self, batch: Batch) -> HeadingMemory:
        """Memory before the first measurement."""
        B, one = batch.size[0], batch.imu.new_ones(batch.size[0])
        factor = batch.imu.new_tensor([self.tuning.heading_std])
        return HeadingMemory(factor, Trust.begin(batch.imu, B), one, FIRST * one, torch.nan * one)

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
        stated = (memory.factor * torch.where(std > 0, std.clamp_min(LEAST_STD), DEFAULT_STD)).square()
        R = stated * memory.variance
        unsure = predicted_variance(prediction.P, H)[:, 0]
        trust, used, excess = judge(memory.trust, seen, z, unsure + R, unsure < KNOWS**2, level > 0.5)
        change = z - memory.last
        change = torch.atan2(torch.sin(change), torch.cos(change))
        counts = seen & (level > 0.5) & ~memory.last.isnan()
        counted = (memory.counted + 1).clamp_max(MEMORY)
        step = torch.where(change.square() > 2 * MEDIAN * R, 0.5 * STEP, -0.5 * STEP)
        variance = torch.minimum(memory.variance * torch.exp(step / counted), MOST_STD**2 / stated).clamp_min(1.0)
        memory = HeadingMemory(
            memory.factor, trust, torch.where(counts, variance, memory.variance),
            torch.where(counts, counted, memory.counted), torch.where(seen, z, torch.nan),
        )  # fmt: skip
        return Measurement(z.unsqueeze(-1), H, (R * excess).unsqueeze(-1), used.unsqueeze(-1)), memory
