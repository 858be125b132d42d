"""A drive as tensors on an epoch grid, and the batch of segments that a filter runs on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from dlkf.data.limits import NONE_REFUSED, Refused
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState

EPOCHWISE = (
    "imu", "gnss", "gnss_std", "gnss_valid", "gnss_lag", "available", "truth", "truth_valid", "attitude_valid",
    "true_imu_error", "present",
)  # fields of Batch with a row for every epoch  # fmt: skip
BOUNDARY_COLUMNS = (
    "gnss_r_e", "gnss_v_e", "gnss_std", "gnss_valid", "gnss_lag",
    "ref_r_e", "ref_v_e", "ref_C_eb", "ref_valid", "ref_imu_error",
)  # of Drive, with a row for every boundary; quality is one too, of no use to a filter  # fmt: skip


def _apply(value: Any, change: Callable[[Any], Any]) -> Any:
    """A field of a batch with ``change`` made to the tensors in it."""
    if isinstance(value, NavState):
        return NavState(*map(change, value))
    if isinstance(value, Mapping):
        return {name: change(x) for name, x in value.items()}
    return change(value) if isinstance(value, (Tensor, TangentFrame)) else value


@dataclass(frozen=True)
class Drive:
    """One drive, resampled to a uniform IMU rate and cut into N epochs of M samples.

    Epoch k (k = 0 … N−1) spans ``t0 + k·epoch_s`` to ``t0 + (k+1)·epoch_s``. Per-epoch rows of length N+1
    belong to the epoch *boundaries*: row 0 to ``t0``, row k+1 to the end of epoch k. The grid is chosen so
    that GNSS fixes fall on boundaries where their rate allows; a fix that lies ``gnss_lag`` seconds before
    its boundary keeps its own time. NaN or False where unknown. Positions and velocities are ECEF float64.
    """

    name: str
    group: str
    dataset: str
    t0: float
    epoch_s: float
    rate_hz: float
    imu: Tensor  # (N, M, 6) accelerometer, gyroscope; mean over the sample, ``dtype`` of the loader
    gnss_r_e: Tensor  # (N+1, 3) float64
    gnss_v_e: Tensor  # (N+1, 3) float64
    gnss_std: Tensor  # (N+1, 6) m, m/s in NED; defaults by quality where the file has NaN
    gnss_valid: Tensor  # (N+1, 6) bool: position and velocity components that may be used
    gnss_lag: Tensor  # (N+1,) s ≥ 0
    quality: Tensor  # (N+1,) int64 NMEA GGA code, 0 where there is no fix
    ref_r_e: Tensor  # (N+1, 3) float64, NaN where unknown
    ref_v_e: Tensor  # (N+1, 3) float64
    ref_C_eb: Tensor  # (N+1, 3, 3) float64, NaN where the source has no full attitude
    ref_valid: Tensor  # (N+1,) bool: position and velocity may be scored
    ref_imu_error: Tensor  # (N+1, 6) float64, NaN unless the source (a simulation) has it
    lever_arm_b: Tensor  # (3,) m, IMU → antenna
    refused: Refused = NONE_REFUSED  # rows of its tables that were rejected as implausible
    aids: Mapping[str, Tensor] = field(default_factory=dict)  # (N+1, 5) of further sensors, see dlkf.data.aids.ROW

    @property
    def epochs(self) -> int:
        """Number of epochs N."""
        return self.imu.shape[0]

    def part(self, first: int, last: int) -> Drive:
        """Epochs ``first`` to ``last`` − 1 as a drive of its own."""
        rows = slice(first, last + 1)
        return replace(
            self,
            t0=self.t0 + first * self.epoch_s,
            imu=self.imu[first:last],
            aids={name: x[rows] for name, x in self.aids.items()},
            **{name: getattr(self, name)[rows] for name in (*BOUNDARY_COLUMNS, "quality")},
        )


@dataclass(frozen=True)
class Batch:
    """B segments of T epochs of M samples, ready for the filter loop. Row t belongs to the *end* of epoch t.

    Tensors have the working precision (float32 in training) in the tangent frame of each segment's start;
    ``start`` and ``start_std`` (position, velocity, attitude; 1σ) are what a filter is given at t = 0.
    ``available`` marks epochs whose fix a filter may use: outages and decimation switch it off.
    """

    imu: Tensor  # (B, T, M, 6)
    dt: float  # s per IMU sample
    frame: TangentFrame
    gnss: Tensor  # (B, T, 6) antenna position and velocity in n; zero where not valid
    gnss_std: Tensor  # (B, T, 6)
    gnss_valid: Tensor  # (B, T, 6) bool
    gnss_lag: Tensor  # (B, T) s before the epoch's end
    available: Tensor  # (B, T) bool
    lever_arm_b: Tensor  # (B, 3)
    start: NavState  # (B, …)
    start_std: Tensor  # (B, 9)
    truth: NavState  # (B, T, …) NaN where unknown
    truth_valid: Tensor  # (B, T) bool: position and velocity
    attitude_valid: Tensor  # (B, T) bool
    true_imu_error: Tensor  # (B, T, 6) NaN unless simulated
    present: Tensor  # (B, T) bool: False in the padding of shorter drives
    drive: tuple[str, ...]  # name per segment
    t_start: Tensor  # (B,) float64 s, file clock
    aids: Mapping[str, Tensor] = field(default_factory=dict)  # (B, T, 5) of further sensors, see dlkf.data.aids.ROW
    start_gyro: Tensor | None = None  # (B, 6) rad/s: gyroscope bias as far as the start shows it, and its 1σ or inf
    start_noise: Tensor | None = None  # (B, 2) √w of positions and velocities, see dlkf.filters.fix_noise

    @property
    def size(self) -> tuple[int, int, int]:
        """(B, T, M)."""
        return self.imu.shape[0], self.imu.shape[1], self.imu.shape[2]

    @property
    def epoch_s(self) -> float:
        """Length of an epoch [s]."""
        return self.dt * self.imu.shape[2]

    def select(self, index: Int[Tensor, " b"]) -> Batch:
        """Some segments of the batch."""
        kept = {f.name: _apply(getattr(self, f.name), lambda x: x[index]) for f in fields(self)}
        return replace(self, **kept | {"drive": tuple(self.drive[i] for i in index.tolist())})

    def trim(self) -> Batch:
        """The batch without the padding that none of its segments needs."""
        T = max(1, int(self.present.sum(-1).max()))
        if self.size[1] == T:
            return self
        names = (*EPOCHWISE, "aids")
        return replace(self, **{name: _apply(getattr(self, name), lambda x: x[:, :T]) for name in names})

    def to(self, device: torch.device | str) -> Batch:
        """The same batch on another device."""
        return replace(self, **{f.name: _apply(getattr(self, f.name), lambda x: x.to(device)) for f in fields(self)})

    def in_precision(self, dtype: torch.dtype) -> Batch:
        """The same batch with its working fields in ``dtype``; file clock and ECEF origin stay float64."""

        def cast(x: Tensor | TangentFrame) -> Tensor | TangentFrame:
            if isinstance(x, TangentFrame):
                return x.in_precision(dtype)
            return x.to(dtype) if x.is_floating_point() else x

        working = [f.name for f in fields(self) if f.name != "t_start"]
        return replace(self, **{name: _apply(getattr(self, name), cast) for name in working})
