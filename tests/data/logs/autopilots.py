"""Autopilots' logs, byte by byte: PX4's ULog and ArduPilot's DataFlash, which no library writes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tests.cars import Tables
from tests.data.logs.clock import TOW, UNIX, WEEK

BOOT_US = 7_000_000  # the autopilot's clock at t = 0


def _course(row) -> tuple[float, float]:
    speed = float(np.hypot(row.vel_n, row.vel_e))
    return speed, float(np.degrees(np.arctan2(row.vel_e, row.vel_n)) % 360)


def px4(folder: Path, tables: Tables) -> list[str]:
    """ULog of version 1: sensor_combined, sensor_gps in degrees, vehicle_air_data."""
    formats = {
        "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
        "sensor_gps": "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
        "double altitude_ellipsoid_m;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;float eph;float epv;"
        "float s_variance_m_s;uint8_t fix_type;",
        "vehicle_air_data": "uint64_t timestamp;float baro_pressure_pa;",
    }

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", BOOT_US)]
    out += [message("F", f"{name}:{fields}".encode()) for name, fields in formats.items()]
    out += [message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(formats)]
    rows = []
    for r in tables["imu"].itertuples():
        us = BOOT_US + round(1e6 * r.t)
        values = (r.gyro_x, r.gyro_y, r.gyro_z, r.accel_x, r.accel_y, r.accel_z)
        rows.append((us, message("D", struct.pack("<HQ6f", 0, us, *values))))
    for r in tables["gnss"].itertuples():
        us, utc = BOOT_US + round(1e6 * r.t), round(1e6 * (UNIX + r.t))
        place = (r.lat_deg, r.lon_deg, r.height_m, r.vel_n, r.vel_e, r.vel_d, r.std_pos_n, r.std_pos_d, r.std_vel_n)
        rows.append((us, message("D", struct.pack("<HQQ3d6fB", 1, us, utc, *place, 6))))
        rows.append((us, message("D", struct.pack("<HQf", 2, us, 95_000.0))))
    out += [content for _, content in sorted(rows)]
    (folder / "drive.ulg").write_bytes(b"".join(out))
    return ["reader=px4"]


def ardupilot(folder: Path, tables: Tables) -> list[str]:
    """DataFlash: FMT, IMU, GPS with GPA, BARO."""
    formats = {
        "IMU": (129, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
        "GPS": (130, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
        "GPA": (131, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc"),
        "BARO": (132, "QBff", "TimeUS,I,Alt,Press"),
    }
    codes = {"Q": "Q", "B": "B", "f": "f", "I": "I", "H": "H", "c": "h", "C": "H", "L": "i", "e": "i"}

    def made(name: str, *values) -> bytes:
        number, layout, _ = formats[name]
        return b"\xa3\x95" + bytes([number]) + struct.pack("<" + "".join(codes[c] for c in layout), *values)

    def fmt(number: int, length: int, name: str, layout: str, labels: str) -> bytes:
        text = struct.pack("<BB4s16s64s", number, length, name.encode(), layout.encode(), labels.encode())
        return b"\xa3\x95\x80" + text

    out = [fmt(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    for name, (number, layout, labels) in formats.items():
        length = 3 + struct.calcsize("<" + "".join(codes[c] for c in layout))
        out.append(fmt(number, length, name, layout, labels))
    rows = []
    for r in tables["imu"].itertuples():
        us = BOOT_US + round(1e6 * r.t)
        rows.append((us, made("IMU", us, 0, r.gyro_x, r.gyro_y, r.gyro_z, r.accel_x, r.accel_y, r.accel_z)))
    for r in tables["gnss"].itertuples():
        us, (speed, course) = BOOT_US + round(1e6 * r.t), _course(r)
        place = (round(r.lat_deg * 1e7), round(r.lon_deg * 1e7), round(100 * r.height_m))
        ms = round(1000 * (TOW + r.t))
        rows.append((us, made("GPS", us, 0, 6, ms, WEEK, 20, 60, *place, speed, course, r.vel_d, 0.0, 1)))
        rows.append((us, made("GPA", us, 0, 90, 2, 2, 5)))
        rows.append((us, made("BARO", us, 0, 0.0, 95_000.0)))
    out += [content for _, content in sorted(rows)]
    (folder / "drive.bin").write_bytes(b"".join(out))
    return ["reader=ardupilot"]
