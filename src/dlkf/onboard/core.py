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


class CoreReceipt(NamedTuple):
    """Answer to a sample or a fix, and the rows of the update intervals that it closed or changed (n, columns)."""

    status: Status
    rows: np.ndarray


class Core:
    """``dlkf.h`` in a library that :func:`dlkf.onboard.library.build` made, fed as a ``StreamingFilter`` is.

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
        library.dlkf_says.restype = c_char_p
        library.dlkf_count.restype = ctypes.c_int64
        library.dlkf_imu.argtypes = [ctypes.c_void_p, c_double, vector, vector]
        library.dlkf_gnss.argtypes = [ctypes.c_void_p, c_double, c_double, c_double, c_double, vector, vector, c_int]
        library.dlkf_aid.argtypes = [ctypes.c_void_p, c_int, c_double, c_double, c_double]
        library.dlkf_doubt.restype = c_double
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

    def finish(self) -> CoreReceipt:
        """The end of a log."""
        self._library.dlkf_finish(self.memory)
        return self._receipt(0)

    @property
    def doubt(self) -> float:
        """Probability that the car faces another way than the likeliest."""
        return self._library.dlkf_doubt(self.memory)

    def count(self, status: Status) -> int:
        """How often one of them was given."""
        return self._library.dlkf_count(self.memory, int(status))

    @property
    def latest(self) -> float:
        """Time of the last row [s]; NaN before the first."""
        return self._latest

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
