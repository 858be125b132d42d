"""Every kind of bad input is told in one line that names the drive; good and odd data pass."""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.plausibility import check_gnss_units, check_imu_units
from dlkf.data.readers.units import LENGTH
from dlkf.data.schema import VELOCITY, drive_file, write_drive, write_drives_table
from dlkf.data.store import load_dataset
from dlkf.data.validate import LIMITS, Limits, find_gaps, read_drive, validate_dataset
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.motion.routes import Manoeuvres, VehicleConfig
from tests.cars import REAL, Tables
from tests.running.streams import IMU

NAME = "town-7"


def _write(folder, tables: Tables) -> None:
    row = write_drive(folder, {"drive": NAME}, tables["imu"], tables["gnss"], tables.get("reference"))
    write_drives_table(folder, [row])


def _complaint(folder, **kwargs) -> str:
    with pytest.raises(InputError) as error:
        validate_dataset(folder, **kwargs)
    text = str(error.value)
    assert "\n" not in text and len(text) < 400
    return text


_NO_VELOCITY = dict.fromkeys(VELOCITY, np.nan)


def _again(times: int):
    """Every fix so many times at a rate that the receiver has not."""
    return lambda f: pd.concat([f.assign(t=f["t"] + k / times) for k in range(times)]).sort_values("t")[: -times + 1]


def _set(kind: str, column: str, change):
    def apply(tables: Tables) -> Tables:
        frame = tables[kind].copy()
        frame[column] = change(frame[column].to_numpy().copy())
        return {**tables, kind: frame}

    return apply


def _rows(kind: str, pick):
    return lambda tables: {**tables, kind: pick(tables[kind]).reset_index(drop=True)}


def _at(row: int, value):
    def change(x: np.ndarray) -> np.ndarray:
        x[row] = value
        return x

    return change


def _columns(kind: str, change):
    def apply(tables: Tables) -> Tables:
        frame = tables[kind].copy()
        change(frame)
        return {**tables, kind: frame}

    return apply


def _swap(a: str, b: str):
    def change(frame: pd.DataFrame) -> None:
        frame[a], frame[b] = frame[b].copy(), frame[a].copy()

    return change


def _scale(names: list[str], factor):
    def change(frame: pd.DataFrame) -> None:
        frame[names] = frame[names] * factor

    return change


def _turn_velocities(frame: pd.DataFrame) -> None:
    """To the right, as of a course that counts from East."""
    frame["vel_n"], frame["vel_e"] = -frame["vel_e"], frame["vel_n"].copy()


def _course_in_radians(tables: Tables) -> Tables:
    """Read as degrees."""
    gnss = tables["gnss"]
    speed, course = np.hypot(gnss.vel_n, gnss.vel_e), np.arctan2(gnss.vel_e, gnss.vel_n) % (2 * np.pi)
    read = np.radians(course)
    return {**tables, "gnss": gnss.assign(vel_n=speed * np.cos(read), vel_e=speed * np.sin(read))}


def _nowhere(frame: pd.DataFrame) -> pd.DataFrame:
    """Three fixes before the receiver has a position."""
    return frame.assign(**{c: frame[c].where(frame.index >= 3, 0.0) for c in ("lat_deg", "lon_deg")})


def _quarter(frame: pd.DataFrame) -> pd.DataFrame:
    """The sensor's x points right, its y back."""
    turned = {f"{s}_x": frame[f"{s}_y"] for s in ("gyro", "accel")}
    return frame.assign(**turned, **{f"{s}_y": -frame[f"{s}_x"] for s in ("gyro", "accel")})


def _feet(height: np.ndarray) -> np.ndarray:
    """Of a steep road, whose heights are those of its fixes times 3.28."""
    return height / 0.3048 + np.linspace(0, 100, len(height))


def _look_back(tables: Tables) -> Tables:
    """The sensor's x points back, and so does the heading of its reference: also a car in reverse all the time."""
    return _rows("imu", _half_turn)(_set("reference", "yaw", lambda y: y + np.pi)(tables))


def _half_turn(frame: pd.DataFrame) -> pd.DataFrame:
    """The sensor's x points back."""
    return frame.assign(**{name: -frame[name] for name in ("accel_x", "accel_y", "gyro_x", "gyro_y")})


GYRO, ACCEL = ["gyro_x", "gyro_y", "gyro_z"], ["accel_x", "accel_y", "accel_z"]


def _turn_up(tables: Tables) -> Tables:
    """The gyroscope's z counts the other way, beside a receiver without velocities."""
    gnss = tables["gnss"].assign(**dict.fromkeys(("vel_n", "vel_e", "vel_d"), np.nan))
    return {**_columns("imu", _scale(["gyro_z"], -1))(tables), "gnss": gnss}


def _freeze(first: int, last: int):
    def frozen(f):
        values = f[[*ACCEL, *GYRO]].to_numpy().copy()
        values[first:last] = values[first]
        return f.assign(**dict(zip((*ACCEL, *GYRO), values.T)))

    return _rows("imu", frozen)


BAD = {
    "nan in the IMU": (_set("imu", "gyro_y", _at(17, np.nan)), "row 17: gyro_y is nan"),
    "inf in the IMU": (_set("imu", "accel_x", _at(18, np.inf)), "row 18: accel_x is inf"),
    "time goes back": (_set("imu", "t", _at(100, 0.5)), "row 100: t goes back"),
    "ms of 16 bits": (_set("imu", "t", lambda t: (t + 40) % 65.536), "every 65.536 s: reader.imu.time.wraps_s=65.536"),
    "us of 32 bits": (_set("imu", "t", lambda t: (t + 4260) % 4294.967296), r"wraps_s=4294.967296"),
    "another counter": (_set("imu", "t", lambda t: (t + 1) % 20), r"t goes back .*wraps_s=20$"),
    "each second": (_set("imu", "t", lambda t: np.where(t > 30, t + 0.6, t) % 1), r"every 1 s: .*time\.wraps_s=1$"),
    "set back again and again": (_set("imu", "t", lambda t: t - 0.4 * np.floor(t / 10)), "t goes back .*sort the rows"),
    "clock set back": (_set("imu", "t", lambda t: np.where(t > 30, t - 20, t)), "the clock was set back there"),
    "stamps of a host that gets packets of four": (
        _set("imu", "t", lambda t: np.ceil(np.arange(1, len(t) + 1) / 4) * 0.04 + 1e-4 * (np.arange(len(t)) % 4)),
        "75 % of the samples came with the one before, .*respace=true",
    ),
    "duplicate stamp": (_set("imu", "t", lambda t: _at(100, t[99])(t)), "row 100: t = 1.0.* appears twice"),
    "ms taken for s": (_set("imu", "t", lambda t: 1000 * t), "row.* a second, an IMU has 1 to 10000: .*imu.time.unit"),
    "ns taken for s": (_set("imu", "t", lambda t: 1e9 * t), "reader.imu.time.unit"),
    "s taken for us": (_set("imu", "t", lambda t: 1e-6 * t), "reader.imu.time.unit"),
    "GNSS in another unit": (_set("gnss", "t", lambda t: 1e-3 * t), "a receiver has .*reader.gnss.time.unit"),
    "GNSS in ms": (_set("gnss", "t", lambda t: 5000 * t), r"t looks like ms.* by 1000 \(reader.gnss.time.unit=ms"),
    "a single fix": (_rows("gnss", lambda f: f[:1].assign(t=0.0)), "the only fix, at t = 0.000, .*all along the drive"),
    "nan time": (_set("gnss", "t", _at(3, np.nan)), "row 3: t is nan"),
    "frozen IMU": (_freeze(3000, 3100), r"the same sample from t = 30\.0.* a frozen IMU"),
    "samples of a busy host": (
        _set("imu", "t", lambda t: np.concatenate((t[:1000], t[1029] - 1e-4 * np.arange(29, -1, -1), t[1030:]))),
        "its samples come at once after it, as a host stamps them that was busy",
    ),
    "IMU gap": (_rows("imu", lambda f: f.drop(f.index[1000:1100])), "IMU gap of 1.010 s after t = 10.000"),
    "no samples": (_rows("imu", lambda f: f.iloc[:0]), "has no rows"),
    "no fixes": (_rows("gnss", lambda f: f.iloc[:0]), "has no rows"),
    "no fix at all": (_set("gnss", "quality", lambda q: 0 * q), "no GNSS fix at all"),
    "degrees per second": (_columns("imu", _scale(GYRO, 180 / np.pi)), "looks like degrees"),
    "velocities of 0 that are unknown": (_columns("gnss", _scale(["vel_n", "vel_e"], 0.0)), "are 0 in every row .*NaN"),
    "a gyroscope of another range": (_columns("imu", _scale(GYRO, 0.5)), "0.50 times .*multiply gyro by 2"),
    "radians taken for degrees": (_columns("imu", _scale(GYRO, np.pi / 180)), "gyro_z is 0.017.*not in rad/s"),
    "g": (_columns("imu", _scale(ACCEL, 1 / 9.80665)), "looks like g; reader.imu.accel.unit=g"),
    "no gravity": (_columns("imu", _scale(["accel_z"], 0.01)), "median specific force"),
    "z up": (_columns("imu", _scale(["accel_y", "accel_z", "gyro_y", "gyro_z"], -1)), "points up"),
    "gyro z up": (_columns("imu", _scale(["gyro_z"], -1)), "gyro_z turns against the course"),
    "gyro z up, positions alone": (_turn_up, "gyro_z turns against the course"),
    "wrong axis": (_columns("imu", _swap("accel_x", "accel_z")), "gravity lies on accel_x"),
    "swapped position": (_columns("gnss", _swap("lat_deg", "lon_deg")), "latitude and longitude look"),
    "latitude out of range": (_columns("gnss", _scale(["lat_deg"], 2)), "lat_deg is 97.*swapped"),
    "radians": (_columns("gnss", _scale(["lat_deg", "lon_deg"], np.pi / 180)), "look like radians"),
    "swapped velocity": (_columns("gnss", _swap("vel_n", "vel_e")), "vel_n and vel_e look swapped"),
    "a course in radians": (_course_in_radians, "as of a course in radians"),
    "velocities across the way": (_columns("gnss", _turn_velocities), "off by .* of the way"),
    "km/h": (_columns("gnss", _scale(["vel_n", "vel_e", "vel_d"], 3.6)), "km/h"),
    "velocities divided by 3.6": (_columns("gnss", _scale(["vel_n", "vel_e", "vel_d"], 1 / 3.6)), "divided by 3.6"),
    "no position yet": (_rows("gnss", _nowhere), "fix 0 is at 0°/0°, as 3 of .*reader.gnss.position.zero=none"),
    "jumps": (_set("gnss", "lat_deg", _at([5, 9, 13], -40.0)), "fix 5 lies .* km from the rest"),
    "leap seconds": (_set("gnss", "t", lambda t: t - 18), r"clocks of IMU and GNSS are 18.0 s apart.*offset_s=auto"),
    "turned right": (_rows("imu", _quarter), r"turned by \+90° .*reader.imu.accel.axes"),
    "another clock": (_set("gnss", "t", lambda t: t + 1e5), "same clock"),
    "fixes of a logger": (_rows("gnss", _again(5)), "100 % of the fixes .*first row of each .*gnss.rows=changed"),
    "positions of a logger": (_rows("gnss", lambda f: _again(2)(f.assign(**_NO_VELOCITY))), "come several times"),
    "an IMU of a moment": (_rows("imu", lambda f: f[:50]), r"share 0.5 s with the IMU, from 0.010 to 0.500; give logs"),
    "negative std": (_set("gnss", "std_pos_n", _at(2, -1.0)), "row 2: std_pos_n is -1.0"),
    "attitude in degrees": (_columns("reference", _scale(["yaw"], 180 / np.pi)), "yaw reaches .* degrees"),
    "yaw from East": (_set("reference", "yaw", lambda y: np.pi / 2 - y), "yaw counts from East"),
    "yaw of the right": (_set("reference", "yaw", lambda y: y + np.pi / 2), r"\+90° from the course.*subtract 1.57"),
    "yaw of the left": (_set("reference", "yaw", lambda y: y - np.pi / 2), "-90° from the course.*add 1.57"),
    "yaw of the back": (_set("reference", "yaw", lambda y: y + np.pi), "yaw is 180° from the course"),
    "an IMU that looks back": (_rows("imu", _half_turn), "yaw is along the course, but the IMU looks back: .*yaw: 180"),
    "a second late": (_set("reference", "t", lambda t: t + 1), "1.0 s ahead of that of GNSS; subtract 1.0 s from t"),
    "leap seconds early": (_set("reference", "t", lambda t: t - 18), "18.0 s behind.*leap seconds.*add 18.0 s to t"),
    "above the geoid": (_set("reference", "height_m", lambda h: h - 47), "47 m below the fixes.*geoid.*position.geoid"),
    "far above": (_set("reference", "height_m", lambda h: h + 50), "50 m above the fixes.*sea level"),
    "heights in feet": (_set("reference", "height_m", _feet), "in the median; height_m must be in metres"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_numbers(tmp_path, tables, case):
    change, expected = BAD[case]
    _write(tmp_path, change(tables))
    text = _complaint(tmp_path)
    assert NAME in text
    import re

    assert re.search(expected, text), text


ALONE = ["vel_n", "vel_e", "vel_d"]
MIRRORED = {
    "gyro z up": _columns("imu", _scale(["gyro_z"], -1)),
    "swapped position": _columns("gnss", _swap("lat_deg", "lon_deg")),
    "west of Greenwich": _columns("gnss", _scale(["lon_deg"], -1)),
}


@pytest.mark.parametrize("case", MIRRORED)
def test_positions_alone_show_turns_the_other_way(tmp_path, tables, case):
    """As they show those of a sensor in another unit; half a metre of noise hides neither, and is no fault itself."""
    noise = 0.5 / 111e3 * np.random.default_rng(2).standard_normal((len(tables["gnss"]), 2))
    gnss = tables["gnss"].assign(**dict.fromkeys(ALONE, np.nan))
    gnss[["lat_deg", "lon_deg"]] += noise
    alone = {**tables, "gnss": gnss}
    _write(tmp_path, alone)
    validate_dataset(tmp_path)
    _write(tmp_path, MIRRORED[case]({k: v for k, v in alone.items() if k != "reference"}))
    said = _complaint(tmp_path, reference=False)
    assert "gyro_z turns against the course" in said and "latitude and longitude are exchanged" in said
    _write(tmp_path, _columns("imu", _scale(GYRO, 180 / np.pi / 10))(alone))
    assert "times the turn of the course" in _complaint(tmp_path)


def test_swapped_positions_of_a_drive_along_the_diagonal(tmp_path, tables):
    """Mostly north-east at 48° north: exchanged they are off by a third in the median."""
    t = tables["gnss"].t.to_numpy()
    north, east = np.cumsum(np.full(len(t), 9.0)), np.cumsum(np.where(np.arange(len(t)) % 20 < 15, 7.0, 0.5))
    gnss = tables["gnss"].assign(lat_deg=48.0 + np.degrees(north / 6.37e6), vel_n=9.0, vel_e=np.diff(east, prepend=0.0))
    gnss = gnss.assign(lon_deg=9.0 + np.degrees(east / 6.38e6 / np.cos(np.radians(48.0))))
    check_gnss_units({c: gnss[c].to_numpy() for c in gnss}, "here")
    exchanged = gnss.rename(columns={"lat_deg": "lon_deg", "lon_deg": "lat_deg"})
    with pytest.raises(InputError, match="latitude and longitude look swapped"):
        check_gnss_units({c: exchanged[c].to_numpy() for c in exchanged}, "here")


def hilly(gnss: pd.DataFrame, unit_m: float, noise_m: float) -> pd.DataFrame:
    """Fixes over hills of 10 m, their heights in a unit of ``unit_m``."""
    rise = 2 * np.pi / 50.0
    noise = noise_m * np.random.default_rng(1).standard_normal(len(gnss))
    height = (100.0 + 10.0 * np.sin(rise * gnss["t"]) + noise) / unit_m
    return gnss.assign(height_m=height, vel_d=-10.0 * rise * np.cos(rise * gnss["t"]))


@pytest.mark.parametrize("noise_m", [0.02, 1.0])
@pytest.mark.parametrize("unit", ["m", "mm", "cm", "km", "ft", "4 m"])
def test_heights_in_another_unit_are_refused(tmp_path, tables, unit, noise_m):
    """Also through the height noise of a single-frequency receiver, which raises no alarm in metres; a ratio of no unit
    is refused as such."""
    gnss = hilly(tables["gnss"], {**LENGTH, "4 m": 4.0}[unit], noise_m)
    _write(tmp_path, {**tables, "gnss": gnss})
    if unit == "m":
        validate_dataset(tmp_path, reference=False)
        return
    said = _complaint(tmp_path, reference=False)
    assert f"height_unit={unit}, or multiply" in said or (unit == "4 m" and "one of them is in another unit" in said)


@pytest.mark.parametrize("kind", ["imu", "gnss", "reference"])
def test_damaged_files(tmp_path, tables, kind):
    _write(tmp_path, tables)
    path = drive_file(tmp_path, kind, NAME)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    text = _complaint(tmp_path)
    assert NAME in text and "not a whole Parquet file" in text
    path.write_bytes(b"")
    assert "not a whole Parquet file" in _complaint(tmp_path)
    frame = tables[kind].drop(columns=tables[kind].columns[1])
    frame.to_parquet(path)
    text = _complaint(tmp_path)
    assert NAME in text and f"column {tables[kind].columns[1]} missing" in text
    frame = tables[kind].copy()
    frame[frame.columns[2]] = frame[frame.columns[2]].astype(str)
    frame.to_parquet(path)
    text = _complaint(tmp_path)
    assert NAME in text and "must be double" in text


def test_missing_parts(tmp_path, tables):
    assert "no such folder" in _complaint(tmp_path / "nowhere")
    assert "drives.parquet is missing" in _complaint(tmp_path)
    _write(tmp_path, tables)
    shutil.move(tmp_path / "gnss", tmp_path / "gps")
    assert f"drive {NAME}: no GNSS" in _complaint(tmp_path)
    shutil.move(tmp_path / "gps", tmp_path / "gnss")
    shutil.rmtree(tmp_path / "imu" / f"drive={NAME}")
    assert f"drive {NAME}: imu/drive={NAME}/ has no Parquet file" in _complaint(tmp_path)
    row = {"drive": NAME}
    write_drives_table(tmp_path, [row, row])
    assert "appears twice" in _complaint(tmp_path)


def test_what_a_source_does_not_know_may_be_nan(tmp_path, tables):
    gnss = tables["gnss"].copy()
    gnss[[c for c in gnss if c.startswith("std") or c == "vel_d"]] = np.nan
    reference = tables["reference"].copy()
    reference[["roll", "pitch", "yaw"]] = np.nan
    _write(tmp_path, {**tables, "gnss": gnss, "reference": reference})
    assert [row.name for row in validate_dataset(tmp_path)] == [NAME]
    _write(tmp_path, {**tables, "gnss": gnss.assign(vel_n=np.nan, vel_e=np.nan)})
    validate_dataset(tmp_path)


def test_folders_of_another_name_are_named(tmp_path, tables):
    _write(tmp_path, tables)
    for kind in ("imu", "gnss", "reference"):
        (tmp_path / kind / f"drive={NAME}").rename(tmp_path / kind / "drive=other")
    assert "is in drives.parquet, but imu/ has drive=other alone" in _complaint(tmp_path)


def test_whole_numbers_may_stand_for_floats(tmp_path, tables):
    _write(tmp_path, tables)
    path = drive_file(tmp_path, "gnss", NAME)
    tables["gnss"].assign(height_m=200, quality=np.float32(4)).to_parquet(path)
    drive = load_dataset(tmp_path)[0]
    assert set(drive.quality.tolist()) == {4}


def test_a_broken_reference_is_not_opened_where_none_is_asked_for(tmp_path, tables):
    _write(tmp_path, tables)
    drive_file(tmp_path, "reference", NAME).write_bytes(b"no Parquet")
    assert len(validate_dataset(tmp_path, reference=False)) == 1
    assert not load_dataset(tmp_path, reference=False)[0].ref_valid.any()
    shutil.rmtree(tmp_path / "reference")
    assert not load_dataset(tmp_path)[0].ref_valid.any()


def test_a_sample_may_be_repeated_for_half_a_second(tmp_path, tables):
    _write(tmp_path, _freeze(3000, 3050)(tables))
    assert len(validate_dataset(tmp_path)) == 1


def test_limits_of_gaps_are_configurable(tmp_path, tables):
    _write(tmp_path, _rows("imu", lambda f: f.drop(f.index[1000:1020]))(tables))
    (row,) = validate_dataset(tmp_path)  # 0.21 s
    with pytest.raises(InputError, match=r"IMU gap of 0\.210"):
        read_drive(tmp_path, row, limits=Limits(gap_s=0.1))


def test_noisy_gnss_raises_no_alarm(tmp_path, tables):
    """Position noise of 5 m and velocity noise of 2 m/s, more than the degraded sets (paper.md 2.10)."""
    rng = np.random.default_rng(1)
    gnss = tables["gnss"].copy()
    for names, sigma in ((["lat_deg", "lon_deg"], 5 / 111e3), (["vel_n", "vel_e", "vel_d"], 2.0)):
        gnss[names] += sigma * rng.standard_normal((len(gnss), len(names)))
    _write(tmp_path, {**tables, "gnss": gnss})
    validate_dataset(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        _look_back,
        _set("reference", "t", lambda t: t - 0.45),
        _set("reference", "height_m", lambda h: h + 10),
        _set("reference", "height_m", lambda h: 0 * h),
        _set("gnss", "height_m", lambda h: 0 * h),
        _columns("gnss", lambda f: f.update({"height_m": f["height_m"] + 50, "std_pos_d": 0 * f["std_pos_d"] + 15})),
        _set("reference", "yaw", lambda y: y + np.radians(20)),
    ],
    ids=[
        "reverse",
        "late receiver",
        "antenna and datum",
        "no heights",
        "no heights of fixes",
        "unsure heights",
        "turned a little",
    ],
)
def test_references_that_differ_within_reason_pass(tmp_path, tables, change):
    """As far as a receiver's own 1σ, a mounting and unknown heights let them."""
    _write(tmp_path, change(tables))
    validate_dataset(tmp_path)


def test_reversing_raises_no_alarm(tmp_path):
    """A car that goes backwards at more than 3 m/s nearly all the time: its yaw is 180° from the course, rightly."""
    mostly = Manoeuvres(stretch=0.1, turn=0.0, stop=0.0, eight=0.0, reverse=0.9)
    config = DatasetConfig("yard", hours=0.1, drive_minutes=3.0, vehicle=VehicleConfig(manoeuvres=mostly))
    simulate_dataset(config, IMU, 1, tmp_path / "yard", progress=False, workers=1)
    reference = pd.read_parquet(drive_file(tmp_path / "yard", "reference", "yard-1-00000"))
    course = np.arctan2(reference["vel_e"], reference["vel_n"])
    fast = np.hypot(reference["vel_n"], reference["vel_e"]) > 3
    assert fast.sum() > 100 and (np.cos(reference["yaw"] - course)[fast] < 0).mean() > 0.9
    assert len(validate_dataset(tmp_path / "yard")) == 2


@pytest.mark.parametrize("name", ["rtkx", "kitti", "comma2k19", "wid", "wid_mru", "linkoping"])
def test_real_drives_pass(name):
    if not (REAL / name).is_dir():
        pytest.skip("real drives are not here")
    assert validate_dataset(REAL / name)


@pytest.mark.parametrize("n", [2, 3, 100, 101])
def test_shortcuts_of_the_checks_say_what_medians_and_quantiles_say(n):
    """Drives about the limits of force, tilt and rate: refused exactly where the median, or the quantile, is."""
    rng = np.random.default_rng(n)
    refused = 0
    for force, tilt, rate in rng.uniform((6.5, 0.6, 1.0), (13.5, 1.0, 30.0), (200, 3)):
        z = -force * tilt * rng.uniform(0.99, 1.01, n)
        x = force * np.sqrt(1 - tilt**2) * rng.uniform(0.99, 1.01, n)
        gyro = rng.uniform(0, rate, n)
        zero = np.zeros(n)
        imu = {"accel_x": x, "accel_y": zero, "accel_z": z, "gyro_x": gyro, "gyro_y": zero, "gyro_z": zero}
        size = np.median(np.hypot(x, z))
        good = 7 < size < 13 and np.median(z) <= -0.7 * size and np.quantile(gyro, 0.999) <= 20
        refused += not good
        if good:
            check_imu_units(imu, "imu")
        else:
            with pytest.raises(InputError):
                check_imu_units(imu, "imu")
    assert 50 < refused < 190


def test_gaps_are_found_where_a_step_is_long():
    t = np.arange(0, 10, 0.01)
    assert len(find_gaps(t, LIMITS)) == 0 and len(find_gaps(t[:1], LIMITS)) == 0
    assert find_gaps(np.delete(t, slice(500, 530)), LIMITS).tolist() == [500]
    assert len(find_gaps(np.arange(0.0, 10.0, 0.5), LIMITS)) == 0  # slow, without a gap
