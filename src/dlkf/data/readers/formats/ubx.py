"""u-blox UBX logs by pyubx2: fixes from NAV-PVT, NAV-HPPOSLLH and NAV-COV, an IMU from ESF-RAW or ESF-MEAS, speed or
ticks of wheels from these too, heading from NAV-RELPOSNED.

Both tables have the contract's columns. Stamps are nanoseconds of GPS time: of a fix its iTOW with the week of its
date; of an IMU sample the sensor's own time tags, brought to iTOW by the time tags' rate (least squares) and the
earliest arrival between fixes. A constant latency of the IMU remains: ``reader.imu.time.offset_s=auto`` measures it.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.units import DEG, WEEK_S, gps_seconds
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY

# dataType of ESF-MEAS and ESF-RAW: contract column, SI per step (u-blox F9 interface description, "External sensor")
SENSORS = {
    14: ("gyro_x", DEG * 2.0**-12),
    13: ("gyro_y", DEG * 2.0**-12),
    5: ("gyro_z", DEG * 2.0**-12),
    16: ("accel_x", 2.0**-10),
    17: ("accel_y", 2.0**-10),
    18: ("accel_z", 2.0**-10),
}
SPEED = (11,)  # mm/s
TICKS = ((8, 9), (10,), (6, 7))  # rear left and right, single, front
BACKWARD = 1 << 23  # of ticks, whose count has the bits below
FEWEST = 10
MESSAGES = ("ESF-RAW", "ESF-MEAS")
AIDS = {
    "speed": "speed or ticks of wheels in ESF-MEAS", "heading": "NAV-RELPOSNED with a valid heading",
    "baro": "pressure or height of a barometer",
}  # fmt: skip
TAG_WRAP = 2**32
SYNC = b"\xb5b"  # every message begins so


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """Fixes (``kind`` gnss or reference), IMU samples, wheels or headings of a log; ``table`` ESF-RAW or ESF-MEAS
    chooses the IMU."""
    messages, left = _messages(path, path.stat().st_mtime_ns)
    notes = (f"{path.name}: the last message is cut off or damaged: {left} bytes left out",) if left else ()
    cut = f"; its last {left} bytes are a message cut off, so copy the log again" if left else ""
    fixes = _fixes(messages)
    if not len(fixes):
        raise InputError(f"{path}: has no NAV-PVT message; log UBX-NAV-PVT, or give GNSS from another file{cut}")
    if kind in ("gnss", "reference"):
        return LogTable(fixes, path, "fix", notes=notes)
    wanted = (table,) if table else MESSAGES
    if len(found := _find_table(messages, kind, wanted)):
        return LogTable(found, path, "sample" if kind == "imu" else "message", notes=notes)
    if kind == "imu":
        have = ", ".join(sorted({m.identity for m in messages}))
        remedy = f"has {have}; set reader.imu.format and file{cut}"
        raise InputError(f"{path}: has no IMU in {' or '.join(wanted)}; {remedy}")
    raise InputError(f"{path}: has no {AIDS[kind]}; set reader.{kind}.file=null")


def aids(path: Path) -> tuple[str, ...]:
    """Which further sensors a log has: speed, heading."""
    messages, _ = _messages(path, path.stat().st_mtime_ns)
    return tuple(kind for kind in ("speed", "heading") if len(_find_table(messages, kind, MESSAGES)))


def _find_table(messages: list[Any], kind: str, names: Iterable[str]) -> pd.DataFrame:
    """Of headings, or of the first of the IMU's messages that has wheels or samples; empty where none has."""
    if kind == "heading":
        return _headings(messages)
    make = {"imu": _samples, "speed": _wheels}.get(kind)
    tables = (make(messages, name) for name in names) if make else ()
    return next((table for table in tables if len(table)), pd.DataFrame())


@lru_cache(maxsize=1)  # the IMU, the fixes and the wheels of a log are read one after the other
def _messages(path: Path, changed: int) -> tuple[list[Any], int]:
    """The messages of use, and how many bytes at the end belong to one that is cut off or damaged."""
    pyubx2 = library("pyubx2", "a UBX log")
    found, end = [], 0
    with path.open("rb") as stream:
        reader = pyubx2.UBXReader(
            stream, protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_IGNORE, validate=pyubx2.VALCKSUM
        )
        while True:
            try:
                raw, message = reader.read()
            except (ValueError, TypeError, KeyError, IndexError, struct.error):  # UBX is not all that looks like it
                continue
            if raw is None:
                break
            end = stream.tell()
            if message is not None and getattr(message, "identity", "").startswith(("NAV-", "ESF-")):
                found.append(message)
        stream.seek(end)
        rest = stream.read()
    return found, len(rest) if rest.startswith(SYNC) else 0


def _fixes(messages: list[Any]) -> pd.DataFrame:
    """NAV-PVT, with the digits of NAV-HPPOSLLH and the standard deviations of NAV-COV of the same time."""
    rows: dict[int, dict[str, float]] = {}
    stamped = list(_stamps(messages))
    fine = {stamp: m for stamp, m in stamped if m.identity == "NAV-HPPOSLLH" and not m.invalidLlh}
    spread = {stamp: m for stamp, m in stamped if m.identity == "NAV-COV"}
    for stamp, m in stamped:
        if m.identity != "NAV-PVT" or not (m.validDate and m.validTime):
            continue
        position = (m.lat, m.lon, m.height / 1000)
        if (hp := fine.get(stamp)) is not None:  # pyubx2 scales: degrees, mm, the high-precision part added
            position = (hp.lat, hp.lon, hp.height / 1000)
        std_n = std_e = m.hAcc / 1000 / np.sqrt(2)
        stds = [std_n, std_e, m.vAcc / 1000, *[m.sAcc / 1000 / np.sqrt(3)] * 3]
        if (cov := spread.get(stamp)) is not None and cov.posCovValid:
            stds[:3] = [float(np.sqrt(max(x, 0.0))) for x in (cov.posCovNN, cov.posCovEE, cov.posCovDD)]
            if cov.velCovValid:
                stds[3:] = [float(np.sqrt(max(x, 0.0))) for x in (cov.velCovNN, cov.velCovEE, cov.velCovDD)]
        row: dict[str, float] = dict(zip(POSITION, position))
        row |= dict(zip(VELOCITY, (m.velN / 1000, m.velE / 1000, m.velD / 1000)))
        row |= dict(zip(STD, stds)) | {"t_ns": stamp, "quality": _quality(m)}
        rows[stamp] = row
    return pd.DataFrame(list(rows.values()))


def _stamps(messages: list[Any]) -> Iterator[tuple[int, Any]]:
    """Messages with an iTOW and their GPS nanoseconds, in the week of the last NAV-PVT with a date, at the beginning
    of the first."""
    weeks = [_week(m) if m.identity == "NAV-PVT" else None for m in messages]
    week = next((found for found in weeks if found is not None), None)
    for m, found in zip(messages, weeks):
        week = week if found is None else found
        if week is not None and hasattr(m, "iTOW"):
            yield (week * WEEK_S * 1000 + m.iTOW) * 10**6, m


def _week(m: Any) -> int | None:
    """GPS week of a NAV-PVT by its date; None where that is not valid."""
    if not (m.validDate and m.validTime and 1980 <= m.year < 2100):
        return None
    try:
        date = np.datetime64(f"{m.year:04d}-{m.month:02d}-{m.day:02d}T{m.hour:02d}:{m.min:02d}:{min(m.second, 59):02d}")
    except ValueError:
        return None
    gps = int(gps_seconds(date.astype("datetime64[s]").astype(np.int64)))
    return round((gps - m.iTOW / 1000) / WEEK_S)


def _quality(m: Any) -> int:
    """NMEA GGA code: RTK from carrSoln, corrections from diffSoln; dead reckoning alone (fixType 1) is no fix."""
    if not m.gnssFixOk or m.fixType not in (2, 3, 4):
        return 0
    return {2: 4, 1: 5}.get(m.carrSoln, 2 if m.diffSoln else 1)


def _samples(messages: list[Any], name: str) -> pd.DataFrame:
    """IMU samples: values of one time tag, where all six axes are there."""
    stamps, values = _collect_complete(messages, name, SENSORS)
    columns = {c: step * _to_signed(x) for (c, step), x in zip(SENSORS.values(), values.T)}
    return pd.DataFrame(columns)[[*GYRO, *ACCEL]].assign(t_ns=stamps)


def _wheels(messages: list[Any], name: str) -> pd.DataFrame:
    """Speed [m/s] of the car's own sensor, else ticks counted on: the mean of the rear wheels, the single tick, the
    mean of the front ones, whichever there is."""
    for kinds in (SPEED, *TICKS):
        stamps, values = _collect_complete(messages, name, kinds)
        if not len(stamps):
            continue
        if kinds == SPEED:
            return pd.DataFrame({"t_ns": stamps, "speed": 1e-3 * _to_signed(values[:, 0])})
        backward, count = values & BACKWARD > 0, values & (BACKWARD - 1)
        step = np.diff(count, axis=0, prepend=count[:1])
        step = (step + BACKWARD // 2) % BACKWARD - BACKWARD // 2
        moved = np.where(backward, -np.abs(step), np.abs(step))
        return pd.DataFrame({"t_ns": stamps, "ticks": np.cumsum(moved, axis=0).mean(1)})
    return pd.DataFrame()


def _headings(messages: list[Any]) -> pd.DataFrame:
    """NAV-RELPOSNED of a moving base, where its heading is valid."""
    return pd.DataFrame(
        {"t_ns": stamp, "heading_deg": m.relPosHeading, "std_deg": m.accHeading}
        for stamp, m in _stamps(messages)
        if m.identity == "NAV-RELPOSNED" and getattr(m, "relPosHeadingValid", 0)
    )


def _collect_complete(messages: list[Any], name: str, kinds: Collection[int]) -> tuple[np.ndarray, np.ndarray]:
    """GPS nanoseconds (n,) and values (n, kinds) of the time tags that have a value of every data type; none where
    these are fewer than ``FEWEST``.

    Of every tag the GPS time of the last fix before its message tells when it arrived.
    """
    tags: dict[int, dict[int, int]] = {}
    arrived: dict[int, int] = {}
    now, last, turns = None, None, 0
    for m in messages:
        if m.identity == "NAV-PVT" and (week := _week(m)) is not None:
            now = (week * WEEK_S * 1000 + m.iTOW) * 10**6
        if m.identity != name or now is None:
            continue
        for value, sensor, tag in _values(m, name):
            if sensor not in kinds:
                continue
            turns += last is not None and tag < last - TAG_WRAP // 2
            last = tag
            tags.setdefault(tag + turns * TAG_WRAP, {})[sensor] = value
            arrived[tag + turns * TAG_WRAP] = now
    at = sorted(tag for tag, values in tags.items() if len(values) == len(kinds))
    if len(at) < FEWEST:
        return np.zeros(0, np.int64), np.zeros((0, len(kinds)), np.int64)
    values = np.array([[tags[tag][k] for k in kinds] for tag in at])
    return _fit_gps_time(np.array(at), np.array([arrived[tag] for tag in at])), values


def _values(m: Any, name: str) -> Iterator[tuple[int, int, int]]:
    """(field, type, time tag) of a message's groups: 24 bits of value, then the type."""
    k = 1
    if name == "ESF-RAW":
        while hasattr(m, f"data_{k:02d}"):
            word = int.from_bytes(getattr(m, f"data_{k:02d}"), "little")
            yield word & 0xFFFFFF, word >> 24, int.from_bytes(getattr(m, f"sTag_{k:02d}"), "little")
            k += 1
    while hasattr(m, f"dataType_{k:02d}"):
        yield getattr(m, f"dataField_{k:02d}"), getattr(m, f"dataType_{k:02d}"), m.timeTag
        k += 1


def _to_signed(values: np.ndarray) -> np.ndarray:
    """24 bits, two's complement."""
    return ((values & 0xFFFFFF) ^ (1 << 23)) - (1 << 23)


def _fit_gps_time(tags: np.ndarray, after: np.ndarray) -> np.ndarray:
    """GPS nanoseconds of time tags, each of which came ``after`` a fix's time: the tags' rate by least squares.

    A tag of a millisecond or its like is taken as such. The first sample after a fix is taken to be of the fix's time
    (the earliest tenth of them), which is late by the receiver's latency and early by up to a sample.
    """
    x, y = (tags - tags[0]).astype(float), (after - after[0]) / 1e9
    rate = float(np.polyfit(x, y, 1)[0]) if np.ptp(y) > 0 else 1e-3
    if abs(rate / 1e-3 - 1) < 0.02:
        rate = 1e-3
    lag = x * rate - y
    firsts = lag[np.flatnonzero(np.diff(after, prepend=after[0] - 1) > 0)]
    return after[0] + np.round((x * rate - np.quantile(firsts, 0.1)) * 1e9).astype(np.int64)
