"""The states of :mod:`dlkf.filters.receiver` as a source, ``+receiver``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from dlkf.filters.receiver import ARM, DELAY, DRIFT
from dlkf.filters.sources import Parameter, SensorSource


class Receiver(SensorSource):
    """Delay of the fixes, antenna and clock; it has no rows of its own, those of the fix contain them."""

    parameters: ClassVar[Mapping[str, Parameter]] = {
        DELAY: Parameter(std=0.05, walk=1e-4, largest=0.9),
        **{name: Parameter(std=0.2, largest=2.0) for name in ARM},
        DRIFT: Parameter(std=100.0, walk=0.1, largest=1000.0),
    }
