"""Which column of a table has its stamps, in what unit, and from when they count."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.discovery.clock import FARTHEST_ZONE_H
from dlkf.data.discovery.units import time_unit
from dlkf.data.readers import units, vocabulary
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.mapping import TABULAR, Mapped

Spec = dict[str, Any]
NONE_NAMED: Mapping[str, Any] = MappingProxyType({})
CALENDAR = r"^\s*(\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}-[A-Za-z]{3}-\d{4}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}"
CALENDAR += r"|\d{1,2}[/.]\d{1,2}[/.]\d{2}|\d{8})"
CALENDAR += r"[T ]+\d{1,2}:\d{2}"
DAY = r"^\s*(\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[-/.]\d{1,2}[-/.]\d{4}|\d{1,2}[/.]\d{1,2}[/.]\d{2}|\d{8}"
DAY += r"|\d{4}年\d{1,2}月\d{1,2}日)\s*$"
NEWEST_UNIX = 2e9  # s: 2033; a stamp beyond it counts from no known epoch
NAMED_ZONE = r"(?:Z|UTC|GMT|[+-]\d{2}:?\d{2})\s*$"
QUARTER_S, LEAST_ZONE_S = 900, 3600  # time zones are whole quarters of an hour
SWITCHED_ON_S = 1000.0  # a log that begins with less counts from its own beginning, which is nothing to report
MOST_REPEATED = 0.5  # of the rows, which repeat the fix before where it is beside samples
XSENS_TICK = "1e-4s"
CLOCK_NAMES = {"gps": "GPS time", None: "of an unnamed clock"}  # of calendar texts; else UTC
OLDEST_UNIX = 1.0e9  # s: 2001; no log of a car with an IMU of this kind is older


def time_spec(
    table: LogTable, rows: pd.Series, slowest: float, fastest: float, named: Mapping[str, Any] = NONE_NAMED
) -> Spec | None:
    """The mapping's ``time`` for the rows of one kind, between which ``fastest`` to ``slowest`` seconds pass; of the
    settings ``named`` by the user the column and the unit count."""
    frame = table.frame[rows]
    if frame.empty:
        return None
    chosen = find_named(frame, named)
    if chosen and named.get("unit") is not None:
        return {"column": named["column"], "unit": named["unit"]}
    frame = frame[chosen] if chosen else frame
    names = [str(c) for c in frame.columns]
    called = chosen or vocabulary.match_columns(names, vocabulary.TIME)
    if (dated := _find_dates(frame, called, vocabulary.match_columns(names, vocabulary.DATE))) is not None:
        return dated
    if (pair := find_pair(frame, slowest, fastest)) is not None:
        return pair
    dates = [name for name in vocabulary.match_columns(names, vocabulary.DATE) if _counts_days(frame[name], slowest)]
    numbers = [name for name in (*called, *dates) if pd.api.types.is_numeric_dtype(frame[name])]
    column = numbers[0] if numbers else find_rising(frame)
    if column is None:
        return None
    values = frame[column].to_numpy(float)
    if _is_clock_face(values, slowest):
        dates = vocabulary.match_columns(names, vocabulary.DATE)
        date = next((n for n in dates if units.day_of_number(frame[n].iloc[0]) is not None), None)
        of_day: Spec = {"column": column, "unit": units.HHMMSS, "wraps_s": units.DAY_S}
        return of_day if date is None else of_day | {"column": [date, column], "clock": "utc"}
    if column in called and vocabulary.words(column) == "sample time fine":
        return {"column": column, "unit": XSENS_TICK, "wraps_s": 2**32 / 10_000}
    unit = time_unit(values, slowest, fastest)
    if unit is None and (days := _counts_days(frame[column], slowest)) is not None:
        return {"column": column, "unit": days, "clock": "utc"}
    if unit is None:
        return None
    spec: Spec = {"column": column, "unit": unit}
    week = vocabulary.find_column(names, "week")
    if week is not None and pd.api.types.is_numeric_dtype(frame[week]):
        return spec | {"week": week}
    clock = choose_clock(column, float(np.nanmedian(values)) / units.TIME[unit])
    return spec | ({"clock": clock} if clock else {})


def find_pair(frame: pd.DataFrame, slowest: float, fastest: float) -> Spec | None:
    """Whole seconds in one column and the rest of them in another, as ROS has them; None where no two are such."""
    pair = vocabulary.find_seconds(str(n) for n in frame if pd.api.types.is_numeric_dtype(frame[n]))
    if pair is None:
        return None
    spec: Spec = {"column": [*pair], "unit": vocabulary.find_fraction(pair[1])}
    t = read_seconds(LogTable(frame, Path(pair[0])), spec)
    steps = np.empty(0) if t is None else np.diff(t)[np.diff(t) > 0]
    if not len(steps) or not fastest <= np.median(steps) <= slowest:
        return None
    clock = choose_clock(pair[0], float(frame[pair[0]].median()))
    return spec | ({"clock": clock} if clock else {})


def find_named(frame: pd.DataFrame, named: Mapping[str, Any]) -> list[str]:
    """The columns of the stamps that a user's settings name, where a table has them all; else none."""
    column = named.get("column")
    columns = [str(c) for c in (column if isinstance(column, (list, tuple)) else [column]) if c is not None]
    return columns if {*columns} <= {*map(str, frame.columns)} else []


def find_repeated(frame: pd.DataFrame, place: list[str], clock: list[str]) -> tuple[str | None, pd.Series]:
    """Rows that repeat the fix before, and the setting ``rows`` that leaves them out, None where there are none: those
    with its stamp too, of the columns ``clock`` or by name; beside samples of an IMU, whose stamps are others, most."""
    names = [str(c) for c in frame.columns]
    same = (frame[place] == frame[place].shift()).all(axis=1)
    times = clock or vocabulary.match_columns(names, vocabulary.TIME)
    again = same & (frame[times] == frame[times].shift()).all(axis=1) if times else same & False
    if not vocabulary.find_triads(names):
        return ("once" if again.any() else None), again
    if len(frame) < 10 or same.mean() <= MOST_REPEATED:
        return None, same & False
    return ("once", again) if clock and again.mean() > MOST_REPEATED else ("changed", same)


def find_zone_s(table: LogTable, imu: Spec, gnss: Spec) -> int:
    """Time zone [s ahead of UTC] of the samples' calendar texts, by stamps of fixes in the same table in Unix time."""
    both = [imu.get("column"), gnss.get("column")]
    if imu.get("unit") != units.ISO or gnss.get("clock") != "unix" or not all(isinstance(one, str) for one in both):
        return 0
    rows = table.frame[both].notna().all(axis=1)
    if not rows.any():
        return 0
    samples, fixes = (
        Mapped(LogTable(table.frame[rows], table.path), {"time": time}, "imu").own_stamps()[0] for time in (imu, gnss)
    )
    ahead_s = float(np.median(samples - fixes))
    zone_s = QUARTER_S * round(ahead_s / QUARTER_S)
    return zone_s if LEAST_ZONE_S <= abs(zone_s) <= FARTHEST_ZONE_H * 3600 and abs(ahead_s - zone_s) < 40 else 0


def _is_clock_face(values: np.ndarray, slowest: float) -> bool:
    """Whether numbers are hours, minutes and seconds (hhmmss): over more than a minute no second is above 60."""
    good = values[np.isfinite(values)]
    if len(good) < 10 or np.ptp(good) < 100 or good.min() < 0 or good.max() >= 240_000:
        return False
    if np.median(np.diff(good)) > slowest:
        return False
    return bool(np.all(good % 100 < 61) and np.all(good // 100 % 100 < 60))


def _counts_days(column: pd.Series, slowest: float) -> str | None:
    """Whether numbers are dates in days of this century, as MATLAB's datenum or a spreadsheet has them, and which."""
    if not pd.api.types.is_numeric_dtype(column):
        return None
    values = column.to_numpy(float)
    steps = units.DAY_S * np.diff(values[np.isfinite(values)])
    if not len(steps) or not 0 < np.median(steps) <= slowest:
        return None
    unix = {name: units.DAY_S * (float(np.nanmedian(values)) - day) for name, day in units.DAYS.items()}
    return next((name for name, seconds in unix.items() if OLDEST_UNIX < seconds < NEWEST_UNIX), None)


def read_seconds(table: LogTable, time: Spec) -> np.ndarray | None:
    """The rows' times [s] from the first on, by the mapping's ``time``; None where it cannot read them all."""
    try:
        whole, part = Mapped(table, {"time": time}, "gnss").own_stamps()
    except InputError:
        return None
    return (whole - whole[0]) + (part - part[0])


def choose_clock(name: str, seconds: float) -> str | None:
    """The clock that stamps of this size count by, of two possible ones that of the column's name; None if of none."""
    possible = [clock for clock, date in _dates(seconds).items() if date is not None]
    if len(possible) == 1:
        return possible[0]
    said = [clock for clock, pattern in vocabulary.CLOCKS.items() if vocabulary.has(name, pattern)]
    known = [clock for clock in ("unix" if one == "utc" else one for one in said) if clock in possible]
    return known[0] if known else (units.clock_by_size(seconds) if possible else None)


def find_rising(frame: pd.DataFrame) -> str | None:
    """The column that rises all the way, of any name, where there is one and it does not merely count rows."""
    steps = {str(n): np.diff(frame[n].to_numpy(float)) for n in frame if pd.api.types.is_numeric_dtype(frame[n])}
    rising = [name for name, step in steps.items() if len(step) > 1 and np.all(step >= 0) and np.median(step) > 0]
    clocks = [name for name in rising if not np.all(steps[name] == 1)]
    return clocks[0] if len(clocks) == 1 else None


def _find_dates(frame: pd.DataFrame, called: list[str], dates: list[str]) -> Spec | None:
    """Calendar texts in one column, or a date and a time of day in two, by names and by what stands in them."""
    texts = {n: frame[n].astype(str) for n in frame if not pd.api.types.is_numeric_dtype(frame[n])}
    texts |= {n: frame[n].map(lambda x: f"{x:.0f}") for n in dates if n not in texts and frame[n].notna().all()}

    def fit(names: list[str], pattern: str) -> list[str]:
        return [n for n in names if n in texts and bool(texts[n].iloc[:20].str.match(pattern).all())]

    others = [str(n) for n in texts]
    whole = fit(called, CALENDAR) or fit(dates, CALENDAR) or fit(others, CALENDAR)
    days, times = fit(dates, DAY) or fit(others, DAY), fit(called, units.OF_DAY) or fit(others, units.OF_DAY)
    columns = whole[:1] or (days[:1] + times[:1] if days and times else [])
    if not columns:
        return None
    clock = "gps" if any(vocabulary.has(n, vocabulary.CLOCKS["gps"]) for n in columns) else "utc"
    spec: Spec = {"column": columns[0] if len(columns) == 1 else columns, "unit": units.ISO, "clock": clock}
    if units.day_order(texts[columns[0]]) == "":  # nothing says which: as most of the world writes it
        spec["order"] = "mdy" if bool(texts[columns[-1]].str.contains("[AaPp][Mm]").any()) else "dmy"
    return spec


def _dates(seconds: float) -> dict[str, str | None]:
    """The days that a number of seconds may mean, by the clock that it counts by."""
    unix = OLDEST_UNIX < seconds < NEWEST_UNIX
    gps = seconds > 0.6e9 and seconds + units.GPS_EPOCH_UNIX < units.now()
    return {"unix": _day(seconds) if unix else None, "gps": _day(seconds + units.GPS_EPOCH_UNIX) if gps else None}


def _day(unix: float) -> str:
    return str(np.datetime64(int(unix), "s"))[:10]


def local_time_s(gnss: Mapped, imu: Mapped) -> int:
    """Time zone [s ahead of UTC] of the fixes' calendar texts, by the offset that brings them to an IMU's Unix time; 0
    where they name a zone themselves, or the IMU's stamps have no date or are texts too."""
    texts, ahead_s = gnss.time.get("unit") == units.ISO, -float(gnss.time.get("offset_s") or 0.0)
    if not texts or imu.time.get("unit") == units.ISO or imu.first_gps_s() is None or gnss.time.get("clock") == "gps":
        return 0
    column = gnss.time["column"]
    last = gnss.texts(column[-1] if isinstance(column, list) else column)
    if bool(last.str.contains(NAMED_ZONE).any()) or gnss.first_gps_s() is None:
        return 0
    zone_s = QUARTER_S * round(ahead_s / QUARTER_S)
    return zone_s if LEAST_ZONE_S <= abs(zone_s) <= FARTHEST_ZONE_H * 3600 and abs(ahead_s - zone_s) < 40 else 0


def epoch_note(part: Mapped) -> str | None:
    """From when the stamps of a table of numbers are taken to count, and what else they may mean; None for dates and
    for formats that state it themselves."""
    if part.spec.get("format") not in TABULAR or not len(part):
        return None
    column, week = part.time.get("column"), part.time.get("week")
    columns = [str(c) for c in (column if isinstance(column, list) else [column])]
    said = _describe_epoch(part, columns, f"reader.{part.kind}.time")
    names = ", ".join([*columns, *([] if week is None else [str(week)])])
    return None if said is None else f"stamps of {part.table.path.name} ({names}): {said}"


def _describe_epoch(part: Mapped, columns: list[str], setting: str) -> str | None:
    """What the stamps in these columns are taken for; None where there is nothing to be said."""
    time = part.time
    unit = time.get("unit") or "s"
    if (time.get("week") is not None or time.get("week_number") is not None) and (first := part.first_gps_s()):
        day = _day(first + units.GPS_EPOCH_UNIX)
        return f"taken as week {int(first // units.WEEK_S)} of GPS and seconds of it, of {day}"
    if unit in units.DAYS:
        first = units.DAY_S * (float(part.column(columns[0], nan=False)[0]) - units.DAYS[unit])
        name = {"datenum": "MATLAB's datenum", "excel": "a spreadsheet's dates"}[unit]
        return f"days, taken as {name} in UTC, of {_day(first)}"
    if unit == units.HHMMSS:
        if len(columns) == 1:
            return f"taken as hours, minutes and seconds (hhmmss), which have no date; {setting}.day=… gives it"
        day = units.day_of_number(part.table.frame[columns[0]].iloc[0])
        return f"taken as hours, minutes and seconds (hhmmss) in UTC, from {day} on"
    if unit == units.ISO:
        texts = part.texts(columns[0])
        if len(columns) == 1 and bool(texts.str.match(units.OF_DAY).all()):
            undated = f"times of day, which have no date; {setting}.day=2025-07-05 gives it"
            return None if time.get("day") else undated
        other = ""
        if (order := time.get("order")) and units.day_order(texts) == "":
            swapped = {"dmy": "mdy", "mdy": "dmy"}.get(order)
            other = f", {'day' if order == 'dmy' else 'month'} first; {setting}.order={swapped} is the other reading"
        return f"dates taken as {CLOCK_NAMES.get(time.get('clock'), 'UTC')}{other}"
    return None if time.get("day") is not None else _describe_count(part, columns[-1], setting)


def _describe_count(part: Mapped, column: str, setting: str) -> str | None:
    """From when seconds in a column count, by their size."""
    unit, clock = part.time.get("unit") or "s", part.time.get("clock")
    seconds = part.first_count_s()
    known = {"unix": "unix", "utc": "unix", "gps": "gps"}.get(str(clock)) or units.clock_by_size(seconds)
    if known is None:
        counter = unit == XSENS_TICK  # runs since the device was switched on
        if part.kind != "gnss" or counter or not SWITCHED_ON_S < seconds < units.WEEK_S:
            return None
        if seconds < units.DAY_S and not vocabulary.has(column, r"\b(?:tow|sow|itow|week)\b"):
            return (
                f"seconds of a day or of a GPS week, which have no date; {setting}.day=2025-07-05 or "
                f"{setting}.week_number=… gives it"
            )
        return f"seconds of a GPS week, it seems, which have no date; {setting}.week_number=… gives the week"
    names = {"unix": "Unix time (since 1970)", "gps": "GPS seconds since 1980"}
    other, dates = "gps" if known == "unix" else "unix", _dates(seconds)
    first = _day(seconds + (units.GPS_EPOCH_UNIX if known == "gps" else 0))
    also = f"; as {names[other]} they would be of {dates[other]}: {setting}.clock={other}" if dates[other] else ""
    return f"taken as {names[known]}, of {first}{also}"
