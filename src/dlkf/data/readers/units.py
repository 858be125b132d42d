"""Units, axes and clocks that logs come in, and their way to SI, Forward-Right-Down and seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from dlkf.errors import InputError

G, DEG = 9.80665, math.pi / 180
ACCELERATION = {"m/s2": 1.0, "m/s": 1.0, "g": G, "mg": G * 1e-3, "cm/s2": 0.01, "gal": 0.01}
RATE = {"rad/s": 1.0, "rad": 1.0, "deg/s": DEG, "deg": DEG, "mdeg/s": DEG * 1e-3, "deg/h": DEG / 3600}
ANGLE = {"rad": 1.0, "deg": DEG, "1e-7deg": DEG * 1e-7}
SPEED = {"m/s": 1.0, "km/h": 1 / 3.6, "knots": 1852 / 3600, "cm/s": 0.01, "mm/s": 1e-3, "mph": 0.44704}
LENGTH = {"m": 1.0, "mm": 1e-3, "cm": 0.01, "km": 1e3, "ft": 0.3048}
TIME = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}  # ticks per second
WEEK_S = 604_800
GPS_EPOCH_UNIX = 315_964_800  # 1980-01-06 in Unix seconds
LEAP_S = 18  # GPS − UTC since 2017

LETTERS = {"f": (0, 1), "b": (0, -1), "r": (1, 1), "l": (1, -1), "d": (2, 1), "u": (2, -1)}


def factor(unit: str | float, table: Mapping[str, float], where: str) -> float:
    """SI per unit; ``unit`` is a name in the table or that number itself. InputError for unknown names."""
    if isinstance(unit, (int, float)) and not isinstance(unit, bool):
        return float(unit)
    if unit not in table:
        raise InputError(
            f"{where}: unknown unit {unit!r}; known are {', '.join(table)}, or a number (SI per unit)"
        )
    return float(table[unit])


def rotation(axes: str | Sequence[str], where: str) -> np.ndarray:
    """Matrix (3, 3) from the sensor's axes to Forward-Right-Down.

    ``axes`` is three letters that say where the sensor's x, y, z point (``frd``, ``flu``, ``rfu``, …), or the
    sensor's axes that make Forward, Right, Down (``[x, -y, -z]``). InputError if they make no right-handed
    triad.
    """
    matrix = np.zeros((3, 3))
    if isinstance(axes, str) and len(axes) == 3 and all(c in LETTERS for c in axes.lower()):
        for column, letter in enumerate(axes.lower()):
            row, sign = LETTERS[letter]
            matrix[row, column] = sign
    else:
        names = [str(a).strip().lower() for a in ([] if isinstance(axes, str) else axes)]
        bare = [n.lstrip("+-") for n in names]
        if len(names) != 3 or any(b not in ("x", "y", "z") for b in bare):
            raise InputError(
                f"{where}: axes {axes!r} must be three letters like flu, or a list like [x, -y, -z]"
            )
        for row, (name, b) in enumerate(zip(names, bare)):
            matrix[row, "xyz".index(b)] = -1.0 if name.startswith("-") else 1.0
    if abs(np.linalg.det(matrix) - 1) > 1e-9:
        raise InputError(
            f"{where}: axes {axes!r} make no right-handed triad; turn a sign or exchange two axes"
        )
    return matrix


def seconds(
    values: np.ndarray, unit: str, week: np.ndarray | None, clock: str | None, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Whole seconds (int64) and the rest (float64) of stamps, so that nanoseconds since 1970 lose nothing.

    With ``week`` the stamps are seconds of the GPS week. ``clock`` = unix turns Unix time into GPS time, so
    that it can be mixed with GPS weeks; gps and null leave the stamps as they are.
    """
    if unit not in TIME:
        raise InputError(f"{where}: unknown time unit {unit!r}; known are {', '.join(TIME)}")
    if clock not in (None, "gps", "unix"):
        raise InputError(f"{where}: unknown clock {clock!r}; known are gps, unix, or null")
    ticks = TIME[unit]
    if np.issubdtype(values.dtype, np.integer):
        whole, rest = np.divmod(values.astype(np.int64), ticks)
        part = rest / ticks
    else:
        value = values / ticks
        whole = np.floor(value).astype(np.int64)
        part = value - whole
    if week is not None:
        whole = whole + WEEK_S * week.astype(np.int64)
    if clock == "unix":
        whole = whole - GPS_EPOCH_UNIX + LEAP_S
    return whole, part
