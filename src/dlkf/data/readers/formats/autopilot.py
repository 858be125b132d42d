"""Logs of autopilots: PX4's ULog by pyulog, ArduPilot's DataFlash by pymavlink.

Tables have the contract's columns and ``t_ns``: microseconds since switching on, with the GPS time that the receiver
gave at its first fix added, so that all tables of a log are on one clock. Axes are Forward-Right-Down.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError, first_line
from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.qualities import MAVLINK, READINGS
from dlkf.data.readers.units import WEEK_S, gps_seconds
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY

QUALITY = READINGS[MAVLINK] | {8: 1}  # of MAVLink's GPS_FIX_TYPE
ULOG, DATAFLASH = b"ULog\x01\x12\x35", b"\xa3\x95\x80"  # a DataFlash log begins with the format of formats
ULOG_GNSS = ("vehicle_gps_position", "sensor_gps")


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """IMU samples, fixes or a barometer of a log; ``table`` names another instance (``IMU1``, ``sensor_gps``)."""
    tables = _tables(path)
    if kind not in tables or not len(tables[kind]):
        raise InputError(f"{path}: has no {kind}; has {', '.join(k for k, t in tables.items() if len(t)) or 'nothing'}")
    return LogTable(tables[kind], path, "message")


def aids(path: Path) -> tuple[str, ...]:
    """Which further sensors a log has: baro."""
    return ("baro",) if len(_tables(path).get("baro", ())) else ()


def _tables(path: Path) -> dict[str, pd.DataFrame]:
    with path.open("rb") as file:
        is_ulog = file.read(len(ULOG)) == ULOG
    return _ulog(path) if is_ulog else _dataflash(path)


def _ulog(path: Path) -> dict[str, pd.DataFrame]:
    pyulog = library("pyulog", "a PX4 log")
    wanted = ["sensor_combined", *ULOG_GNSS, "vehicle_air_data"]
    try:
        found = pyulog.ULog(str(path), wanted)
    except Exception as error:  # pyulog has no errors of its own: TypeError, struct.error, IndexError of damaged files
        raise InputError(f"{path}: cannot be read as a PX4 log ({first_line(error)}); copy it again") from None
    data = {d.name: pd.DataFrame(d.data) for d in reversed(found.data_list)}  # the first instance stays
    out: dict[str, pd.DataFrame] = {}
    fixes = next((data[name] for name in ULOG_GNSS if name in data and len(data[name])), None)
    shift = 0
    if fixes is not None:
        out["gnss"], shift = _ulog_fixes(fixes)
    if (imu := data.get("sensor_combined")) is not None:
        columns = {c: imu[f"gyro_rad[{k}]"] for k, c in enumerate(GYRO)}
        columns |= {c: imu[f"accelerometer_m_s2[{k}]"] for k, c in enumerate(ACCEL)}
        out["imu"] = pd.DataFrame({"t_ns": imu["timestamp"].astype(np.int64) * 1000 + shift, **columns})
    if (air := data.get("vehicle_air_data")) is not None and "baro_pressure_pa" in air:
        out["baro"] = pd.DataFrame({"t_ns": air["timestamp"].astype(np.int64) * 1000 + shift})
        out["baro"]["pressure"] = air["baro_pressure_pa"]
    return out


def _ulog_fixes(gps: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Fixes, in whole numbers (to 1.13) or degrees (since), and what to add to the log's nanoseconds for GPS time."""
    degrees = "latitude_deg" in gps
    names = ("latitude_deg", "longitude_deg", "altitude_ellipsoid_m") if degrees else ("lat", "lon", "alt_ellipsoid")
    scales = (1.0, 1.0, 1.0) if degrees else (1e-7, 1e-7, 1e-3)
    out = {c: gps[name].astype(float) * scale for c, name, scale in zip(POSITION, names, scales)}
    out |= {c: gps[f"vel_{c[-1]}_m_s"].astype(float) for c in VELOCITY}
    out |= dict.fromkeys(STD[:2], gps["eph"].astype(float)) | {STD[2]: gps["epv"].astype(float)}
    speed = gps["s_variance_m_s"].astype(float) if "s_variance_m_s" in gps else np.nan
    out |= dict.fromkeys(STD[3:], speed)
    stamp = gps["timestamp_sample"] if "timestamp_sample" in gps and bool((gps["timestamp_sample"] > 0).all()) else None
    t_ns = (gps["timestamp"] if stamp is None else stamp).astype(np.int64).to_numpy() * 1000
    utc = gps["time_utc_usec"].astype(np.int64).to_numpy() if "time_utc_usec" in gps else np.zeros(len(gps), np.int64)
    shift = 0
    if (known := np.flatnonzero(utc > 0)).size:
        whole, rest = np.divmod(utc[known], 10**6)
        shift = int(np.median(gps_seconds(whole) * 10**9 + rest * 1000 - t_ns[known]))
    quality = gps["fix_type"].astype(int).map(QUALITY).fillna(0).astype(int)
    return pd.DataFrame({"t_ns": t_ns + shift, **out, "quality": quality}), shift


def _dataflash(path: Path) -> dict[str, pd.DataFrame]:
    reading = library("pymavlink.DFReader", "an ArduPilot log")
    rows: dict[str, list[dict[str, Any]]] = {"IMU": [], "GPS": [], "GPA": [], "BARO": []}
    try:
        log = reading.DFReader_binary(str(path))
        while (message := log.recv_match(type=list(rows))) is not None:
            if int(getattr(message, "I", 0)) == 0:  # the first of several sensors
                rows[message.get_type()].append(message.to_dict())
    except Exception as error:  # as pyulog
        raise InputError(f"{path}: cannot be read as an ArduPilot log ({first_line(error)}); copy it again") from None
    data = {name: pd.DataFrame(found) for name, found in rows.items()}
    out: dict[str, pd.DataFrame] = {}
    shift = 0
    if len(data["GPS"]):
        out["gnss"], shift = _dataflash_fixes(data["GPS"], data["GPA"])
    if len(imu := data["IMU"]):
        columns = {c: imu[f"Gyr{c[-1].upper()}"] for c in GYRO} | {c: imu[f"Acc{c[-1].upper()}"] for c in ACCEL}
        out["imu"] = pd.DataFrame({"t_ns": imu["TimeUS"].astype(np.int64) * 1000 + shift, **columns})
    if len(baro := data["BARO"]):
        out["baro"] = pd.DataFrame({"t_ns": baro["TimeUS"].astype(np.int64) * 1000 + shift, "pressure": baro["Press"]})
    return out


def _dataflash_fixes(gps: pd.DataFrame, accuracy: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """GPS with the accuracies of the GPA of the same time; heights are above the sea."""
    speed, course = gps["Spd"].astype(float), np.radians(gps["GCrs"].astype(float))
    out = {c: gps[name].astype(float) for c, name in zip(POSITION, ("Lat", "Lng", "Alt"))}
    out |= {"vel_n": speed * np.cos(course), "vel_e": speed * np.sin(course), "vel_d": gps["VZ"].astype(float)}
    own = accuracy.drop_duplicates("TimeUS").set_index("TimeUS").reindex(gps["TimeUS"]) if len(accuracy) else None
    for names, key in ((STD[:2], "HAcc"), (STD[2:3], "VAcc"), (STD[3:], "SAcc")):
        values = np.full(len(gps), np.nan) if own is None or key not in own else own[key].to_numpy(float)
        out |= dict.fromkeys(names, values)
    t_ns = gps["TimeUS"].astype(np.int64).to_numpy() * 1000
    week, ms = (gps[c].astype(np.int64).to_numpy() for c in ("GWk", "GMS"))
    known = week > 1000
    gps_ns = week[known] * WEEK_S * 10**9 + ms[known] * 10**6
    shift = int(np.median(gps_ns - t_ns[known])) if known.any() else 0
    stamps = np.where(known, week * WEEK_S * 10**9 + ms * 10**6, t_ns + shift)
    quality = gps["Status"].astype(int).map(QUALITY).fillna(0).astype(int)
    return pd.DataFrame({"t_ns": stamps, **out, "quality": quality}), shift
