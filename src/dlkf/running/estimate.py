"""A filter's output at one moment, in the units of ``solution.parquet``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import pandas as pd
import torch
from torch import Tensor

from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState
from dlkf.running.solution import solution_columns, solution_table


@dataclass(frozen=True)
class Estimate:
    """State of the IMU at ``t`` [s, clock of the samples]; tensors have one batch element.

    ``imu_error`` (1, 6) [m/s², rad/s] is what comes off the samples from ``t`` on, ``std`` (1, 15) the 1σ of
    position, velocity, attitude in n and of the IMU error, None where the filter has none. ``gnss_used``: a fix
    corrected this estimate.
    """

    t: float
    frame: TangentFrame
    state: NavState
    imu_error: Tensor
    std: Tensor | None
    gnss_used: bool
    aids: Mapping[str, float] | None = None  # of further sensors, see dlkf.filters.aids.attach.aid_columns

    @cached_property
    def row(self) -> dict[str, float | bool]:
        """The row of ``solution.parquet`` (:mod:`dlkf.running.solution`): geodetic position, NED, roll-pitch-yaw."""
        t = torch.tensor([self.t], dtype=torch.float64)
        columns = solution_columns(t, self.frame, self.state, self.imu_error, self.std)
        return {name: float(value) for name, value in columns.items()} | {
            "gnss_used": self.gnss_used,
            **(self.aids or {}),
        }


def estimates_table(estimates: Iterable[Estimate]) -> pd.DataFrame:
    """Estimates as the rows of ``solution.parquet``."""
    parts = []
    for _, group in groupby(estimates, key=lambda e: id(e.frame)):
        rows = list(group)
        state = NavState(*(torch.cat(x) for x in zip(*(e.state for e in rows))))
        std = None if rows[0].std is None else torch.cat([e.std for e in rows if e.std is not None])
        t = torch.tensor([e.t for e in rows], dtype=torch.float64)
        used = torch.tensor([e.gnss_used for e in rows])
        error = torch.cat([e.imu_error for e in rows])
        aids = pd.DataFrame([dict(e.aids or {}) for e in rows])
        parts.append(solution_table(t, rows[0].frame, state, error, std, used).join(aids))
    return pd.concat(parts, ignore_index=True)
