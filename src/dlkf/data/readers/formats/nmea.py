"""NMEA 0183 logs by pynmeagps: GGA or GNS for position, RMC or VTG for speed and course, GST for the accuracy."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.readers import units
from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import LogTable
from dlkf.data.schema import POSITION, STD, VELOCITY

DAY_NS = 86_400 * 10**9
MODES = {"N": 0, "A": 1, "D": 2, "P": 2, "R": 4, "F": 5}  # of GNS, a letter a constellation; the best one counts
HEADINGS = re.compile(rb"\$[A-Z]{2}(HDT|THS),\d")
BEST = (4, 5, 2, 1, 0)


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """One row per epoch, with the contract's columns and ``utc_ns`` since 1970."""
    with path.open("rb") as stream:
        content = stream.read()
    if kind == "heading":
        return LogTable(headings(sentences(content), str(path)), path, "sentence")
    return LogTable(fixes(sentences(content), str(path)), path, "fix")


def aids(path: Path) -> tuple[str, ...]:
    """Which further sensors a log has: heading."""
    return ("heading",) if HEADINGS.search(path.read_bytes()) else ()


def headings(messages: Iterator[Any], where: str) -> pd.DataFrame:
    """HDT and THS, which have no time: each is of the sentence with one before it."""
    rows: list[dict[str, Any]] = []
    day: int | None = None
    of_day: int | None = None
    for m in messages:
        if m.msgID in ("RMC", "ZDA"):
            day = _day(m) or day
        of_day = of_day if (stamp := _day_ns(getattr(m, "time", None))) is None else stamp
        if m.msgID not in ("HDT", "THS") or of_day is None or getattr(m, "mi", "A") not in ("A", "E"):
            continue
        angle = _float(getattr(m, "headingT", getattr(m, "headt", "")))
        if np.isfinite(angle) and not (rows and rows[-1]["of_day"] == of_day):
            rows.append({"of_day": of_day, "date": day, "heading_deg": angle})
    frame = pd.DataFrame(rows)
    if frame.empty or frame["date"].isna().all():
        raise InputError(f"{where}: has no HDT or THS sentence with a date (RMC or ZDA); set reader.heading.file=null")
    frame["utc_ns"] = _stamps(frame["of_day"].to_numpy(np.int64), frame["date"])
    return frame[["utc_ns", "heading_deg"]]


def sentences(content: bytes) -> Iterator[Any]:
    """The sentences in a log, with everything else left out."""
    pynmeagps = library("pynmeagps", "an NMEA log")
    for line in content.splitlines():
        start = line.find(b"$")
        if start < 0:
            continue
        reader = pynmeagps.NMEAReader(
            io.BytesIO(line[start:].strip() + b"\r\n"), quitonerror=pynmeagps.ERR_IGNORE, nmeaonly=False
        )
        _, message = next(iter(reader), (None, None))
        if message is not None:
            yield message


def fixes(messages: Iterator[Any], where: str) -> pd.DataFrame:
    """Epochs of equal time of day, with the date of RMC or ZDA."""
    rows: list[dict[str, Any]] = []
    day: int | None = None  # nanoseconds of its beginning
    seen: str | None = None
    for m in messages:
        time = getattr(m, "time", None)
        stamp = _day_ns(time)
        if m.msgID in ("RMC", "ZDA"):
            day = _day(m) or day
        if m.msgID == "VTG":  # carries no time: it belongs to the epoch that is open
            if rows and "vel_n" not in rows[-1]:
                _set_velocity(rows[-1], m.sogn, m.cogt)
            continue
        if m.msgID not in ("GGA", "RMC", "GST", "GNS") or stamp is None:
            continue
        seen = m.msgID
        if not rows or rows[-1]["of_day"] != stamp:
            rows.append({"of_day": stamp})
        row = rows[-1]
        row["date"] = day
        if m.msgID == "GGA" or (m.msgID == "GNS" and "lat_deg" not in row):
            if m.lat not in ("", None):
                row |= {"lat_deg": m.lat, "lon_deg": m.lon, "quality": _quality(m)}
                row["height_m"] = _float(m.alt) + np.nan_to_num(_float(m.sep))
        elif m.msgID == "RMC":
            _set_velocity(row, m.spd, m.cog)
        elif m.msgID == "GST":
            row |= dict(zip(STD[:3], (_float(m.stdLat), _float(m.stdLong), _float(m.stdAlt))))
    if seen is None:
        raise InputError(f"{where}: has no GGA, GNS, RMC or GST sentence; give an NMEA log")
    frame = pd.DataFrame(rows)
    if "lat_deg" not in frame:
        raise InputError(f"{where}: has no GGA or GNS sentence with a position; log GGA beside RMC")
    if frame["date"].isna().all():
        raise InputError(
            f"{where}: has no date (RMC or ZDA); log RMC beside GGA or GNS, or put a ZDA sentence of that day in front"
        )
    frame["quality"] = frame["quality"].fillna(0)
    frame["utc_ns"] = _stamps(frame["of_day"].to_numpy(np.int64), frame["date"])
    return frame.reindex(columns=["utc_ns", *POSITION, *VELOCITY, *STD, "quality"])


def _quality(m: Any) -> int:
    """NMEA GGA code of a GGA, or of the best constellation of a GNS."""
    if m.msgID == "GGA":
        return int(m.quality or 0)
    codes = {MODES.get(letter, 0) for letter in str(m.posMode)} | {0}
    return next(code for code in BEST if code in codes)


def _stamps(of_day: np.ndarray, day: pd.Series) -> np.ndarray:
    """Time of day on the day of the last new date, counted on at each midnight since: a receiver may tell the date
    some rows after midnight, and a log may hold several recordings. Rows before the first date count back from it."""
    turns = np.concatenate(([0], np.cumsum(np.diff(of_day) < -DAY_NS // 2)))
    days = day.bfill().ffill().to_numpy(np.int64)
    new = np.flatnonzero(np.diff(days, prepend=days[0] - 1))
    known = np.where(new == 0, int(day.notna().argmax()), new)  # the row at which a date was read
    last = np.searchsorted(new, np.arange(len(days)), side="right") - 1
    return days + (turns - turns[known[last]]) * DAY_NS + of_day


def _set_velocity(row: dict[str, Any], knots: Any, course: Any) -> None:
    speed, angle = _float(knots) * units.SPEED["knots"], _float(course)
    if np.isnan(speed):
        return
    if np.isnan(angle):  # receivers leave the course empty at rest
        if speed > 0.3:
            return
        angle = 0.0
    row["vel_n"], row["vel_e"] = speed * np.cos(np.radians(angle)), speed * np.sin(np.radians(angle))


def _day_ns(time: Any) -> int | None:
    if not hasattr(time, "hour"):
        return None
    return ((time.hour * 60 + time.minute) * 60 + time.second) * 10**9 + time.microsecond * 1000


def _day(m: Any) -> int | None:
    try:
        day = date(int(m.year), int(m.month), int(m.day)) if m.msgID == "ZDA" else m.date
        return int(np.datetime64(day.isoformat(), "ns").astype(np.int64))
    except (AttributeError, TypeError, ValueError):  # empty cells
        return None


def _float(value: Any) -> float:
    return float("nan") if value in ("", None) else float(value)
