"""What a newcomer gets wrong, in the functions and on the command line: one line each, which points the right way.

A case is what is done and what the line must say. Everything runs in this process.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dlkf
from dlkf.data.schema import ACCEL, GYRO
from tests.commands.refusals import FAST, is_refused

LONGEST = 600  # letters of a line
Frames = dict[str, pd.DataFrame]
KALMAN = {"model": "mbkf15"}


@pytest.fixture(scope="module")
def frames(simulated) -> Frames:
    """A minute of the first simulated drive, and a wheel that fits."""
    name = pd.read_parquet(simulated / "drives.parquet")["drive"][0]
    tables = {
        kind: pd.read_parquet(simulated / kind / f"drive={name}" / "part-0.parquet")
        for kind in ("imu", "gnss", "reference")
    }
    tables = {kind: table[table.t - table.t.iloc[0] < 60].reset_index(drop=True) for kind, table in tables.items()}
    fixes = tables["gnss"]
    tables["speed"] = pd.DataFrame({"t": fixes.t, "speed": np.hypot(fixes.vel_n, fixes.vel_e)})
    yaw = tables["reference"].yaw.to_numpy()[:: max(1, len(tables["reference"]) // len(fixes))]
    tables["heading"] = pd.DataFrame(
        {"t": tables["reference"].t[:: max(1, len(tables["reference"]) // len(fixes))], "heading": yaw}
    )
    tables["baro"] = pd.DataFrame({"t": fixes.t, "pressure": 101_325.0 - 12 * fixes.height_m})
    return tables


def put(column: str, row: int, value: Any) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """A value in one row."""

    def spoil(frame: pd.DataFrame) -> pd.DataFrame:
        values = frame[column].to_numpy(object if isinstance(value, str) else float).copy()
        values[row] = value
        return frame.assign(**{column: values})

    return spoil


def times(factor: float, *columns: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Columns in another unit."""
    return lambda frame: frame.assign(**{c: frame[c] * factor for c in columns})


def plus(seconds: float) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Another clock."""
    return lambda frame: frame.assign(t=frame.t + seconds)


def ddmm(frame: pd.DataFrame) -> pd.DataFrame:
    """Degrees and minutes as a receiver prints them."""
    return frame.assign(**{c: np.trunc(frame[c]) * 100 + frame[c] % 1 * 60 for c in ("lat_deg", "lon_deg")})


PI = np.pi / 180
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
}

CALLS: dict[str, tuple[Callable[[Frames, Path], Any], str]] = {
    "imu and gnss exchanged": (lambda d, _: dlkf.navigate(d["gnss"], d["imu"]), "imu and gnss look exchanged"),
    "imu twice": (lambda d, _: dlkf.navigate(d["imu"], d["imu"]), "imu and gnss are the same frame"),
    "no such filter": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="mbkf16"),
        "unknown model 'mbkf16'; did you mean mbkf15?",
    ),
    "plus misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="pluss"),
        "unknown model 'pluss'; did you mean plus?",
    ),
    "a suffix misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="mbkf21_nch"),
        "unknown model 'mbkf21_nch'; did you mean mbkf21_nhc?",
    ),
    "two filters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model=["mbkf15", "plus"]),
        "model is a list, must be a name",
    ),
    "a filter that is none": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model=None),
        "model is a NoneType, must be a name",
    ),
    "a preset misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type="consumr", **KALMAN),
        "unknown imu preset 'consumr'; did you mean consumer? known are",
    ),
    "a preset that is a number": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type=5, **KALMAN),
        "imu_type is 5, must be the name of a preset",
    ),
    "half a preset": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type={"name": "x"}, **KALMAN),
        "IMU preset x: accel, gyro missing",
    ),
    "imu_type=auto": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type="auto", **KALMAN),
        "imu_type='auto' is for dlkf navigate imu=auto",
    ),
    "a tuning misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], tuning="any_care", **KALMAN),
        "unknown tuning preset 'any_care'; did you mean any_car?",
    ),
    "a factor that is none": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], tuning={"accel_nois": 2.0}, **KALMAN),
        "tuning: unknown key accel_nois; known are accel_noise",
    ),
    "an arm of two": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(1, 2)),
        "lever_arm is (1, 2), must be three numbers",
    ),
    "an arm of letters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm="abc"),
        "lever_arm is 'abc', must be three numbers",
    ),
    "an arm of nine": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=np.zeros((3, 3))),
        "lever_arm is array([[0., 0., 0.], [0., 0., 0.], [0., 0., 0.]]), must be three numbers",
    ),
    "an arm of one": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=1.2),
        "lever_arm is 1.2, must be three numbers",
    ),
    "an arm in mm": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(1000, 0, -1200)),
        "an antenna 1200 m away; metres are meant",
    ),
    "an arm of NaN": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(np.nan, 0, 0)),
        "lever_arm is (nan, 0, 0), must be three numbers",
    ),
    "a rate below 0": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz=-50, **KALMAN),
        "rate_hz is -50, must be a number above 0",
    ),
    "a rate of letters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz="50", **KALMAN),
        "rate_hz is '50', must be a number above 0",
    ),
    "a rate mistyped": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz=5e6, **KALMAN),
        "rate_hz is 5000000.0, must be above 0 and at most 10000",
    ),
    "no interval": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], epoch_s=0, **KALMAN),
        "epoch_s is 0, must be a number above 0",
    ),
    "an interval of a third": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], epoch_s=0.33, rate_hz=50, **KALMAN),
        "an epoch must hold a whole number of samples",
    ),
    "smoothed, perhaps": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], smoothed="maybe", **KALMAN),
        "smoothed is 'maybe', must be True or False",
    ),
    "ins smoothed": (
        lambda d, _: dlkf.smooth(d["imu"], d["gnss"], model="ins"),
        "needs a filter with a covariance: mbkf15",
    ),
    "smooth's options": (
        lambda d, _: dlkf.smooth(d["imu"], d["gnss"], leverarm=(0, 0, 0)),
        "smooth has no option leverarm; did you mean lever_arm?",
    ),
    "no outage": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=0),
        "outage_s is 0, must be a number above 0",
    ),
    "an outage of letters": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s="30 s"),
        "outage_s is '30 s', must be a number above 0",
    ),
    "an outage of NaN": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=float("nan")),
        "outage_s is nan, must be a number above 0",
    ),
    "an outage of a day": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"], models="ins", outage_s=86400),
        "give a smaller outage_s, or a longer drive",
    ),
    "no filters": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=[]),
        "models is [], must be a name or a list of names",
    ),
    "filters of a number": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=5),
        "models is 5, must be a name or a list of names",
    ),
    "one of two misspelt": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=["mbkf15", "plsu"]),
        "unknown model 'plsu'; did you mean plus?",
    ),
    "a reference of names": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], "truth.csv"),
        "reference is a str, must be a pandas DataFrame",
    ),
    "a reference without places": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"][["t", "roll"]]),
        "reference: column lat_deg, lon_deg, height_m missing",
    ),
    "a reference of another day": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], plus(86_400.0)(d["reference"]), models="mbkf15", outage_s=10),
        "without reference= the drive smoothed with its fixes is one",
    ),
    "a reference in degrees": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], times(1 / PI, "roll", "pitch", "yaw")(d["reference"])),
        "reference: yaw reaches 180.0: looks like degrees",
    ),
    "a reference of another place": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"].assign(lat_deg=d["reference"].lat_deg + 1)),
        "reference: lies 111 km from the fixes in the median; give the reference of this drive",
    ),
    "a reference of NaN": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"].assign(lat_deg=np.nan), models="ins"),
        "has no valid reference to score against; without reference= the drive smoothed",
    ),
    "a car misspelt": (
        lambda d, _: dlkf.simulate("lifelik"),
        "unknown simulated preset 'lifelik'; did you mean lifelike?",
    ),
    "a car of a number": (lambda d, _: dlkf.simulate(5), "simulated is 5, must be the name of a preset"),
    "no minutes": (lambda d, _: dlkf.simulate(minutes=0), "minutes is 0, must be a number above 0"),
    "minutes in words": (lambda d, _: dlkf.simulate(minutes="ten"), "minutes is 'ten', must be a number above 0"),
    "no drives": (lambda d, _: dlkf.simulate(drives=0), "drives is 0, must be a whole number from 1 on"),
    "half a drive": (lambda d, _: dlkf.simulate(drives=1.5), "drives is 1.5, must be a whole number"),
    "a seed below 0": (lambda d, _: dlkf.simulate(seed=-1), "seed is -1, must be a whole number from 0 on"),
    "a seed in words": (lambda d, _: dlkf.simulate(seed="a"), "seed is 'a', must be a whole number"),
    "an imu misspelt": (lambda d, _: dlkf.simulate(imu_type="automotiv_mems"), "did you mean automotive_mems?"),
    "logs of nowhere": (lambda d, here: dlkf.read_logs(here / "nowhere"), "nowhere: no such file or folder"),
    "logs of nothing": (
        lambda d, here: dlkf.read_logs(None),
        "source is a NoneType, must be the path of a file or a folder",
    ),
    "an empty folder": (lambda d, here: dlkf.read_logs(here), "holds no log that can be recognised"),
    "half a table of fixes": (
        lambda d, here: dlkf.read_logs(half_a_parquet(d, here)),
        "gnss.parquet: not a whole Parquet or Feather file",
    ),
    "an archive among the files": (
        lambda d, here: dlkf.read_logs(zipped(here)),
        "log.zip (a .zip; give it as source, or unpack it)",
    ),
    "a picture": (
        lambda d, here: dlkf.read_logs(picture(here)),
        "no IMU found in car.png (of no format that is known)",
    ),
    "a reader misspelt": (
        lambda d, here: dlkf.read_logs(here, "atuo"),
        "unknown reader preset 'atuo'; did you mean auto?",
    ),
    "a reader's preset of another kind": (lambda d, here: dlkf.read_logs(here, "ubx"), "no file *.ubx"),
    "no model of that name": (lambda d, _: dlkf.load("mbkf99"), "unknown model 'mbkf99'"),
    "a model of a number": (lambda d, _: dlkf.load(5), "model is a int, must be a name"),
    "a folder without weights": (
        lambda d, here: dlkf.load(str(here)),
        "has no config.yaml; a model is weights.safetensors beside config.yaml",
    ),
    "a stream at no rate": (lambda d, _: dlkf.Stream("mbkf15", rate_hz=0), "rate_hz is 0, must be a number above 0"),
    "a stream's option": (
        lambda d, _: dlkf.Stream("mbkf15", historys=3),
        "Stream has no option historys; did you mean history_s?",
    ),
    "a stream's history": (
        lambda d, _: dlkf.Stream("mbkf15", history_s=-1),
        "history_s is -1, must be a finite number ≥ 0",
    ),
    "a stream that looks ahead": (
        lambda d, _: dlkf.Stream("mbkf21_rts"),
        "looks ahead, which a stream cannot; take it without _rts",
    ),
    "a stream's arm": (
        lambda d, _: dlkf.Stream("mbkf15", lever_arm=(1, 2, "x")),
        "lever_arm is (1, 2, 'x'), must be three numbers",
    ),
    "a format": (lambda d, here: solved(d).export(here, "shp"), "export=shp: unknown format; known: geojson"),
    "no format": (lambda d, here: solved(d).export(here, []), "formats is [], must be a name or a list of names"),
    "a format that is nothing": (lambda d, here: solved(d).export(here, None), "formats is None, must be a name"),
    "an export to nowhere": (lambda d, _: solved(d).export(None, "gpx"), "folder is None, must be a path"),
    "a date": (
        lambda d, here: solved(d).export(here, "gpx", start_utc="yesterday at noon"),
        "start_utc is 'yesterday at noon', must be a date and time",
    ),
    "a folder that is a file": (lambda d, here: solved(d).export(picture(here), "gpx"), "car.png cannot be written to"),
}


def picture(here: Path) -> Path:
    """A file that is no log."""
    file = here / "car.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    return file


def half_a_parquet(frames: Frames, here: Path) -> Path:
    """A folder of a drive whose fixes were not copied whole."""
    for kind in ("imu", "gnss"):
        frames[kind].to_parquet(here / f"{kind}.parquet")
    (here / "gnss.parquet").write_bytes((here / "gnss.parquet").read_bytes()[:500])
    return here


def zipped(here: Path) -> Path:
    """A folder that holds an archive alone, cut short."""
    (here / "log.zip").write_bytes(b"PK\3\4" + bytes(range(256)))
    return here


def solved(frames: Frames) -> dlkf.Solution:
    """A solution, by the fastest filter."""
    return dlkf.navigate(frames["imu"], frames["gnss"], model="ins", rate_hz=10)


SOLVE = ("navigate", "dataset=town", "out=made", "model=mbkf15", *FAST["navigate"])
SCORE = ("evaluate", "dataset=town", "out=made", "model=mbkf15", *FAST["evaluate"])
COMMANDS: dict[str, tuple[tuple[str, ...], str]] = {
    "a key misspelt": ((*SOLVE, "datset=town"), "unknown config key 'datset'; did you mean dataset?"),
    "a dataset misspelt": ((*SOLVE, "dataset=twon"), "dataset twon: no such folder; did you mean town?"),
    "a table of a dataset": (
        (*SOLVE, "dataset=town/drives.parquet"),
        "dataset town/drives.parquet: is a file; give its folder, town",
    ),
    "a folder of a dataset": (
        (*SOLVE, "dataset=town/imu"),
        "dataset town/imu: drives.parquet is missing; it lies in town",
    ),
    "a filter misspelt": ((*SOLVE, "model=pluss"), "unknown model 'pluss'; did you mean plus?"),
    "an imu's preset misspelt": (
        (*SOLVE, "imu=consumr"),
        "unknown preset or config 'imu/consumr'; did you mean consumer?",
    ),
    "out in the dataset": (
        (*SOLVE, "out=town/solved"),
        "out=town/solved lies in the dataset town; give a folder outside it",
    ),
    "out is the dataset": (
        (*SOLVE, "out=town", "overwrite=true"),
        "out=town is the dataset itself; give another folder",
    ),
    "out is a file": ((*SOLVE, "out=town/drives.parquet"), "out=town/drives.parquet lies in the dataset town"),
    "out below a file": ((*SOLVE, "out=town/drives.parquet/x"), "lies in the dataset town"),
    "out where nobody writes": ((*SOLVE, "out=/proc/made"), "out=/proc/made: cannot write there"),
    "an aid misspelt": ((*SOLVE, "aids=[sped]"), "aids: unknown 'sped'; known: speed, heading, baro"),
    "an aid that is not there": ((*SOLVE, "aids=[speed]"), "aids: no drive of town has speed/; leave it out"),
    "a rate of text": ((*SOLVE, "rate_hz=fast"), "rate_hz is 'fast', must be a number or null"),
    "a noise below 0": ((*SOLVE, "imu.accel.noise_density=-1"), "noise_density is -1.0, must be a finite number ≥ 0"),
    "a noise of text": ((*SOLVE, "imu.gyro.noise_density=low"), "gyro.noise_density is 'low', must be a number"),
    "a tuning below 0": ((*SOLVE, "tuning.velocity_std=-2"), "tuning: velocity_std is -2, must be above 0"),
    "a tuning that is none": (
        (*SOLVE, "tuning.velocty_std=2"),
        "unknown config key 'tuning.velocty_std'; did you mean tuning.velocity_std?",
    ),
    "an alignment below 0": ((*SOLVE, "align.speed=-3"), "unknown config key 'align.speed'"),
    "an outage below 0": ((*SCORE, "outage.duration_s=-3"), "outage.duration_s is -3, must be a number ≥ 0"),
    "an outage with its unit": ((*SCORE, "outage.duration_s=60s"), "outage.duration_s is '60s', must be a number"),
    "no length": ((*SCORE, "length_s=0"), "length_s=0 must be above 0 s"),
    "a step back": ((*SCORE, "stride_s=-1"), "stride_s=-1 must be above 0 s"),
    "a baseline misspelt": (
        (*SCORE, "baseline=mbkf51"),
        "baseline=mbkf51 is none of the models mbkf15; did you mean mbkf15?",
    ),
    "a mode misspelt": ((*SCORE, "mode=drive"), "mode=drive is none of auto, segments, drives"),
    "an equals sign too few": ((*SCORE, "overwrite"), "cannot read 'overwrite'; settings are key=value"),
    "a space round the equals sign": ((*SCORE, "seed", "=", "3"), "cannot read 'seed'; settings are key=value"),
    "a reader that is none": (
        ("ingest", "reader=atuo", "source=town", "out=made"),
        "unknown preset or config 'reader/atuo'; did you mean auto?",
    ),
    "a source of nowhere": (
        ("ingest", "reader=auto", "source=nowhere", "out=made"),
        "source=nowhere: no such file or folder",
    ),
    "a source that is missing": (("ingest", "reader=auto", "out=made"), "source is missing; give source=…"),
    "a dataset for logs": (("ingest", "reader=csv", "source=town", "out=made"), "town: is a dataset already"),
    "a car that is none": (
        ("simulate", "dataset=lifelik", "out=made"),
        "unknown preset or config 'simulated/lifelik'; did you mean lifelike?",
    ),
    "hours in words": (
        ("simulate", "dataset=city", "dataset.hours=ten", "out=made"),
        "dataset.hours is 'ten', must be a number",
    ),
    "a rate below zero": (
        ("simulate", "dataset=city", "dataset.imu_rate_hz=-50", "out=made"),
        "imu_rate_hz is -50, must be from 10 to 2000",
    ),
    "an experiment misspelt": (
        ("train", "+experiment=outag"),
        "unknown preset or config 'experiment/outag'; did you mean outage?",
    ),
    "an experiment without its plus": (("train", "experiment=outage"), "a preset is chosen with a plus: +experiment=…"),
    "a British optimiser": (
        ("train", "optimiser.lr=1e-3"),
        "unknown config key 'optimiser.lr'; did you mean optimizer.lr?",
    ),
    "a rate that learns backwards": (
        ("train", "data.datasets=[town]", "optimizer.lr=-1"),
        "optimizer: lr is -1, must be from 0 to 1000",
    ),
    "no epochs": (
        ("train", "data.datasets=[town]", "trainer.max_epochs=0"),
        "trainer: max_epochs is 0, must be from 1",
    ),
    "a folder that is no run": (("compare", "town", "town", "out=made"), "town is given twice"),
    "a drive that is none": (
        ("doctor", "dataset=town", "drives=[monday]"),
        "dataset town: no drive monday; has town-3-00000",
    ),
    "a command misspelt": (("__main__", "navigat", "dataset=town"), "unknown command 'navigat'; did you mean navi"),
}


def test_there_are_a_hundred_and_twenty() -> None:
    assert len(BAD_FRAMES) + len(CALLS) + len(COMMANDS) >= 120


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_frame(case: str, frames: Frames) -> None:
    which, spoil, said = BAD_FRAMES[case]
    tables = {k: frames[k] for k in ("imu", "gnss")} | {which: spoil(frames[which])}
    with pytest.raises(dlkf.InputError) as error:
        dlkf.navigate(tables.pop("imu"), tables.pop("gnss"), model="mbkf21_nhc", **tables)
    check(str(error.value), said)


@pytest.mark.parametrize("case", CALLS)
def test_a_call(case: str, frames: Frames, tmp_path: Path) -> None:
    act, said = CALLS[case]
    with pytest.raises(dlkf.InputError) as error:
        act(frames, tmp_path)
    check(str(error.value), said)


@pytest.mark.parametrize("case", COMMANDS)
def test_a_command(case: str, simulated: Path, call, tmp_path: Path) -> None:
    words, said = COMMANDS[case]
    shutil.copytree(simulated, tmp_path / "town")
    ended = call(*words)
    is_refused(ended, said, folder=tmp_path)
    assert said, ended.err


def check(line: str, said: str) -> None:
    """One line, short, which says this and names no file of the temporary dataset."""
    assert "\n" not in line and len(line) < LONGEST, line
    assert "drive=frames" not in line and "/tmp" not in line.replace("/tmp/pytest", ""), line
    assert said, line
    assert said in line, line
