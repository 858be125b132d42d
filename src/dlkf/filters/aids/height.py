"""Height by a barometer: its offset b from the ellipsoid drifts with the weather, and air that flows past the car
lowers the pressure within by a share c of the dynamic pressure. Both are states.

m = h + b + c v² / 2g,  h = h₀ − p_D + (p_N² + p_E²) / 2R         height above the ellipsoid in the tangent frame
"""

from __future__ import annotations

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
from dlkf.navigation.earth import NOMINAL_GRAVITY

LEAST_STD = 0.1  # m
KNOWS = 5.0  # m 1σ of the height above which an offset cannot be separated from a faulty barometer


class BarometerMemory(NamedTuple):
    """Memory of the barometer."""

    std: Tensor  # (1,) m, the same for all drives
    trust: Trust


class Barometer(SensorSource):
    """One row: the mean height over a stretch of the update interval."""

    table: ClassVar[AidTable] = STANDARD["baro"]
    parameters: ClassVar[Mapping[str, Parameter]] = {
        "baro_offset_m": Parameter(std=300.0, walk=0.03),
        "baro_wind": Parameter(std=0.1, walk=1e-4),
    }

    def begin(self, batch: Batch) -> BarometerMemory:
        """Memory before the first measurement."""
        return BarometerMemory(batch.imu.new_tensor([self.tuning.baro_std]), Trust.begin(batch.imu, batch.size[0]))

    def rows(
        self, epoch: Epoch, memory: BarometerMemory, prediction: Predicted
    ) -> tuple[Measurement | None, BarometerMemory]:
        """The row, and what the barometer has earned by it."""
        said = aid_of(epoch, self.table.name)
        if said is None:
            return None, memory
        value, std, lag, span, count = said.unbind(-1)
        seen, samples = count > 0, epoch.corrected.shape[1]
        weights = stretch_weights(lag.clamp_max(samples * epoch.dt), span, samples, epoch.dt)
        p_n = weighted_mean(weights, stack_limits(epoch.start.p_n, epoch.window.p_n))
        curved = p_n[:, :2].square().sum(-1) / (2 * epoch.frame.radius)
        v_n = weighted_mean(weights, stack_limits(epoch.start.v_n, epoch.window.v_n))
        head = v_n[:, :2].square().sum(-1) / (2 * NOMINAL_GRAVITY)
        share = prediction.parameters["baro_wind"]
        z = value - (epoch.frame.height - p_n[:, 2] + curved) - prediction.parameters["baro_offset_m"]
        z = z - share * head
        H = p_n.new_zeros(len(p_n), 1, self.states.count)
        H[:, 0, self.states.position.stop - 1] = -1.0
        H[:, 0, self.states.velocity.stop - 1] = lag  # δp at the stretch = δp at the end − lag · δv
        level = slice(self.states.velocity.start, self.states.velocity.stop - 1)
        H[:, 0, level] = share[:, None] * v_n[:, :2] / NOMINAL_GRAVITY
        H[:, 0, self.states.of("baro_offset_m")] = 1.0
        H[:, 0, self.states.of("baro_wind")] = head.unsqueeze(-1)
        R = torch.where(std > 0, std.clamp_min(LEAST_STD), memory.std).square()
        unsure = predicted_variance(prediction.P, H)[:, 0]
        trust, used, excess = judge(memory.trust, seen, z, unsure + R, unsure < KNOWS**2, seen)
        rows = Measurement(z.unsqueeze(-1), H, (R * excess).unsqueeze(-1), used.unsqueeze(-1))
        return rows, memory._replace(trust=trust)
