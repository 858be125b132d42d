"""The states of :mod:`dlkf.filters.g_sensitivity` as a source, ``+g_sensitivity``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from dlkf.data.drive import Batch
from dlkf.filters.g_sensitivity import NAMES
from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Parameter, Predicted
from dlkf.filters.tuning import Tuning
from dlkf.navigation.state import ErrorStates


@dataclass(frozen=True)
class GSensitivity:
    """Six entries of G. It has no rows: fixes and constraints show G, as they show the gyroscopes' biases."""

    imu: object
    tuning: Tuning
    states: ErrorStates

    parameters: ClassVar[Mapping[str, Parameter]] = dict.fromkeys(NAMES, Parameter(std=1e-4, largest=2e-3))

    @property
    def code(self) -> GSensitivity:
        """Without the numbers that the memory carries."""
        return GSensitivity(None, Tuning(), self.states)

    def begin(self, batch: Batch) -> None:
        """No memory."""
        return None

    def rows(self, epoch: Epoch, memory: None, prediction: Predicted) -> tuple[None, None]:
        """None."""
        return None, None
