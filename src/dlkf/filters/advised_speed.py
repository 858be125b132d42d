"""A forward speed that a network tells, as a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.advice import ABSENT
from dlkf.filters.branches import may_branch
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Believed, Measurement
from dlkf.navigation.attitude import skew
from dlkf.navigation.state import ATTITUDE, VELOCITY, ErrorStates


@dataclass(frozen=True)
class AdvisedSpeed:
    """One row, v_x = (C_bn v_n)_x at the IMU, wherever the advice has a speed that is not absent."""

    states: ErrorStates

    def begin(self, batch: Batch) -> None:
        """Nothing to remember."""
        return None

    def rows(self, epoch: Epoch, memory: None, believed: Believed) -> tuple[Measurement | None, None]:
        """The row, or none where no piece is told a speed."""
        speed: Tensor | None = None if epoch.advice is None else epoch.advice.speed
        if speed is None:
            return None, None
        used = speed[:, 1:] < ABSENT
        if may_branch(used) and not bool(used.any()):
            return None, None
        state = epoch.window.end
        forward = state.C_nb[:, :, :1].mT
        H = torch.zeros(len(speed), 1, self.states.count, dtype=speed.dtype, device=speed.device)
        H[:, :, VELOCITY] = forward
        H[:, :, ATTITUDE] = forward @ skew(state.v_n)
        z = speed[:, :1] - (forward @ state.v_n.unsqueeze(-1)).squeeze(-1)
        return Measurement(z, H, speed[:, 1:].square(), used), None
