"""Fixes and samples of further sensors of a stream, kept by the boundary of the epoch grid at which they count."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dlkf.data.aid_tables import AidTable
from dlkf.data.aids import aid_row
from dlkf.data.resampling import BLANK, FixRows
from dlkf.data.schema import POSITION, STD, VELOCITY
from dlkf.data.validate import GNSS_QUALITIES, usable_fixes
from dlkf.running.imu_stream import Row, to_floats

NO_FIX = FixRows(
    np.full((1, 3), BLANK["r_e"]), np.full((1, 3), BLANK["v_e"]), np.full((1, 6), BLANK["std"]),
    np.full((1, 6), BLANK["valid"]), np.full(1, BLANK["lag"]), np.full(1, BLANK["quality"]),
)  # fmt: skip


class MeasurementBuffer:
    """The latest fix and the samples of further sensors (``tables``) of every boundary that is still of use."""

    def __init__(self, tables: Sequence[AidTable]) -> None:
        self.tables = {table.name: table for table in tables}
        self.clear()

    def clear(self) -> None:
        """Drop everything."""
        self._fixes: dict[int, tuple[float, FixRows]] = {}  # time and fix by boundary
        self._aids: dict[int, dict[str, list[tuple[float, float, float]]]] = {}  # t, value, std by boundary and sensor

    def drop(self, boundary: int) -> None:
        """What belongs to a boundary that no replay reaches any more."""
        self._fixes.pop(boundary, None)
        self._aids.pop(boundary, None)

    def has_fix(self, boundary: int) -> bool:
        """Whether a boundary has a fix."""
        return boundary in self._fixes

    def fix_time(self, boundary: int) -> float:
        """Time of a boundary's fix [s]; −∞ without one."""
        return self._fixes[boundary][0] if boundary in self._fixes else -math.inf

    def fix(self, boundary: int) -> FixRows:
        """The fix of a boundary, :data:`NO_FIX` without one."""
        return self._fixes.get(boundary, (0.0, NO_FIX))[1]

    def put_fix(self, boundary: int, fix: tuple[float, FixRows] | None) -> None:
        """A fix with its time [s] in the place of an earlier one; None leaves the boundary without."""
        self._fixes.pop(boundary, None)
        if fix is not None:
            self._fixes[boundary] = fix

    def put_aid(self, boundary: int, name: str, t: float, value: float, std: float) -> bool:
        """A sample beside the others of its interval; False where one of its time is there already."""
        held = self._aids.setdefault(boundary, {}).setdefault(name, [])
        if any(t == sample[0] for sample in held):
            return False
        held.append((t, value, std))
        return True

    def aid_rows(self, boundary: int, end: float) -> dict[str, np.ndarray]:
        """Rows (:data:`dlkf.data.aids.ROW`) of the sensors in the epoch before a boundary at ``end`` [s]."""
        held = self._aids.get(boundary, {})
        return {name: aid_row(table, held.get(name, ()), end) for name, table in self.tables.items()}


def as_number(x: Any) -> float:
    """As float; NaN where it is no number."""
    try:
        return to_floats(x)[0]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def check_fix(
    t: float, place: Sequence[float], velocity_ned: Row | None, std: Row | None, quality: int
) -> dict[str, np.ndarray] | str:
    """A fix as a table of one row, unknown values as NaN; the reason where it is none."""
    velocity_ned = [math.nan] * 3 if velocity_ned is None else velocity_ned
    std = [math.nan] * 6 if std is None else std
    try:
        if len(velocity_ned) != 3 or len(std) != 6:
            return "velocity_ned must have 3 values, std 6"
        values = to_floats(t, *place, *velocity_ned, *std)
        fix = {name: np.array([x]) for name, x in zip(("t", *POSITION, *VELOCITY, *STD), values)}
        fix["quality"] = np.array([int(quality) if quality in GNSS_QUALITIES else 0])
    except (TypeError, ValueError, OverflowError):
        return "the fix holds what is no number"
    for name, value in fix.items():
        if np.isinf(value[0]) or (name == "t" and np.isnan(value[0])):
            return f"{name} is {value[0]}"
    if not usable_fixes(fix)[0]:
        return "no fix: a quality without one, or a position that is not a number"
    lat, lon = fix["lat_deg"][0], fix["lon_deg"][0]
    if abs(lat) > 90 or abs(lon) > 180:
        return f"lat_deg {lat:.4f}, lon_deg {lon:.4f} lie outside ±90, ±180"
    if any(fix[name][0] < 0 for name in STD):
        return "a std is below 0; NaN if unknown"
    return fix
