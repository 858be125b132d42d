"""NovAtel's texts: exports of Inertial Explorer, and ASCII logs of OEM receivers (#BESTPOSA, %RAWIMUSA, …).

An export keeps the names of its own header; a latitude in degrees, minutes and seconds becomes degrees, dates become
GPS weeks. Of the logs,
fixes have the contract's columns (BESTPOS with BESTVEL), INSPVA those of a reference, and an IMU's counts the names
``accel_x`` … ``gyro_z`` in counts, whose unit depends on the IMU. All have ``week`` and ``sow``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.readers import units
from dlkf.data.readers.formats.text import decode_text, make_frame
from dlkf.data.readers.frames import LogTable
from dlkf.data.schema import POSITION, STD, VELOCITY

LOG = re.compile(r"^[#%](\w+?)A?,([^;]*);(.*?)(\*[0-9a-fA-F]{8})?$")
IMUS = ("RAWIMUS", "RAWIMU", "RAWIMUSX", "RAWIMUX")
COMPUTED = "SOL_COMPUTED"
EXACT_S = 1e-3  # between the times of a velocity and of a position that are the same
LONGEST_STEP = 1.5  # usual ones between velocities that are interpolated
Rows = list[tuple[int, float, list[str]]]  # of a log: week, seconds of the week, cells
SIZES = {"RAWIMUSX": 2, "RAWIMUX": 2}  # IMU info and type stand before week and seconds


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """An export's table, or the logs of a ``kind``; ``table`` names the IMU's log, or INSPVA."""
    lines = decode_text(path, None).splitlines()
    if any(LOG.match(line) for line in lines[:200]):
        return _logs(lines, path, kind, table)
    return _export(lines, path)


def _export(lines: list[str], path: Path) -> LogTable:
    heads = [k for k, line in enumerate(lines) if re.search(r"\b(GPSTime|UTCTime|Latitude)\b", line)]
    if not heads or heads[0] + 2 >= len(lines):
        raise InputError(f"{path}: has no header with GPSTime or Latitude; export it with headers")
    names = lines[heads[0]].split()
    marks = _marks(lines[heads[0]], lines[heads[0] + 1])
    first = heads[0] + (2 if any(marks) else 1)
    rows = [(k + 1, line.split()) for k, line in enumerate(lines) if k >= first and line.strip()]
    widths = [3 if "D M S" in m else 1 for m in marks]
    cells, notes = make_frame(rows, sum(widths), path, f"not the {sum(widths)} cells that the header names")
    out, at = {}, 0
    for name, width in zip(names, widths):
        part = cells.iloc[:, at : at + width]
        if width == 3:
            out[name] = units.degrees_minutes_seconds(part)
        else:
            numbers = pd.to_numeric(part.iloc[:, 0], errors="coerce")
            out[name] = part.iloc[:, 0].to_numpy() if bool(numbers.isna().any()) else numbers.to_numpy()
        at += width
    out |= _weeks(out, dict(zip(names, marks)), str(path))
    return LogTable(pd.DataFrame(out, index=cells.index), path, "line", notes)


def _marks(names: str, units_of_them: str) -> list[str]:
    """The unit of each name, ``""`` where it has none: in their order, or those that stand under the names."""
    heads = [(m.start() + m.end(), m[0]) for m in re.finditer(r"\S+", names)]
    below = [(m.start() + m.end(), m[0]) for m in re.finditer(r"\([^)]*\)", units_of_them)]
    if len(below) == len(heads):
        return [mark for _, mark in below]
    marks = [""] * len(heads)
    for place, mark in below:
        marks[min(range(len(heads)), key=lambda k: abs(heads[k][0] - place))] = mark
    return marks


def _weeks(columns: Mapping[str, Any], marks: Mapping[str, str], where: str) -> dict[str, Any]:
    """``Week`` and ``GPSTime`` [s of the week] of an export that has dates instead: of UTC, or of GPS time.

    A date beside seconds of GPSTime gives their week; a time of day is HMS, or seconds of UTCTime.
    """
    date = next((n for n in ("GPSDate", "UTCDate", "Date") if n in columns), None)
    if "Week" in columns or date is None:
        return {}
    day = _days(pd.Series(columns[date]).astype(str), marks.get(date, ""), f"{where}: {date}")
    times = ("UTCTime", "GPSTime") if date == "UTCDate" else ("GPSTime", "UTCTime")
    time = next((n for n in times if n in columns), None)
    if time is None:
        raise InputError(f"{where}: has {date} and neither UTCTime nor GPSTime beside it; export one of them")
    texts = pd.Series(columns[time]).astype(str)
    clock = bool(texts.str.contains(":").all())
    if clock:
        of_day = texts.str.split(":", expand=True).apply(pd.to_numeric, errors="coerce").to_numpy() @ [3600, 60, 1]
    else:
        of_day = pd.to_numeric(texts, errors="coerce").to_numpy()
    if not np.isfinite(of_day).all():
        raise InputError(f"{where}: {time} has {texts[~np.isfinite(of_day)].iloc[0]!r}, must be seconds or H:M:S")
    if time == "GPSTime" and not clock:
        week = np.round((day - units.GPS_EPOCH_UNIX + 43_200 - of_day) / units.WEEK_S).astype(np.int64)
        return {"Week": week}
    whole = day + np.floor(of_day).astype(np.int64)
    gps = units.gps_seconds(whole) if time == "UTCTime" else whole - units.GPS_EPOCH_UNIX
    return {"Week": gps // units.WEEK_S, "GPSTime": gps % units.WEEK_S + of_day % 1}


def _days(texts: pd.Series, mark: str, where: str) -> np.ndarray:
    """Unix times of the days 11/14/2019 (MDY), 14/11/2019 (DMY), 2019/11/14 (YMD)."""
    parts = texts.str.split(r"[/.-]", expand=True).apply(pd.to_numeric, errors="coerce")
    if parts.shape[1] != 3 or bool(parts.isna().any(axis=None)):
        raise InputError(f"{where} has {texts.iloc[0]!r}, must be a date such as 11/14/2019")
    order = mark.strip("()").upper()
    if order not in ("MDY", "DMY", "YMD"):
        order = {None: "YMD", "dmy": "DMY", "mdy": "MDY"}.get(units.day_order(texts))
    if order is None:
        raise InputError(f"{where}: {texts.iloc[0]} may be day or month first; export it with its unit (MDY) or (DMY)")
    named = {name: parts[order.index(letter)] for name, letter in (("year", "Y"), ("month", "M"), ("day", "D"))}
    days = pd.to_datetime(pd.DataFrame(named), errors="coerce")
    if bool(days.isna().any()):
        raise InputError(f"{where} has {texts[days.isna()].iloc[0]!r}, which is no day ({order})")
    return days.to_numpy().astype("datetime64[s]").astype(np.int64)


def _logs(lines: list[str], path: Path, kind: str, table: str | None) -> LogTable:
    logs, notes = _rows_by_log(lines, path)
    have = ", ".join(f"{name} ({len(rows)})" for name, rows in logs.items())
    if kind == "imu":
        name = table or next((n for n in IMUS if n in logs), None)
        if name is None or name not in logs:
            raise InputError(f"{path}: no log {name or ', '.join(IMUS)}; has {have}; set reader.imu.table")
        return LogTable(_imu(logs[name], SIZES.get(name, 0)), path, "log", notes)
    if table == "INSPVA" or (kind == "reference" and "INSPVA" in logs):
        return LogTable(_inspva(logs.get("INSPVA") or _refuse_absent(path, "INSPVA", have)), path, "log", notes)
    positions = logs.get("BESTPOS") or _refuse_absent(path, "BESTPOS", have)
    fixes, late_s = _join_best(positions, logs.get("BESTVEL", []))
    said = f"velocities are up to {late_s:.3g} s older than their stamps (latency of BESTVEL) and were interpolated to"
    late = (f"{said} those of the positions",) if late_s > EXACT_S else ()
    return LogTable(fixes, path, "log", (*notes, *late))


def _rows_by_log(lines: list[str], path: Path) -> tuple[dict[str, Rows], tuple[str, ...]]:
    """The rows of each log, and a note on lines that are left out: with a damaged header, without the checksum that
    others have, or with fewer cells than most of their log."""
    found = [match for line in lines if (match := LOG.match(line))]
    checked = any(match[4] for match in found)
    logs: dict[str, Rows] = {}
    for match in found:
        header = match[2].split(",")
        with suppress(IndexError, ValueError):
            week, sow = header[:2] if match[0].startswith("%") else (header[4], header[5])
            if match[4] or not checked:
                logs.setdefault(match[1], []).append((int(week), float(sow), match[3].split(",")))
    for name, rows in logs.items():
        usual = Counter(len(cells) for *_, cells in rows).most_common(1)[0][0]
        logs[name] = [row for row in rows if len(row[2]) >= usual]
    damaged = len(found) - sum(map(len, logs.values()))
    return logs, (f"{path.name}: {damaged} damaged or cut line{'s' * (damaged > 1)} left out",) if damaged else ()


def _refuse_absent(path: Path, name: str, have: str) -> Any:
    raise InputError(f"{path}: has no log {name}; has {have}")


def _imu(rows: list[tuple[int, float, list[str]]], skip: int) -> pd.DataFrame:
    """RAWIMU: z, −y, x of the accelerometers, then of the gyroscopes, as counts gained since the sample before."""
    values = np.array([[float(c) for c in cells[skip + 3 : skip + 9]] for _, _, cells in rows])
    signs = {"x": (2, 1), "y": (1, -1), "z": (0, 1)}
    out: dict[str, Any] = {
        "week": [int(cells[skip]) for _, _, cells in rows],
        "sow": [float(cells[skip + 1]) for _, _, cells in rows],
    }
    for axis, (k, sign) in signs.items():
        out[f"accel_{axis}"], out[f"gyro_{axis}"] = sign * values[:, k], sign * values[:, 3 + k]
    return pd.DataFrame(out)


def _join_best(positions: Rows, speeds: Rows) -> tuple[pd.DataFrame, float]:
    """BESTPOS (height above sea level and undulation), with the velocities at its times; the largest latency [s]."""
    rows = []
    for week, sow, c in positions:
        llh = (float(c[2]), float(c[3]), float(c[4]) + float(c[5]))
        row: dict[str, Any] = {"week": week, "sow": sow, **dict(zip(POSITION, llh))}
        row |= dict.fromkeys(STD, np.nan) | dict(zip(STD[:3], (float(c[7]), float(c[8]), float(c[9]))))
        rows.append(row | {"quality": _quality(c[1]) if c[0] == COMPUTED else 0})
    at = np.array([week * units.WEEK_S + sow for week, sow, _ in positions])
    velocities, late_s = _velocities(speeds, at)
    return pd.DataFrame(rows).assign(**dict(zip(VELOCITY, velocities.T))), late_s


def _velocities(speeds: Rows, at: np.ndarray) -> tuple[np.ndarray, float]:
    """North, East, Down of the BESTVEL at GPS times ``at``, NaN where one is missing, and the largest latency [s].

    A velocity is that of its stamp less its latency (OEM7 manual, BESTVEL): a Doppler is the mean over the interval
    before.
    """
    known = [(week * units.WEEK_S + sow, *map(float, (c[2], *c[4:7]))) for week, sow, c in speeds if c[0] == COMPUTED]
    if not known:
        return np.full((len(at), 3), np.nan), 0.0
    stamp, late, speed, course, up = np.array(known).T
    t = stamp - late
    order = np.argsort(t, kind="stable")
    t, angle = t[order], np.radians(course[order])
    v = np.stack((speed[order] * np.cos(angle), speed[order] * np.sin(angle), -up[order]), -1)
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    after = np.clip(np.searchsorted(t, at - EXACT_S), 0, len(t) - 1)
    before = np.maximum(after - (t[after] > at + EXACT_S), 0)
    exact = np.abs(t[after] - at) <= EXACT_S
    between = (t[before] <= at) & (at <= t[after]) & (t[after] - t[before] <= LONGEST_STEP * usual)
    along = np.stack([np.interp(at, t, one) for one in v.T], -1)
    out = np.where(exact[:, None], v[after], np.where(between[:, None], along, np.nan))
    return out, float(late.max())


def _inspva(rows: list[tuple[int, float, list[str]]]) -> pd.DataFrame:
    out = []
    for _, _, c in rows:
        lat, lon, height, north, east, up, roll, pitch, azimuth = (float(x) for x in c[2:11])
        row = {"week": int(c[0]), "sow": float(c[1]), **dict(zip(POSITION, (lat, lon, height)))}
        row |= dict(zip(VELOCITY, (north, east, -up))) | {"roll": roll, "pitch": pitch, "yaw": azimuth}
        out.append(row | {"valid": float(c[11].startswith("INS_SOLUTION_GOOD")), "quality": 1})
    return pd.DataFrame(out)


def _quality(kind: str) -> int:
    """NMEA GGA code of a position type."""
    if kind == "NONE":
        return 0
    if kind.endswith(("_INT", "RTKFIXED")):
        return 4
    if kind.endswith(("_FLOAT", "RTKFLOAT")):
        return 5
    return 1 if kind in ("SINGLE", "INS_PSRSP", "INS_SBAS") or "PROPAGATED" in kind else 2
