"""The states of :mod:`dlkf.filters.receiver` as a source, ``+receiver``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from dlkf.data.drive import Batch
from dlkf.filters.integration import Epoch
from dlkf.filters.receiver import ARM, DELAY, DRIFT
from dlkf.filters.sources import Parameter, Predicted
from dlkf.filters.tuning import Tuning
from dlkf.navigation.state import ErrorStates


@dataclass(frozen=True)
class Receiver:
    """Delay of the fixes, antenna and clock; it has no rows of its own, those of the fix contain them."""

    imu: object
    tuning: Tuning
    states: ErrorStates

    parameters: ClassVar[Mapping[str, Parameter]] = {
        DELAY: Parameter(std=0.05, walk=1e-4, largest=0.9),
        **{name: Parameter(std=0.2, largest=2.0) for name in ARM},
        DRIFT: Parameter(std=100.0, walk=0.1, largest=1000.0),
    }

    @property
    def code(self) -> Receiver:
        """Without the numbers that the memory carries."""
        return Receiver(None, Tuning(), self.states)

    def begin(self, batch: Batch) -> None:
        """No memory."""
        return None

    def rows(self, epoch: Epoch, memory: None, prediction: Predicted) -> tuple[None, None]:
        """None."""
        return None, None
