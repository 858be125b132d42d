"""Frames that a newcomer gets wrong: one line each, which points the right way.

A case is which frame, what becomes of it and what the line must say. Everything runs in this process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dlkf
from dlkf.data.schema import ACCEL, GYRO
from tests.wrong.spoiling import PI, Frames, check, ddmm, plus, put, times


class Polars:
    """A frame of a library that knows the way to pandas."""

    def to_pandas(self) -> pd.DataFrame:
        return pd.DataFrame()


BAD_FRAMES: dict[str, tuple[str, Callable[[pd.DataFrame], Any], str]] = {  # which, what becomes of it, the line
    "imu as an array": ("imu", lambda f: f.to_numpy(), "imu is a ndarray, must be a pandas DataFrame"),
    "imu as a list": ("imu", lambda f: f.to_dict("records"), "imu is a list, must be a pandas DataFrame"),
    "no imu": ("imu", lambda f: None, "imu is a NoneType, must be a pandas DataFrame"),
    "gnss as a dict": ("gnss", lambda f: f.to_dict("list"), "gnss is a dict, must be a pandas DataFrame"),
    "a column of the imu": ("imu", lambda f: f.drop(columns="gyro_x"), "imu: column gyro_x missing; has t, gyro_y"),
    "ax for accel_x": (
        "imu",
        lambda f: f.rename(columns={c: f"a{c[-1]}" for c in ACCEL}),
        "imu.rename(columns={'ax': 'accel_x', 'ay': 'accel_y', 'az': 'accel_z'})",
    ),
    "time for t": ("imu", lambda f: f.rename(columns={"t": "time"}), "imu.rename(columns={'time': 't'})"),
    "t as index": ("imu", lambda f: f.set_index("t"), "t is its index; give imu.reset_index()"),
    "capitals": ("imu", lambda f: f.rename(columns=str.upper), "'GYRO_X': 'gyro_x'"),
    "no columns": ("imu", lambda f: f[[]], "has no columns"),
    "a column twice": (
        "imu",
        lambda f: pd.concat([f, f[["gyro_z"]]], axis=1),
        "column gyro_z appears twice; keep one",
    ),
    "no rows of imu": ("imu", lambda f: f.iloc[:0], "imu has no rows"),
    "one row of imu": ("imu", lambda f: f.iloc[:1], "imu: has a single sample"),
    "ten rows of imu": ("imu", lambda f: f.iloc[:10], "only 0.20 s of IMU"),
    "g": (
        "imu",
        times(1 / 9.80665, *ACCEL),
        "imu: median specific force is 1.02: looks like g; multiply accel by 9.80665",
    ),
    "mg": ("imu", times(1000 / 9.80665, *ACCEL), "must be near 9.8; accel in m/s² with gravity"),
    "°/s": ("imu", times(1 / PI, *GYRO), "looks like degrees; use rad/s"),
    "z up": (
        "imu",
        lambda f: f.assign(**{c: -f[c] for c in ("accel_y", "accel_z", "gyro_y", "gyro_z")}),
        "the z axis points up (FLU?): turn the signs of y and z of accel and gyro round",
    ),
    "x down": (
        "imu",
        lambda f: f.rename(columns={"accel_x": "accel_z", "accel_z": "accel_x"}),
        "gravity lies on accel_x",
    ),
    "without gravity": ("imu", lambda f: f.assign(accel_z=f.accel_z + 9.80665), "median specific force is 0.85"),
    "milliseconds": ("imu", times(1000, "t"), "imu: a row every 20 s: t looks like milliseconds; divide it by 1e+03"),
    "nanoseconds": ("imu", times(1e9, "t"), "t looks like nanoseconds; divide it by 1e+09"),
    "nanoseconds at 100 Hz": ("imu", times(5e8, "t"), "t looks like nanoseconds; divide it by 1e+09"),
    "dates": (
        "imu",
        lambda f: f.assign(t=pd.to_datetime(f.t, unit="s")),
        "must be seconds on one clock for all frames: (imu.t - pd.Timestamp(",
    ),
    "dates as text": (
        "imu",
        lambda f: f.assign(t=pd.to_datetime(f.t, unit="s").astype(str)),
        "t has dates as text, must be seconds on one clock for all frames: (pd.to_datetime(imu.t) - pd.Timestamp(",
    ),
    "time differences": (
        "imu",
        lambda f: f.assign(t=pd.to_timedelta(f.t, unit="s")),
        "must be seconds: imu.t.dt.total_seconds()",
    ),
    "numbers as text": (
        "imu",
        lambda f: f.assign(accel_x=f.accel_x.astype(str)),
        "pd.to_numeric(imu.accel_x) makes them numbers",
    ),
    "decimal commas": (
        "imu",
        lambda f: f.assign(accel_x=[f"{x:.3f}".replace(".", ",") for x in f.accel_x]),
        "imu: accel_x: row 0 has '0,506', must be a number",
    ),
    "a word": ("imu", put("gyro_y", 3, "n/a"), "imu: gyro_y: row 3 has 'n/a', must be a number"),
    "not sorted": ("imu", lambda f: f.iloc[::-1], "imu: row 1: t goes back from 60.000000 to 59.980000; sort the rows"),
    "two rows exchanged": ("imu", lambda f: f.iloc[[0, 2, 1, *range(3, len(f))]], "imu: row 2: t goes back"),
    "a row twice": (
        "imu",
        lambda f: pd.concat([f.iloc[:5], f.iloc[4:]]),
        "imu: row 5: t = 0.100000 appears twice; remove duplicate samples",
    ),
    "no time": ("imu", put("t", 7, np.nan), "imu: row 7: t is nan"),
    "NaN in the imu": ("imu", put("accel_y", 9, np.nan), "imu: row 9: accel_y is nan; remove the row"),
    "inf in the imu": ("imu", put("gyro_z", 9, np.inf), "imu: row 9: gyro_z is inf; remove the row"),
    "a gap": (
        "imu",
        lambda f: f[(f.t < f.t[500]) | (f.t > f.t[500] + 5)],
        "imu: row 500: IMU gap of 5.040 s after t = 10.000; split the drive there",
    ),
    "zeros": (
        "imu",
        lambda f: f.assign(**dict.fromkeys((*ACCEL, *GYRO), 0.0)),
        "median specific force is 0 m/s², must be near 9.8",
    ),
    "gyroscope the other way": ("imu", times(-1, *GYRO), "z must point down; turn the signs of y and z"),
    "lat, lon": (
        "gnss",
        lambda f: f.rename(columns={"lat_deg": "lat", "lon_deg": "lon", "height_m": "alt"}),
        "gnss.rename(columns={'lat': 'lat_deg', 'lon': 'lon_deg', 'alt': 'height_m'})",
    ),
    "no height": ("gnss", lambda f: f.drop(columns="height_m"), "gnss: column height_m missing"),
    "no rows of gnss": ("gnss", lambda f: f.iloc[:0], "gnss has no rows"),
    "one fix": ("gnss", lambda f: f.iloc[[30]], "so yaw is unknown; give a longer part of the drive"),
    "no fix": ("gnss", lambda f: f.assign(quality=0), "gnss: no GNSS fix at all (position NaN or quality 0"),
    "quality in words": ("gnss", lambda f: f.assign(quality="RTK"), "gnss: quality: row 0 has 'RTK', must be a number"),
    "position NaN": ("gnss", lambda f: f.assign(lat_deg=np.nan), "gnss: no GNSS fix at all (position NaN"),
    "radians": ("gnss", times(PI, "lat_deg", "lon_deg"), "lat_deg and lon_deg look like radians"),
    "degrees and minutes": ("gnss", ddmm, "looks like degrees and minutes"),
    "1e-7 degrees": ("gnss", times(1e7, "lat_deg", "lon_deg"), "looks like 1e-7 degrees"),
    "UTM": (
        "gnss",
        lambda f: f.assign(lat_deg=5.78e6 + f.index, lon_deg=3.4e5),
        "looks like metres of a grid (UTM, ECEF)",
    ),
    "the wrong half of the earth": ("gnss", times(-1, "lat_deg"), "lat_deg or vel_n has the wrong sign"),
    "west for east": ("gnss", times(-1, "lon_deg"), "lon_deg or vel_e has the wrong sign"),
    "lat and lon exchanged": (
        "gnss",
        lambda f: f.rename(columns={"lat_deg": "lon_deg", "lon_deg": "lat_deg"}),
        "latitude and longitude look swapped; exchange lat_deg and lon_deg",
    ),
    "a letter behind the degrees": (
        "gnss",
        lambda f: f.assign(lat_deg=[f"{x:.7f} N" for x in f.lat_deg]),
        "gnss: lat_deg: row 0 has '52.1500000 N', must be a number",
    ),
    "0, 0 at first": (
        "gnss",
        lambda f: f.assign(lat_deg=f.lat_deg * (f.index > 9), lon_deg=f.lon_deg * (f.index > 9)),
        "fix 0 is at 0°/0°, as 10 of 60: no position yet; give them quality 0",
    ),
    "inf in a fix": ("gnss", put("height_m", 4, np.inf), "gnss: row 4: height_m is inf; write NaN where it is unknown"),
    "km/h": ("gnss", times(3.6, "vel_n", "vel_e", "vel_d"), "the velocities look like km/h; divide them by 3.6"),
    "east before north": (
        "gnss",
        lambda f: f.rename(columns={"vel_n": "vel_e", "vel_e": "vel_n"}),
        "vel_n and vel_e look swapped; exchange them",
    ),
    "negative 1σ": (
        "gnss",
        put("std_pos_n", 2, -1.0),
        "gnss: row 2: std_pos_n is -1.0; must be ≥ 0, or NaN if unknown",
    ),
    "fixes of another time zone": (
        "gnss",
        plus(-7200.0),
        "both need the same clock: they are 2 h apart, as time zones are; add 7200 s to t of gnss",
    ),
    "north without east": (
        "gnss",
        lambda f: f.drop(columns="vel_e"),
        "gnss: has vel_n alone; give vel_n and vel_e, or neither without velocities",
    ),
    "fixes of another day": ("gnss", plus(86_400.0), "lie outside the IMU's 0.020 to 60.000; both need the same clock"),
    "Unix and GPS seconds": (
        "gnss",
        plus(1_435_000_000.0),
        "lie outside the IMU's 0.020 to 60.000; both need the same clock",
    ),
    "fixes 5 s late": ("gnss", plus(5.0), "the clocks of IMU and GNSS are 5.0 s apart"),
    "fixes not sorted": (
        "gnss",
        lambda f: f.iloc[::-1],
        "gnss: row 1: t goes back from 59.000000 to 58.000000; sort the rows",
    ),
    "fixes in milliseconds": (
        "gnss",
        times(1000, "t"),
        "gnss: a row every 1000 s: t looks like milliseconds; divide it by 1e+03",
    ),
    "speed as an array": ("speed", lambda f: f.to_numpy(), "speed is a ndarray, must be a pandas DataFrame"),
    "speed_kmh": (
        "speed",
        lambda f: f.rename(columns={"speed": "speed_kmh"}),
        "speed.rename(columns={'speed_kmh': 'speed'})",
    ),
    "speed in km/h": (
        "speed",
        times(3.6, "speed"),
        "speed is 3.60 times that of GNSS in the median: looks like km/h; divide it by 3.6",
    ),
    "speed of another day": ("speed", plus(86_400.0), "speed: t from 86400.000 to 86459.000 lies outside the IMU's"),
    "a dead wheel": ("speed", lambda f: f.assign(speed=0.0), "the sensor is dead; or leave it out"),
    "heading in degrees": (
        "heading",
        times(1 / PI, "heading"),
        "heading reaches 179.6: looks like degrees; multiply it by π/180",
    ),
    "heading without a name": (
        "heading",
        lambda f: f.rename(columns={"heading": "hdg"}),
        "heading: column heading missing; has t, hdg",
    ),
    "pressure in hPa": ("baro", times(0.01, "pressure"), "hPa"),
    "a barometer of nothing": (
        "baro",
        lambda f: f[["t"]],
        "baro: has neither of pressure, height_m; one of them is needed",
    ),
    "gyro all 0": ("imu", lambda f: f.assign(gyro_z=0.0), "gyro_z is 0 in every row though the car turns: a dead axis"),
    "accelerometers all 0": ("imu", lambda f: f.assign(accel_x=0.0), "accel_x is 0 in every row though the car brakes"),
    "frozen": (
        "imu",
        lambda f: f.assign(**{c: f[c].iloc[0] for c in (*ACCEL, *GYRO)}),
        "in every row though the car turns: a dead axis",
    ),
    "a mirrored axis": ("imu", times(-1, "accel_y"), "only in left-handed axes (0.99 instead of 0.40): negate accel_y"),
    "x and y exchanged": (
        "imu",
        lambda f: f.rename(columns={"accel_x": "accel_y", "accel_y": "accel_x"}),
        "exchange accel_x and accel_y",
    ),
    "whole seconds": (
        "imu",
        lambda f: f.assign(t=np.floor(f.t)),
        "2939 of 3000 rows have the stamp of the row before: t has whole seconds; give its decimals",
    ),
    "float32": (
        "imu",
        lambda f: f.assign(t=(f.t + 4e5).astype("float32")),
        "t has the 0.03125 s of float32; keep it in float64",
    ),
    "numbers of rows": ("imu", lambda f: f.assign(t=np.arange(len(f))), "milliseconds, or the numbers of the rows"),
    "one sample a second": ("imu", lambda f: f.iloc[::50], "a car's IMU has at least 5 a second: give all its samples"),
    "blanks in names": ("imu", lambda f: f.rename(columns=lambda c: f" {c}"), "imu.rename(columns=str.strip)"),
    "units in names": (
        "imu",
        lambda f: f.rename(columns={c: f"{c} [rad/s]" for c in GYRO}),
        "imu.rename(columns={'gyro_x [rad/s]': 'gyro_x', 'gyro_y [rad/s]': 'gyro_y'",
    ),
    "accX": (
        "imu",
        lambda f: f.rename(columns={c: f"Acc{c[-1].upper()}" for c in ACCEL}),
        "imu.rename(columns={'AccX': 'accel_x', 'AccY': 'accel_y', 'AccZ': 'accel_z'})",
    ),
    "wx": ("imu", lambda f: f.rename(columns={c: f"w{c[-1]}" for c in GYRO}), "imu.rename(columns={'wx': 'gyro_x'"),
    "two levels of names": ("imu", lambda f: pd.concat({"a": f}, axis=1), "its columns have 2 levels, must be plain"),
    "complex numbers": ("imu", lambda f: f.assign(accel_x=f.accel_x + 0j), "accel_x: complex numbers, must be real"),
    "lists in cells": ("imu", lambda f: f.assign(accel_x=[[x] for x in f.accel_x]), "row 0 has [0.50637"),
    "a path": ("imu", lambda f: "imu.csv", "imu is a str, must be a pandas DataFrame; pd.read_csv('imu.csv') or"),
    "a series": ("imu", lambda f: f.accel_x, "imu is a Series, must be a pandas DataFrame"),
    "of another library": ("imu", lambda f: Polars(), "must be a pandas DataFrame: give imu.to_pandas()"),
    "mrad/s": ("imu", times(1000, *GYRO), "gyro reaches 187 rad/s"),
    "ft/s²": ("imu", times(1 / 0.3048, *ACCEL), "median specific force is 32.7 m/s², must be near 9.8"),
    "right, forward, up": (
        "imu",
        lambda f: f.assign(accel_x=f.accel_y, accel_y=f.accel_x, accel_z=-f.accel_z),
        "the z axis points up",
    ),
    "turned by 90°": (
        "imu",
        lambda f: f.assign(accel_x=f.accel_y, accel_y=-f.accel_x, gyro_x=f.gyro_y, gyro_y=-f.gyro_x),
        "if the IMU is turned by +90° about the vertical",
    ),
    "heights in feet": ("gnss", times(1 / 0.3048, "height_m"), "look like feet; multiply height_m by 0.3048"),
    "climb upwards": ("gnss", times(-1, "vel_d"), "it counts upwards; negate vel_d"),
    "heights unknown": ("gnss", lambda f: f.assign(height_m=np.nan), "height_m is NaN in every row; give one number"),
    "0 to 360°": ("gnss", lambda f: f.assign(lon_deg=f.lon_deg + 200), "subtract 360 where it is above 180"),
    "knots": ("gnss", times(1 / 0.514444, "vel_n", "vel_e"), "look like knots; multiply them by 0.5144"),
    "mph": ("gnss", times(1 / 0.44704, "vel_n", "vel_e"), "the velocities look like mph; multiply them by 0.44704"),
    "cm/s": ("gnss", times(100, "vel_n", "vel_e"), "m/s is beyond any car; give them quality 0, or correct units"),
    "along the car": (
        "gnss",
        lambda f: f.assign(vel_n=np.hypot(f.vel_n, f.vel_e), vel_e=0.0),
        "vel_n and vel_e must count North and East, not along the car",
    ),
    "a quality of another kind": ("gnss", lambda f: f.assign(quality=17), "row 0 has 17, must be a code of NMEA"),
    "half a quality": ("gnss", lambda f: f.assign(quality=1.5), "row 0 has 1.5, must be a code of NMEA"),
    "three digits of degrees": (
        "gnss",
        lambda f: f.assign(lat_deg=f.lat_deg.round(3), lon_deg=f.lon_deg.round(3)),
        "a frozen receiver",
    ),
    "ECEF": (
        "gnss",
        lambda f: f.rename(columns={"lat_deg": "x", "lon_deg": "y", "height_m": "z"}),
        "column lat_deg, lon_deg, height_m missing; has t, x, y, z",
    ),
    "a fix twice": ("gnss", lambda f: pd.concat([f.iloc[:5], f.iloc[4:]]), "row 5: t = 4.000000 appears twice"),
    "dates with a zone": (
        "gnss",
        lambda f: f.assign(t=pd.to_datetime(f.t, unit="s", utc=True)),
        "t is a date, must be",
    ),
    "1σ without end": ("gnss", put("std_pos_e", 3, np.inf), "gnss: row 3: std_pos_e is inf; write NaN where"),
    "speed in mph": ("speed", times(1 / 0.44704, "speed"), "looks like mph; multiply it by 0.44704"),
    "an odometer": ("speed", lambda f: f.assign(speed=f.speed.cumsum()), "it must be in m/s, correct its scale"),
    "a wheel that turns back": ("speed", times(-1, "speed"), "speed is negative where the car drives forward"),
    "a wheel on another clock": ("speed", plus(5.0), "5.0 s behind that of GNSS; subtract 5.00 s from its t"),
    "no speed at all": ("speed", lambda f: f.assign(speed=np.nan), "speed is NaN in every row; or leave it out"),
    "heading from East": (
        "heading",
        lambda f: f.assign(heading=np.pi / 2 - f.heading),
        "heading counts from East, must count clockwise from North",
    ),
    "antennas across": ("heading", lambda f: f.assign(heading=f.heading + np.pi / 2), "heading is +90° off the course"),
    "a barometer of °C": ("baro", lambda f: f.assign(pressure=21.0), "pressure is 21 in the median, must be in Pa"),
}


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_frame(case: str, frames: Frames) -> None:
    which, spoil, said = BAD_FRAMES[case]
    tables = {k: frames[k] for k in ("imu", "gnss")} | {which: spoil(frames[which])}
    with pytest.raises(dlkf.InputError) as error:
        dlkf.navigate(tables.pop("imu"), tables.pop("gnss"), model="mbkf21_nhc", **tables)
    check(str(error.value), said)
