"""What the apps of phones export, by their documentation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tests.cars import Tables
from tests.data.logs.clock import UNIX, nanoseconds


def sensor_logger(folder: Path, tables: Tables) -> list[str]:
    """The columns that Sensor Logger's documentation names, phone's axes as the car's Right-Forward-Up."""
    imu, gnss = tables["imu"], tables["gnss"]
    rfu = {s: imu[[f"{s}_y", f"{s}_x", f"{s}_z"]].to_numpy() * [1, 1, -1] for s in ("accel", "gyro")}
    for name, s in (("TotalAcceleration", "accel"), ("Gyroscope", "gyro")):
        table = {"time": nanoseconds(imu["t"], UNIX), "seconds_elapsed": imu["t"]}
        pd.DataFrame({**table, **dict(zip("zyx", rfu[s].T[::-1]))}).to_csv(folder / f"{name}.csv", index=False)
    place = {"speed": np.hypot(gnss.vel_n, gnss.vel_e), "altitude": gnss.height_m}
    place |= {"bearing": np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360}
    place |= {"longitude": gnss.lon_deg, "latitude": gnss.lat_deg}
    place |= {"horizontalAccuracy": 0.02, "verticalAccuracy": 0.02, "speedAccuracy": 0.05}
    pd.DataFrame({"time": nanoseconds(gnss["t"], UNIX), **place}).to_csv(folder / "Location.csv", index=False)
    axes = ["reader.imu.accel.axes=rfu", "reader.imu.gyro.axes=rfu", "reader.imu.accel.unit=m/s2"]
    axes += ["reader.imu.gyro.unit=rad/s", "reader.gnss.time.offset_s=0", "reader.gnss.quality.default=4"]
    return ["reader=sensor_logger", *axes]


def gnss_logger(folder: Path, tables: Tables) -> list[str]:
    """Lines of Google's GnssLogger 3: UncalAccel, UncalGyro, Fix."""
    lines = [
        "# Version: v3.0.0.1 Platform: 13",
        "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,BiasXMps2",
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,Unix",
    ]
    for r in tables["imu"].to_dict("records"):
        ms = UNIX * 1000 + round(1000 * r["t"])
        for name, s in (("UncalAccel", "accel"), ("UncalGyro", "gyro")):
            values = ",".join(f"{r[f'{s}_{a}']:.9g}" for a in "xyz")
            lines.append(f"{name},{ms},{ms}000000,{values},0.0,0.0,0.0")
    for r in tables["gnss"].to_dict("records"):
        speed, course = np.hypot(r["vel_n"], r["vel_e"]), np.degrees(np.arctan2(r["vel_e"], r["vel_n"])) % 360
        place = f"{r['lat_deg']:.10f},{r['lon_deg']:.10f},{r['height_m']:.4f}"
        lines.append(f"Fix,GPS,{place},{speed:.6f},0.02,{course:.6f},{UNIX * 1000 + round(1000 * r['t'])},0.05,0.1")
    (folder / "gnss_log_drive.txt").write_text("\n".join(lines) + "\n")
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=gnss_logger", *axes, "reader.gnss.quality.default=4"]


def phyphox(folder: Path, tables: Tables) -> list[str]:
    """The columns of phyphox's CSV export; seconds since its start, no stds of velocity."""
    imu, gnss = tables["imu"], tables["gnss"]
    for name, s, unit in (("Acceleration with g", "accel", "m/s^2"), ("Gyroscope", "gyro", "rad/s")):
        table = {f"{a.upper()} ({unit})": imu[f"{s}_{a}"] for a in "xyz"}
        pd.DataFrame({"Time (s)": imu["t"], **table}).to_csv(folder / f"{name}.csv", index=False)
    place = {"Latitude (°)": gnss.lat_deg, "Longitude (°)": gnss.lon_deg, "Height (m)": gnss.height_m}
    place |= {"Velocity (m/s)": np.hypot(gnss.vel_n, gnss.vel_e)}
    place |= {"Direction (°)": np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360}
    place |= {"Horizontal Accuracy (m)": 0.02, "Vertical Accuracy (°)": 0.02}
    pd.DataFrame({"Time (s)": gnss["t"], **place}).to_csv(folder / "Location.csv", index=False)
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=phyphox", *axes, "reader.gnss.quality.default=4"]
