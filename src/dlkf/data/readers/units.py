"""Units, axes and clocks that logs come in, and their way to SI, Forward-Right-Down and seconds."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.base.settings import is_number
from dlkf.navigation.earth import STANDARD_GRAVITY as G

DEG = math.pi / 180
ACCELERATION = {"m/s2": 1.0, "m/s": 1.0, "g": G, "mg": G * 1e-3, "cm/s2": 0.01, "gal": 0.01}
RATE = {"rad/s": 1.0, "rad": 1.0, "deg/s": DEG, "deg": DEG, "mdeg/s": DEG * 1e-3, "deg/h": DEG / 3600}
ANGLE = {"rad": 1.0, "deg": DEG, "1e-7deg": DEG * 1e-7}
SPEED = {"m/s": 1.0, "km/h": 1 / 3.6, "knots": 1852 / 3600, "cm/s": 0.01, "mm/s": 1e-3, "mph": 0.44704}
LENGTH = {"m": 1.0, "mm": 1e-3, "cm": 0.01, "km": 1e3, "ft": 0.3048}
TIME = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000, "1e-4s": 10_000}  # ticks per second
ORDERS = ("ymd", "dmy", "mdy")  # of a date in numbers
HHMMSS = "hhmmss"  # a clock's face as one number: 235712.7, as NMEA has it
DAYS = {"datenum": 719_529, "excel": 25_569}  # day 0 of 1970 in MATLAB's datenum and in a spreadsheet's dates
ISO = "iso"  # calendar texts: 2025-07-05T23:57:12.7Z, 2025/07/05 23:57:12.700
CLOCKS = ("gps", "unix", "utc")
OF_DAY = r"^\s*\d{1,2}:\d{2}(:\d{2}([.,]\d*)?)?\s*([AaPp][Mm])?\s*Z?\s*$"  # calendar texts without a date
SKIPPED_S = 1.0  # of a counter that starts again each second the rows of that time may lack
DAY_S, WEEK_S = 86_400, 604_800
GPS_EPOCH_UNIX = 315_964_800  # 1980-01-06 in Unix seconds
UNIX_SINCE, GPS_SINCE = 1.55e9, 3e8  # s; a Unix second after January 2019; a GPS second after 1989
# days from which GPS − UTC is one second more than before (IERS Bulletin C): 0 in 1980, 18 since 2017
LEAP_DAYS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)

LEAP_UNIX = np.array(LEAP_DAYS, dtype="datetime64[s]").astype(np.int64)

LETTERS = {"f": (0, 1), "b": (0, -1), "r": (1, 1), "l": (1, -1), "d": (2, 1), "u": (2, -1)}


def factor(unit: str | float, table: Mapping[str, float], where: str) -> float:
    """SI per unit; ``unit`` is a name in the table or that number itself. InputError for unknown names."""
    if is_number(unit):
        return float(unit)
    if not isinstance(unit, str) or unit not in table:
        raise InputError(f"{where}: unknown unit {unit!r}; known are {', '.join(table)}, or a number (SI per unit)")
    return float(table[unit])


def rotation(axes: str | Sequence[str] | Mapping[str, float], where: str) -> np.ndarray:
    """Matrix (3, 3) from the sensor's axes to Forward-Right-Down.

    ``axes`` is three letters for where the sensor's x, y, z point (``frd``, ``flu``, ``rfu``, …), or the sensor's
    axes that make Forward, Right, Down (``[x, -y, -z]``), or the sensor's ``{roll, pitch, yaw}`` in the car [deg].
    InputError if they make no right-handed triad.
    """
    if isinstance(axes, Mapping):
        if set(axes) != {"roll", "pitch", "yaw"}:
            raise InputError(f"{where}: has {', '.join(map(str, axes))}; must have roll, pitch and yaw [deg]")
        turns = [number(axes[name], f"{where}.{name}") for name in ("yaw", "pitch", "roll")]
        from scipy.spatial.transform import Rotation  # every start of navigate would load it

        return Rotation.from_euler("ZYX", turns, degrees=True).as_matrix()
    matrix = np.zeros((3, 3))
    if isinstance(axes, str) and len(axes) == 3 and all(c in LETTERS for c in axes.lower()):
        for column, letter in enumerate(axes.lower()):
            row, sign = LETTERS[letter]
            matrix[row, column] = sign
    else:
        names = [str(a).strip().lower() for a in ([] if isinstance(axes, str) else axes)]
        bare = [n.lstrip("+-") for n in names]
        if len(names) != 3 or any(b not in ("x", "y", "z") for b in bare):
            raise InputError(f"{where}: axes {axes!r} must be three letters like flu, or a list like [x, -y, -z]")
        for row, (name, b) in enumerate(zip(names, bare)):
            matrix[row, "xyz".index(b)] = -1.0 if name.startswith("-") else 1.0
    if abs(np.linalg.det(matrix) - 1) > 1e-9:
        raise InputError(f"{where}: axes {axes!r} make no right-handed triad; turn a sign or exchange two axes")
    return matrix


def mirror(axis: object, where: str) -> np.ndarray:
    """Factors (3,) that turn round the ``axis`` (x, y, z) in which a left-handed sensor counts the other way."""
    if axis is None:
        return np.ones(3)
    if axis not in ("x", "y", "z"):
        raise InputError(f"{where}={axis}: must be x, y or z, or null for a right-handed sensor")
    return np.where([axis == a for a in "xyz"], -1.0, 1.0)


def seconds(
    values: np.ndarray,
    unit: str,
    week: np.ndarray | None,
    clock: str | None,
    where: str,
    day: str | None = None,
    order: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Whole seconds (int64) and the rest (float64) of stamps, so that nanoseconds since 1970 lose nothing.

    With ``week`` the stamps are seconds of the GPS week, with ``day`` of that day. ``clock`` = unix or utc turns Unix
    time (calendar texts in UTC) into GPS time, leap seconds of their day included, so that it can be mixed with GPS
    weeks; with gps calendar texts are GPS time already; numbers of a gps clock, and all of none, stay as they are.
    ``order`` (dmy, mdy) is that of days and months in calendar texts that do not begin with the year.
    """
    if unit not in (*TIME, ISO):
        raise InputError(f"{where}: unknown time unit {unit!r}; known are {', '.join((*TIME, *DAYS, HHMMSS, ISO))}")
    if clock not in (None, *CLOCKS):
        raise InputError(f"{where}: unknown clock {clock!r}; known are {', '.join(CLOCKS)}, or null")
    if unit == ISO:
        whole, part = _split(_calendar(values, where, order), TIME["ns"])
    else:
        whole, part = _split(values, TIME[unit])
    if day is not None:
        whole = whole + _split(_calendar(np.array([day]), f"{where}.day"), TIME["ns"])[0]
    if clock == "gps" and (unit == ISO or day is not None):
        return whole - GPS_EPOCH_UNIX, part
    if week is not None:
        whole = whole + WEEK_S * week.astype(np.int64)
    if clock in ("unix", "utc"):
        whole = gps_seconds(whole)
    return whole, part


def clock_by_size(seconds: float) -> str | None:
    """Whether seconds count from 1970 (unix) or from 1980 (gps), by their size; None if neither can be."""
    newest_gps = min(UNIX_SINCE, now() - GPS_EPOCH_UNIX + 86_400)
    return "unix" if seconds > newest_gps else "gps" if seconds > GPS_SINCE else None


def now() -> float:
    """Unix time [s]; no log is newer."""
    return time.time()


def leap_seconds(unix: np.ndarray | int) -> np.ndarray:
    """GPS − UTC [s] at Unix times."""
    return np.searchsorted(LEAP_UNIX, unix, side="right")


def gps_seconds(unix: Any) -> Any:
    """GPS time [s since 1980] of Unix times [s], one or an array."""
    return unix - GPS_EPOCH_UNIX + leap_seconds(unix)


def unwrap_stamps(values: np.ndarray, wraps_s: float, ticks: float) -> np.ndarray:
    """Stamps, ``ticks`` a second, that start again after ``wraps_s`` (week, day, counter) made to go on.

    They start again where they fall by more than a half of it, or where the time that is skipped so is below
    ``SKIPPED_S``: less are rows out of order.
    """
    wrap = wraps_s * ticks
    if np.issubdtype(values.dtype, np.integer):
        wrap = int(wrap)
    step = np.diff(values)
    turns = np.concatenate(([0], np.cumsum((step < 0) & ((step < -wrap / 2) | (step + wrap < SKIPPED_S * ticks)))))
    return values + turns * wrap


def seconds_of_day(values: np.ndarray) -> np.ndarray:
    """Hours, minutes and seconds as one number (hhmmss.s) as seconds of the day."""
    hours, rest = np.divmod(values, 10_000)
    minutes, seconds = np.divmod(rest, 100)
    return 3600 * hours + 60 * minutes + seconds


def nanoseconds_of_day(texts: np.ndarray, where: str) -> np.ndarray | None:
    """Times of day without a date (23:57:12.7) as nanoseconds of the day; None for any other texts."""
    if not all(re.match(OF_DAY, text) for text in texts):
        return None
    return _calendar(np.array([f"1970-01-01 {text}" for text in texts]), where)


def day_of_number(value: object) -> str | None:
    """The day of a date as one number, ddmmyy as NMEA has it or yyyymmdd; None where it is none."""
    text = str(value).strip().removesuffix(".0")
    found = re.fullmatch(r"(\d{4})(\d\d)(\d\d)", text) or re.fullmatch(r"(\d\d)(\d\d)(\d\d)", text.zfill(6))
    if found is None:
        return None
    year, month, day = found.groups() if len(found[1]) == 4 else (f"20{found[3]}", found[2], found[1])
    return f"{year}-{month}-{day}" if 1 <= int(month) <= 12 and 1 <= int(day) <= 31 else None


def degrees_minutes(values: np.ndarray) -> np.ndarray:
    """NMEA's ddmm.mmmm as degrees."""
    size = np.abs(values)
    whole = np.floor(size / 100)
    return np.sign(values) * (whole + (size - 100 * whole) / 60)


def degrees_minutes_seconds(cells: pd.DataFrame) -> np.ndarray:
    """Three columns of texts as degrees; −0° is south or west as well."""
    size = cells.apply(pd.to_numeric, errors="coerce").abs().to_numpy() @ [1, 1 / 60, 1 / 3600]
    return np.where(cells.iloc[:, 0].str.startswith("-"), -size, size)


def _split(values: np.ndarray, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    if np.issubdtype(values.dtype, np.integer):
        whole, rest = np.divmod(values.astype(np.int64), ticks)
        return whole, rest / ticks
    value = values / ticks
    whole = np.floor(value).astype(np.int64)
    return whole, value - whole


def day_order(texts: pd.Series) -> str | None:
    """The order of day and month in dates that begin with neither a year nor a name, by a day above 12 or by points
    (5.7.2025, day first); empty where both are possible, None where the year comes first."""
    parts = texts.str.extract(r"^\s*(\d{1,2})([./-])(\d{1,2})[./-]\d{2,4}")
    if bool(parts[0].isna().any()):
        return None
    first, second = (pd.to_numeric(parts[k]).max() for k in (0, 2))
    if first > 12 or second > 12:
        return "dmy" if first > 12 else "mdy"
    return "dmy" if bool((parts[1] == ".").all()) else ""


def _calendar(values: np.ndarray, where: str, order: str | None = None) -> np.ndarray:
    """Nanoseconds since 1970 of calendar texts; InputError names the first that is none."""
    if order not in (None, *ORDERS):
        raise InputError(f"{where}.order={order}: must be {', '.join(ORDERS)}, or null")
    texts = pd.Series(values).astype(str).str.strip().str.replace(r"[年月](?=\d)", "-", regex=True)
    texts = texts.str.replace(r"(:\d{2})(?:,(?=\d)|:(?=\d{3}\b))", r"\1.", regex=True)
    texts = texts.str.replace("日", "", regex=False)
    texts = texts.str.replace(r"^(\d{1,2}[./]\d{1,2}[./])(\d{2})(?!\d)", r"\g<1>20\2", regex=True)
    order = day_order(texts) if order in (None, "ymd") else order
    if order == "":
        setting = where.split(", ")[-1]
        raise InputError(f"{where}: {texts.iloc[0]!r} may have day or month first; set {setting}.order=dmy or mdy")
    if order is not None:
        year, month, day = (r"\3", r"\2", r"\1") if order == "dmy" else (r"\3", r"\1", r"\2")
        texts = texts.str.replace(r"^(\d{1,2})[./-](\d{1,2})[./-](\d{4})", f"{year}-{month}-{day}", regex=True)
        texts = texts.str.replace(r"^(\d{4})-(\d)-", r"\1-0\2-", regex=True)
        texts = texts.str.replace(r"^(\d{4}-\d\d)-(\d)(?!\d)", r"\1-0\2", regex=True)
    texts = texts.str.replace(r"^(\d{4})[./](\d{1,2})[./]", r"\1-\2-", regex=True)
    try:
        stamps = pd.to_datetime(texts, utc=True, format="ISO8601")
    except ValueError:
        stamps = pd.to_datetime(texts, utc=True, format="mixed", errors="coerce", dayfirst=False)
        if bool(stamps.isna().any()):
            bad = int(np.flatnonzero(stamps.isna())[0])
            raise InputError(
                f"{where}: row {bad}: {str(values[bad])!r} is no date and time; must be like 2025-07-05T23:57:12.7Z"
            ) from None
    return stamps.dt.as_unit("ns").astype(np.int64).to_numpy()


def number(value: Any, where: str) -> float:
    """The value of a setting that must be a finite number."""
    if not is_number(value):
        raise InputError(f"{where} is {value!r}, must be a number")
    return float(value)
