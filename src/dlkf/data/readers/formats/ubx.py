"""u-blox UBX logs by pyubx2: fixes from NAV-PVT, NAV-HPPOSLLH and NAV-COV, an IMU from ESF-RAW or ESF-MEAS.

Both tables have the contract's columns. Stamps are nanoseconds of GPS time: of a fix its iTOW with the week of its
date; of an IMU sample the sensor's own time tags, brought to iTOW by the time tags' rate (least squares) and the
earliest arrival between fixes. A constant latency of the IMU remains: ``reader.imu.time.offset_s=auto`` measures it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import Table
from dlkf.data.readers.units import DEG, GPS_EPOCH_UNIX, WEEK_S, leap_seconds
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.errors import InputError

# dataType of ESF-MEAS and ESF-RAW: contract column, SI per step (u-blox F9 interface description, "External sensor")
SENSORS = {
    14: ("gyro_x", DEG * 2.0**-12),
    13: ("gyro_y", DEG * 2.0**-12),
    5: ("gyro_z", DEG * 2.0**-12),
    16: ("accel_x", 2.0**-10),
    17: ("accel_y", 2.0**-10),
    18: ("accel_z", 2.0**-10),
}
TAG_WRAP = 2**32
SYNC = b"\xb5b"  # every message begins so


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> Table:
    """Fixes (``kind`` gnss or reference) or IMU samples of a log; ``table`` ESF-RAW or ESF-MEAS chooses the IMU."""
    messages, left = _messages(path)
    notes = (f"{path.name}: the last message is cut off or damaged: {left} bytes left out",) if left else ()
    cut = f"; its last {left} bytes are a message cut off, so copy the log again" if left else ""
    fixes = _fixes(messages)
    if not len(fixes):
        raise InputError(f"{path}: has no NAV-PVT message; log UBX-NAV-PVT, or give GNSS from another file{cut}")
    if kind != "imu":
        return Table(fixes, path, "fix", notes=notes)
    wanted = [table] if table else ["ESF-RAW", "ESF-MEAS"]
    for name in wanted:
        samples = _samples(messages, name)
        if len(samples):
            return Table(samples, path, "sample", notes=notes)
    have = ", ".join(sorted({m.identity for m in messages}))
    raise InputError(f"{path}: has no IMU in {' or '.join(wanted)}; has {have}; set reader.imu.format and file{cut}")


def _messages(path: Path) -> tuple[list[Any], int]:
    """The messages of use, and how many bytes at the end belong to one that is cut off or damaged."""
    pyubx2 = library("pyubx2", "a UBX log")
    found, end = [], 0
    with path.open("rb") as stream:
        for raw, message in pyubx2.UBXReader(
            stream, protfilter=pyubx2.UBX_PROTOCOL, quitonerror=pyubx2.ERR_IGNORE, validate=pyubx2.VALCKSUM
        ):
            if raw is not None:
                end = stream.tell()
            if message is not None and getattr(message, "identity", "").startswith(("NAV-", "ESF-")):
                found.append(message)
        stream.seek(end)
        rest = stream.read()
    return found, len(rest) if rest.startswith(SYNC) else 0


def _fixes(messages: list[Any]) -> pd.DataFrame:
    """NAV-PVT, with the digits of NAV-HPPOSLLH and the standard deviations of NAV-COV of the same iTOW."""
    rows: dict[int, dict[str, float]] = {}
    fine = {m.iTOW: m for m in messages if m.identity == "NAV-HPPOSLLH" and not m.invalidLlh}
    spread = {m.iTOW: m for m in messages if m.identity == "NAV-COV"}
    for m in messages:
        if m.identity != "NAV-PVT" or not (m.validDate and m.validTime):
            continue
        position = (m.lat, m.lon, m.height / 1000)
        if (hp := fine.get(m.iTOW)) is not None:  # pyubx2 scales: degrees, mm, the high-precision part added
            position = (hp.lat, hp.lon, hp.height / 1000)
        std_n = std_e = m.hAcc / 1000 / np.sqrt(2)
        stds = [std_n, std_e, m.vAcc / 1000, *[m.sAcc / 1000 / np.sqrt(3)] * 3]
        if (cov := spread.get(m.iTOW)) is not None and cov.posCovValid:
            stds[:3] = [float(np.sqrt(max(x, 0.0))) for x in (cov.posCovNN, cov.posCovEE, cov.posCovDD)]
            if cov.velCovValid:
                stds[3:] = [float(np.sqrt(max(x, 0.0))) for x in (cov.velCovNN, cov.velCovEE, cov.velCovDD)]
        row: dict[str, float] = dict(zip(POSITION, position))
        row |= dict(zip(VELOCITY, (m.velN / 1000, m.velE / 1000, m.velD / 1000)))
        row |= dict(zip(STD, stds)) | {"t_ns": _gps_ns(m), "quality": _quality(m)}
        rows[m.iTOW] = row
    return pd.DataFrame(list(rows.values()))


def _gps_ns(m: Any) -> int:
    """GPS time of a NAV-PVT: iTOW in the week of its date."""
    date = np.datetime64(f"{m.year:04d}-{m.month:02d}-{m.day:02d}T{m.hour:02d}:{m.min:02d}:{min(m.second, 59):02d}")
    unix = int(date.astype("datetime64[s]").astype(np.int64))
    gps = unix - GPS_EPOCH_UNIX + int(leap_seconds(unix))
    week = round((gps - m.iTOW / 1000) / WEEK_S)
    return week * WEEK_S * 10**9 + m.iTOW * 10**6


def _quality(m: Any) -> int:
    """NMEA GGA code: RTK from carrSoln, corrections from diffSoln; dead reckoning alone (fixType 1) is no fix."""
    if not m.gnssFixOk or m.fixType not in (2, 3, 4):
        return 0
    return {2: 4, 1: 5}.get(m.carrSoln, 2 if m.diffSoln else 1)


def _samples(messages: list[Any], name: str) -> pd.DataFrame:
    """IMU samples: values of one time tag, complete where all six axes are there."""
    tags: dict[int, dict[str, float]] = {}
    arrived: dict[int, int] = {}  # tag: GPS time of the last fix before its message
    now, last, turns = None, None, 0
    for m in messages:
        if m.identity == "NAV-PVT":
            now = _gps_ns(m)
        if m.identity != name or now is None:
            continue
        for value, sensor, tag in _values(m, name):
            if sensor not in SENSORS:
                continue
            turns += last is not None and tag < last - TAG_WRAP // 2
            last = tag
            column, step = SENSORS[sensor]
            unwrapped = tag + turns * TAG_WRAP
            tags.setdefault(unwrapped, {})[column] = _signed(value) * step
            arrived[unwrapped] = now
    whole = {tag: row for tag, row in tags.items() if len(row) == 6}
    if len(whole) < 10:
        return pd.DataFrame()
    at = np.array(sorted(whole))
    stamps = _on_gps_time(at, np.array([arrived[t] for t in at]))
    frame = pd.DataFrame([whole[t] for t in at])
    return frame[[*GYRO, *ACCEL]].assign(t_ns=stamps)


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


def _signed(value: int) -> int:
    """24 bits, two's complement."""
    value &= 0xFFFFFF
    return value - (1 << 24) if value & (1 << 23) else value


def _on_gps_time(tags: np.ndarray, after: np.ndarray) -> np.ndarray:
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
