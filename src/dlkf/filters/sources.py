"""Measurement sources of a Kalman filter: each gives rows of one common update per epoch.

A source is a class with two methods (:class:`Source`), in a file of its own, which every command takes behind a
filter's name: ``model=mbkf21_nhc+speed_limit:SpeedLimit``; ``docs/developing.md`` has examples. One that belongs to a
sensor names its table of the dataset (``table``) and the error states that it adds (``parameters``), as wheel speed,
heading and barometer do (:mod:`dlkf.filters.aids`). One without a table may name ``columns`` of the output and give
them by ``describe(epoch, memory, rows, P)``, as speed from vibration does.
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
from dlkf.filters.integration import Epoch
from dlkf.filters.tuning import Tuning
from dlkf.navigation.state import ErrorStates


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
