"""The states of :mod:`dlkf.filters.g_sensitivity` as a source, ``+g_sensitivity``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from dlkf.filters.g_sensitivity import NAMES
from dlkf.filters.sources import Parameter, SensorSource


class GSensitivity(SensorSource):
    """Six entries of G. It has no rows: fixes and constraints show G, as they show the gyroscopes' biases."""

    parameters: ClassVar[Mapping[str, Parameter]] = dict.fromkeys(NAMES, Parameter(std=1e-4, largest=2e-3))
