"""The core of a vehicle, as exported, called from Python: what :mod:`dlkf.running.streaming` is in Python."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

Status = IntEnum(
    "Status",
    "TAKEN REPLAYED SUPERSEDED NOT_FINITE IMPLAUSIBLE DOUBLE BACK GAP FULL NO_FIX OUTSIDE IMPLAUSIBLE_FIX LATE AHEAD "
    "NO_SENSOR RESTARTED DIVERGED LOST SPIKE FROZEN BRIDGED",
    start=0,
)  # those of dlkf_status
Waiting = IntEnum("Waiting", ["RUNS", "SAMPLES", "FIXES", "MOTION", "HEADING"], start=0)


class CoreReceipt(NamedTuple):
    """Answer to a sample or a fix, and the rows of the update intervals that it closed or changed (n, columns)."""

    status: Status
    rows: np.ndarray


class Core:
    """``dlkf.h`` in a library that :func:`dlkf.onboard.library.build` made; the calls of a ``StreamingFilter``.

    ``phase_s``, ``imu_step_s`` as there. The memory is :attr:`memory`, bytes that may be put away and taken up again.
    """

    def __init__(
        self,
        path: Path,
        lever_arm_b: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        phase_s: float = np.nan,
        imu_step_s: float = np.nan,
    ) -> None:
        library = self._library = ctypes.CDLL(str(path.resolve()))
        self.memory = ctypes.create_string_buffer(c_size_t.in_dll(library, "dlkf_bytes").value)
        self._columns = c_int.in_dll(library, "dlkf_columns").value
        self._latest = np.nan
        vector = POINTER(c_double)
        library.dlkf_next.restype = vector
        library.dlkf_says.restype = library.dlkf_waits_for.restype = c_char_p
        library.dlkf_count.restype = ctypes.c_int64
        library.dlkf_imu.argtypes = [ctypes.c_void_p, c_double, vector, vector]
        library.dlkf_gnss.argtypes = [ctypes.c_void_p, c_double, c_double, c_double, c_double, vector, vector, c_int]
        library.dlkf_aid.argtypes = [ctypes.c_void_p, c_int, c_double, c_double, c_double]
        library.dlkf_doubt.restype = c_double
        library.dlkf_pressure_height.argtypes, library.dlkf_pressure_height.restype = [c_double], c_double
        library.dlkf_lay.argtypes = [ctypes.c_void_p, c_double, c_double]
        library.dlkf_open(self.memory, (c_double * 3)(*lever_arm_b))
        library.dlkf_lay(self.memory, phase_s, imu_step_s)

    def imu(self, t: float, accel: Sequence[float], gyro: Sequence[float]) -> CoreReceipt:
        """Take a sample: mean specific force [m/s²] and rate [rad/s] over the interval that ends at ``t`` [s]."""
        three = c_double * 3
        return self._receipt(self._library.dlkf_imu(self.memory, t, three(*accel), three(*gyro)))

    def gnss(
        self, t: float, lat_deg: float, lon_deg: float, height_m: float,
        velocity_ned: Sequence[float] | None = None, std: Sequence[float] | None = None, quality: int = 1,
    ) -> CoreReceipt:  # fmt: skip
        """Take a fix of the antenna, instantaneous at ``t`` [s]."""
        v = None if velocity_ned is None else (c_double * 3)(*velocity_ned)
        s = None if std is None else (c_double * 6)(*std)
        return self._receipt(self._library.dlkf_gnss(self.memory, t, lat_deg, lon_deg, height_m, v, s, int(quality)))

    def aid(self, name: str, t: float, value: float, std: float = np.nan) -> CoreReceipt:
        """Take a sample of a further sensor, in the unit of its table."""
        sensor = self._library.dlkf_sensor(name.encode())
        return self._receipt(self._library.dlkf_aid(self.memory, sensor, t, value, std))

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

    def finish(self) -> CoreReceipt:
        """The end of a log."""
        self._library.dlkf_finish(self.memory)
        return self._receipt(0)

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
    def doubt(self) -> float:
        """Probability that the car faces another way than the likeliest."""
        return self._library.dlkf_doubt(self.memory)

    @property
    def counts(self) -> dict[Status, int]:
        """How often each status was given; samples that are taken do not count."""
        return {status: n for status in Status if (n := self._library.dlkf_count(self.memory, int(status)))}

    def count(self, status: Status) -> int:
        """How often one of them was given."""
        return self._library.dlkf_count(self.memory, int(status))

    @property
    def latest(self) -> float:
        """Time of the last row [s]; NaN before the first."""
        return self._latest

    @property
    def fits(self) -> bool:
        """Whether :attr:`memory` holds a filter of this library."""
        return bool(self._library.dlkf_fits(self.memory))

    def describe_status(self, status: Status) -> str:
        """The words of a status."""
        return self._library.dlkf_says(int(status)).decode()

    def _receipt(self, status: int) -> CoreReceipt:
        rows = []
        while row := self._library.dlkf_next(self.memory):
            rows.append(row[: self._columns])
        if rows:
            self._latest = rows[-1][0]
        return CoreReceipt(Status(status), np.array(rows).reshape(-1, self._columns))
