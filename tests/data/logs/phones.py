"""What the apps of phones export: header lines as they stand in public recordings and in programs that read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tests.cars import Tables
from tests.data.logs.clock import UNIX, nanoseconds

GNSS_LOGGER = {
    "UncalAccel": ["utcTimeMillis", "elapsedRealtimeNanos", *(f"UncalAccel{a}Mps2" for a in "XYZ")]
    + [f"Bias{a}Mps2" for a in "XYZ"],
    "UncalGyro": ["utcTimeMillis", "elapsedRealtimeNanos", *(f"UncalGyro{a}RadPerSec" for a in "XYZ")]
    + [f"Drift{a}RadPerSec" for a in "XYZ"],
    "Fix": ["Provider", "LatitudeDegrees", "LongitudeDegrees", "AltitudeMeters", "SpeedMps", "AccuracyMeters"]
    + ["BearingDegrees", "UnixTimeMillis", "SpeedAccuracyMps", "BearingAccuracyDegrees", "elapsedRealtimeNanos"]
    + ["VerticalAccuracyMeters", "MockLocation", "NumberOfUsedSignals", "VerticalSpeedAccuracyMps", "SolutionType"],
}


def sensor_logger(folder: Path, tables: Tables) -> list[str]:
    """The columns that Sensor Logger's documentation names, phone's axes as the car's Right-Forward-Up."""
    imu, gnss = tables["imu"], tables["gnss"]
    rfu = {s: imu[[f"{s}_y", f"{s}_x", f"{s}_z"]].to_numpy() * [1, 1, -1] for s in ("accel", "gyro")}
    for name, s in (("TotalAcceleration", "accel"), ("Gyroscope", "gyro")):
        table = {"time": nanoseconds(imu["t"], UNIX), "seconds_elapsed": imu["t"]}
        pd.DataFrame({**table, **dict(zip("zyx", rfu[s].T[::-1]))}).to_csv(folder / f"{name}.csv", index=False)
    place = {"time": nanoseconds(gnss["t"], UNIX), "seconds_elapsed": gnss["t"], "bearingAccuracy": -1}
    place |= {"speedAccuracy": 0.05, "verticalAccuracy": 0.02, "horizontalAccuracy": 0.02}
    place |= {"speed": np.hypot(gnss.vel_n, gnss.vel_e), "bearing": _course(gnss), "altitude": gnss.height_m}
    place |= {"longitude": gnss.lon_deg, "latitude": gnss.lat_deg}
    pd.DataFrame(place).to_csv(folder / "Location.csv", index=False)
    axes = ["reader.imu.accel.axes=rfu", "reader.imu.gyro.axes=rfu", "reader.imu.accel.unit=m/s2"]
    axes += ["reader.imu.gyro.unit=rad/s", "reader.gnss.time.offset_s=0", "reader.gnss.quality.default=4"]
    return ["reader=sensor_logger", *axes]


def gnss_logger(folder: Path, tables: Tables) -> list[str]:
    """Lines of Google's GnssLogger 3: UncalAccel, UncalGyro, Fix."""
    lines = ["# ", "# Header Description:", "# ", "# Version: v3.0.5.6 Platform: 13 Manufacturer: Google"]
    lines += [f"# {name},{','.join(columns)}" for name, columns in GNSS_LOGGER.items()]
    for r in tables["imu"].to_dict("records"):
        ms = UNIX * 1000 + round(1000 * r["t"])
        for name, s in (("UncalAccel", "accel"), ("UncalGyro", "gyro")):
            values = ",".join(f"{r[f'{s}_{a}']:.9g}" for a in "xyz")
            lines.append(f"{name},{ms},{ms}000000,{values},0.0,0.0,0.0")
    for r in tables["gnss"].assign(course=_course(tables["gnss"])).to_dict("records"):
        speed, ms = np.hypot(r["vel_n"], r["vel_e"]), UNIX * 1000 + round(1000 * r["t"])
        place = f"{r['lat_deg']:.10f},{r['lon_deg']:.10f},{r['height_m']:.4f}"
        rest = f"{ms},0.05,0.1,{ms}000000,0.03,0,12,0.1,1"
        lines.append(f"Fix,GPS,{place},{speed:.6f},0.02,{r['course']:.6f},{rest}")
        lines.append(f"Fix,NLP,{r['lat_deg'] + 0.001:.10f},{r['lon_deg']:.10f},0.0,0.0,35.0,0.0,{rest}")
    (folder / "gnss_log_drive.txt").write_text("\n".join(lines) + "\n")
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=gnss_logger", *axes, "reader.gnss.quality.default=4"]


def phyphox(folder: Path, tables: Tables) -> list[str]:
    """An iPhone's export: short names, the vertical accuracy in degrees by mistake, no stds of velocity."""
    place = ("Height (m)", "Velocity (m/s)", "Vertical Accuracy (°)")
    return _phyphox(folder, tables, "Acceleration with g", ("", "", str.upper), place)


def phyphox_android(folder: Path, tables: Tables) -> list[str]:
    """An Android phone's: long names, heights above the geoid and above the ellipsoid."""
    place = ("Altitude WGS84 (m)", "Speed (m/s)", "Vertical Accuracy (m)")
    return _phyphox(folder, tables, "Accelerometer", ("Acceleration ", "Gyroscope ", str), place)


def _phyphox(folder: Path, tables: Tables, accel: str, names: tuple, place: tuple[str, str, str]) -> list[str]:
    imu, gnss = tables["imu"], tables["gnss"]
    for name, title, s, unit in ((accel, names[0], "accel", "m/s^2"), ("Gyroscope", names[1], "gyro", "rad/s")):
        table = {f"{title}{names[2](a)} ({unit})": imu[f"{s}_{a}"] for a in "xyz"}
        pd.DataFrame({"Time (s)": imu["t"], **table}).to_csv(folder / f"{name}.csv", index=False, quoting=2)
    out = {"Time (s)": gnss["t"], "Latitude (°)": gnss.lat_deg, "Longitude (°)": gnss.lon_deg}
    out |= {"Altitude (m)": gnss.height_m - 47.0} if "WGS84" in place[0] else {}
    out |= {place[0]: gnss.height_m, place[1]: np.hypot(gnss.vel_n, gnss.vel_e), "Direction (°)": _course(gnss)}
    out |= {"Horizontal Accuracy (m)": 0.02, place[2]: 0.02}
    pd.DataFrame(out).to_csv(folder / "Location.csv", index=False, quoting=2)
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=phyphox", *axes, "reader.gnss.quality.default=4"]


def _course(gnss: pd.DataFrame) -> pd.Series:
    return np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
