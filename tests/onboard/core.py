"""The core of a vehicle with the calls and properties that the tests look at beside those of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_char_p, c_double
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from dlkf.onboard.core import Core as ReplayedCore
from dlkf.onboard.core import CoreReceipt, Status

Waiting = IntEnum("Waiting", ["RUNS", "SAMPLES", "FIXES", "MOTION", "HEADING"], start=0)


class Core(ReplayedCore):
    """With all calls of a ``StreamingFilter``."""

    def __init__(self, path: Path, lever_arm_b: Sequence[float] = (0.0, 0.0, 0.0), **options: Any) -> None:
        super().__init__(path, lever_arm_b, **options)
        self._library.dlkf_waits_for.restype = c_char_p
        height = self._library.dlkf_pressure_height
        height.argtypes, height.restype = [c_double], c_double

    def speed(self, t: float, speed: float, std: float = np.nan) -> CoreReceipt:
        """Take a wheel speed [m/s]."""
        return self.aid("speed", t, speed, std)

    def heading(self, t: float, heading: float, std: float = np.nan) -> CoreReceipt:
        """Take the car's heading [rad]."""
        return self.aid("heading", t, heading, std)

    def baro(self, t: float, height_m: float = np.nan, std: float = np.nan, *, pressure: float = np.nan) -> CoreReceipt:
        """Take a barometric height [m], or a ``pressure`` [Pa]."""
        height = height_m if np.isfinite(height_m) else self._library.dlkf_pressure_height(pressure)
        return self.aid("baro", t, height, std)

    def now(self) -> np.ndarray | None:
        """The row of the last sample; None while it aligns."""
        row = (c_double * self._columns)()
        waiting = self._library.dlkf_pose(self.memory, row)
        return np.array(row) if waiting == Waiting.RUNS else None

    @property
    def waiting(self) -> Waiting:
        """What it waits for."""
        return Waiting(self._library.dlkf_waits(self.memory))

    @property
    def waits_for(self) -> str:
        """The same in words."""
        return self._library.dlkf_waits_for(int(self.waiting)).decode()

    @property
    def counts(self) -> dict[Status, int]:
        """How often each status was given; samples that are taken do not count."""
        return {status: n for status in Status if (n := self._library.dlkf_count(self.memory, int(status)))}

    @property
    def fits(self) -> bool:
        """Whether :attr:`memory` holds a filter of this library."""
        return bool(self._library.dlkf_fits(self.memory))
