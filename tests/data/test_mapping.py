"""Logs as people have them: stamps, angles, heights, frames, rows and files that the mapping explains."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pymap3d
import pytest
from scipy.spatial.transform import Rotation

from dlkf.base.errors import InputError
from dlkf.data.readers.mapping import spread_stamps
from dlkf.data.readers.units import degrees_minutes, leap_seconds, rotation, seconds, unwrap_stamps
from tests.cars import car
from tests.data.logs import metres
from tests.data.logs.clock import GPS, UNIX
from tests.data.test_csv import PLAIN, log_reader


@pytest.fixture(scope="module")
def tables():
    """Half a minute."""
    return car(30)


def read(folder, tables, **changes):
    """The drive of a folder in which the contract's own columns are, but for what ``changes`` says."""
    for kind in ("imu", "gnss"):
        if not (folder / f"{kind}.csv").exists():
            tables[kind].to_csv(folder / f"{kind}.csv", index=False)
    (drive,) = log_reader(**changes).read(folder)
    return drive


ISO = {"T": "%Y-%m-%dT%H:%M:%S.%f", "Z": "%Y-%m-%dT%H:%M:%S.%fZ", "blank": "%Y/%m/%d %H:%M:%S.%f"}


@pytest.mark.parametrize("style", ISO)
def test_calendar_stamps(tmp_path, tables, style):
    stamps = pd.to_datetime(UNIX * 10**9 + np.round(tables["imu"].t * 1e9).astype(np.int64))
    tables["imu"].assign(t=stamps.dt.strftime(ISO[style])).to_csv(tmp_path / "imu.csv", index=False)
    tables["gnss"].assign(t=GPS + tables["gnss"].t).to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(tmp_path, tables, imu__time={"column": "t", "unit": "iso", "clock": "utc"})
    np.testing.assert_allclose(drive.imu.t, tables["imu"].t, atol=1e-6)
    np.testing.assert_allclose(drive.gnss.t, tables["gnss"].t, atol=1e-6)


def test_date_and_time_in_two_columns_and_seconds_of_the_day(tmp_path, tables):
    stamps = pd.to_datetime(UNIX * 10**9 + np.round(tables["imu"].t * 1e9).astype(np.int64))
    split = tables["imu"].assign(day=stamps.dt.strftime("%Y-%m-%d"), t=stamps.dt.strftime("%H:%M:%S.%f"))
    split.to_csv(tmp_path / "imu.csv", index=False)
    midnight = UNIX - UNIX % 86_400
    tables["gnss"].assign(t=UNIX - midnight + tables["gnss"].t).to_csv(tmp_path / "gnss.csv", index=False)
    day = str(np.datetime64(midnight, "s"))[:10]
    drive = read(
        tmp_path,
        tables,
        imu__time={"column": ["day", "t"], "unit": "iso", "clock": "utc"},
        gnss__time={"column": "t", "day": day, "clock": "utc"},
    )
    np.testing.assert_allclose(drive.gnss.t, tables["gnss"].t, atol=1e-6)


@pytest.mark.parametrize(("zone", "ahead_s"), [("", 7200), ("Z", 0), ("+02:00", 0)])
def test_dates_of_local_time_are_told_by_the_imus_unix_time(tmp_path, tables, zone, ahead_s):
    """A zone that a text names is its own; then the clocks are otherwise 2 h apart, which changes no date."""
    shown = pd.to_datetime((UNIX + 7200) * 10**9 + np.round(tables["gnss"].t * 1e9).astype(np.int64))
    tables["gnss"].assign(t=shown.dt.strftime("%d.%m.%Y %H:%M:%S.%f") + zone).to_csv(tmp_path / "gnss.csv", index=False)
    tables["imu"].assign(t=UNIX + tables["imu"].t).to_csv(tmp_path / "imu.csv", index=False)
    offset_s = 0 if zone == "+02:00" else -7200
    drive = read(tmp_path, tables, gnss__time={"column": "t", "unit": "iso", "clock": None, "offset_s": offset_s})
    np.testing.assert_allclose(drive.gnss.t, tables["gnss"].t, atol=1e-6)
    expected = GPS + (7200 if zone == "Z" else 0) - drive.meta["time_zero_s"] + UNIX
    assert drive.meta["gps_zero_s"] == pytest.approx(expected, abs=1e-3)
    assert any("so they are local time" in note for note in drive.notes) == (ahead_s > 0)


@pytest.mark.parametrize("day", [None, "2025-07-05"])
def test_times_of_day_without_a_date_go_on_after_midnight(tmp_path, tables, day):
    """Nor do they get a date that nobody gave, as today's."""
    for kind in ("imu", "gnss"):
        stamps = pd.to_datetime(np.round((86_390 + tables[kind].t) * 1e9).astype(np.int64))
        tables[kind].assign(t=stamps.dt.strftime("%H:%M:%S.%f")).to_csv(tmp_path / f"{kind}.csv", index=False)
    time = {"column": "t", "unit": "iso", "day": day, "clock": "utc" if day else None}
    drive = read(tmp_path, tables, imu__time=time, gnss__time=time)
    np.testing.assert_allclose(drive.imu.t, tables["imu"].t, atol=1e-6)
    np.testing.assert_allclose(drive.gnss.t, tables["gnss"].t, atol=1e-6)
    assert (drive.meta.get("gps_zero_s") is not None) == (day is not None)
    assert any("which have no date; reader.gnss.time.day=" in note for note in drive.notes) == (day is None)


def test_leap_seconds_and_wrapping_counters():
    """IERS Bulletin C: none in 1980, 15 in 2011, 17 from July 2015, 18 since 2017."""
    dates = ["1980-02-01", "2011-09-26", "2015-06-30T23:59:59", "2015-07-01", "2018-01-01"]
    unix = np.array(dates, "datetime64[s]").astype(np.int64)
    assert leap_seconds(unix).tolist() == [0, 15, 16, 17, 18]
    assert unwrap_stamps(np.array([604_799.5, 0.0, 0.5]), 604_800, 1).tolist() == [604_799.5, 604_800.0, 604_800.5]
    assert unwrap_stamps(np.array([500, 100, 50]), 1, 1000).tolist() == [500, 1100, 2050]  # 0.6 s lack
    assert unwrap_stamps(np.array([30.0, 29.9, 30.1]), 65.536, 1).tolist() == [30.0, 29.9, 30.1]  # out of order
    whole, part = seconds(np.array(["2015-07-01T00:00:00.25"]), "iso", None, "gps", "")
    assert whole[0] + part[0] == unix[3] - 315_964_800 + 0.25


def test_degrees_and_minutes_with_hemispheres(tmp_path, tables):
    gnss = tables["gnss"].assign(lat_deg=-tables["gnss"].lat_deg)
    minutes = {c: np.floor(a) * 100 + (a % 1) * 60 for c in ("lat_deg", "lon_deg") for a in [gnss[c].abs()]}
    gnss.assign(**minutes, ns="S", ew="E", vel_n=-gnss.vel_n).to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(tmp_path, tables, gnss__position__unit="ddmm", gnss__position__hemispheres=["ns", "ew"])
    assert metres(drive.gnss, gnss).max() < 1e-4
    np.testing.assert_allclose(degrees_minutes(np.array([4807.038, -1131.0])), [48.1173, -11.516666666667])
    with pytest.raises(
        InputError, match=r"line 2: column 'lat_deg' is .*, which has more than 60 minutes and is no ddmm"
    ):
        only = {name: 60 * (gnss[name].abs() + more) for name, more in (("lat_deg", 1.0), ("lon_deg", 0.0))}
        gnss.assign(**only).to_csv(tmp_path / "gnss.csv", index=False)
        read(tmp_path, tables, gnss__position__unit="ddmm")
    drive = read(tmp_path, tables, gnss__position__unit=0.016666666666667)  # as the line says
    np.testing.assert_allclose(drive.gnss.lat_deg, gnss.lat_deg.abs() + 1.0, atol=1e-9)
    gnss.assign(**minutes, ns="Q", ew="E").to_csv(tmp_path / "gnss.csv", index=False)
    with pytest.raises(InputError, match=r"line 2: column 'ns' is 'Q', must be N or S"):
        read(tmp_path, tables, gnss__position__unit="ddmm", gnss__position__hemispheres=["ns", "ew"])


def test_a_1σ_of_0_is_unknown_and_a_line_says_so(tmp_path, tables):
    gnss = tables["gnss"].copy()
    gnss.loc[:9, ["std_pos_n", "std_vel_d"]] = 0.0
    gnss.loc[0, "quality"] = 0  # no fix: nothing is said of it
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(tmp_path, tables)
    assert drive.gnss.std_pos_n.isna().sum() == drive.gnss.std_vel_d.isna().sum() == 10
    assert not drive.gnss[["std_pos_e", "std_vel_n"]].isna().any(axis=None)
    assert sum("a 1σ of 0 in 9 of" in note for note in drive.notes) == 1


def test_height_above_sea_level(tmp_path, tables):
    gnss = tables["gnss"]
    gnss.assign(height_m=gnss.height_m - 47.1, undulation=47.1).to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(tmp_path, tables, gnss__position__geoid="undulation")
    np.testing.assert_allclose(drive.gnss.height_m, gnss.height_m)


def test_ecef(tmp_path, tables):
    gnss = tables["gnss"]
    x, y, z = pymap3d.geodetic2ecef(gnss.lat_deg, gnss.lon_deg, gnss.height_m)
    v = pymap3d.enu2ecefv(gnss.vel_e, gnss.vel_n, -gnss.vel_d, gnss.lat_deg, gnss.lon_deg)
    odd = pd.DataFrame({"t": gnss.t, "x": x, "y": y, "z": z, **dict(zip(("vx", "vy", "vz"), v)), "s": 0.3})
    odd.to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(
        tmp_path,
        tables,
        gnss__position={"columns": ["x", "y", "z"], "frame": "ecef", "unit": "deg"},  # as csv.yaml leaves it
        gnss__velocity={"columns": ["vx", "vy", "vz"], "frame": "ecef"},
        gnss__std_position={"columns": ["s", "s", "s"], "frame": "ecef"},
        gnss__std_velocity=None,
        gnss__quality=None,
    )
    assert metres(drive.gnss, gnss).max() < 1e-6
    for name in ("vel_n", "vel_e", "vel_d"):
        np.testing.assert_allclose(drive.gnss[name], gnss[name], atol=1e-9)
    np.testing.assert_allclose(drive.gnss.std_pos_n, 0.3)


@pytest.mark.parametrize("convention", ["ned", "enu"])
def test_quaternions(tmp_path, tables, convention):
    reference = tables["reference"]
    turn = Rotation.from_euler("ZYX", reference[["yaw", "pitch", "roll"]].to_numpy())
    if convention == "enu":
        turn = Rotation.from_matrix(rotation("rfu", "").T @ turn.as_matrix() @ rotation("flu", ""))
    odd = reference.assign(**dict(zip(("qx", "qy", "qz", "qw"), turn.as_quat().T)))
    odd.to_csv(tmp_path / "reference.csv", index=False)
    own = {"columns": ["qw", "qx", "qy", "qz"], "convention": convention}
    spec = {"file": "reference.csv", "time": {"column": "t"}, "attitude": own}
    drive = read(tmp_path, tables, reference={**{k: PLAIN["gnss"][k] for k in ("position", "velocity")}, **spec})
    for name in ("roll", "pitch", "yaw"):
        np.testing.assert_allclose(drive.reference[name], reference[name], atol=1e-9)


def test_position_and_velocity_in_two_files(tmp_path, tables):
    """Stamps of the two are 10 ms apart, one velocity is missing."""
    gnss = tables["gnss"]
    gnss.drop(columns=["vel_n", "vel_e", "vel_d"]).to_csv(tmp_path / "gnss.csv", index=False)
    rmc = pd.DataFrame({"time": gnss.t + 0.01, "sog": np.hypot(gnss.vel_n, gnss.vel_e) * 3600 / 1852})
    rmc["cog"] = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    rmc.drop(index=7).to_csv(tmp_path / "rmc.csv", index=False)
    own = {"file": "rmc.csv", "time": {"column": "time"}, "columns": ["sog", "cog"], "unit": "knots", "frame": "course"}
    drive = read(tmp_path, tables, gnss__velocity=own)
    known = np.arange(len(gnss)) != 7
    np.testing.assert_allclose(drive.gnss.vel_e[known], gnss.vel_e[known], atol=1e-9)
    assert np.isnan(drive.gnss.vel_n[7]) and len(drive.gnss) == len(gnss)


def test_gyroscope_in_a_file_of_its_own(tmp_path, tables):
    """Stamps half a sample later: interpolated, the path bends by 1e-5 rad/s within it."""
    imu = tables["imu"]
    imu[["t", "accel_x", "accel_y", "accel_z"]].to_csv(tmp_path / "imu.csv", index=False)
    middle = 0.5 * (imu[["t", "gyro_x", "gyro_y", "gyro_z"]] + imu[["t", "gyro_x", "gyro_y", "gyro_z"]].shift())
    middle.iloc[1:].to_csv(tmp_path / "gyro.csv", index=False)
    drive = read(tmp_path, tables, imu__gyro={"file": "gyro.csv", "columns": ["gyro_x", "gyro_y", "gyro_z"]})
    np.testing.assert_allclose(drive.imu.gyro_z[1:-1], imu.gyro_z[1:-1], atol=1e-5)


def test_one_file_with_rows_of_both(tmp_path, tables):
    both = pd.concat((tables["imu"].assign(kind="IMU"), tables["gnss"].assign(kind="GNSS"))).sort_values("t")
    both.to_csv(tmp_path / "all.csv", index=False)
    for rows in ("filled", None):
        chosen = {k: rows or {"column": "kind", "is": [k.upper()]} for k in ("imu", "gnss")}
        drive = read(tmp_path, tables, imu__file="all.csv", gnss__file="all.csv", imu__rows=chosen["imu"],
                     gnss__rows=chosen["gnss"])  # fmt: skip
        assert (len(drive.imu), len(drive.gnss)) == (len(tables["imu"]), len(tables["gnss"]))
    lines = [f"{r.kind},{r.t},{r.accel_x}" if r.kind == "IMU" else f"# {r.t}" for r in both.itertuples()]
    (tmp_path / "mixed.txt").write_text("\n".join(lines))
    with pytest.raises(InputError, match="no column '7'"):
        read(tmp_path, tables, header=False, imu__file="mixed.txt", imu__lines="^IMU", imu__time__column=7)


def test_a_row_of_units_a_cut_end_and_an_odd_encoding(tmp_path, tables):
    text = tables["imu"].to_csv(index=False).splitlines()
    text.insert(1, "s,rad/s,rad/s,rad/s,m/s²,m/s²,m/s²")
    text[-1] = text[-1][: len(text[-1]) // 2]
    (tmp_path / "imu.csv").write_bytes("\n".join(text).encode("cp1252"))
    drive = read(tmp_path, tables)
    assert len(drive.imu) == len(tables["imu"]) - 1
    assert [f"line {len(text)}" in note for note in drive.notes if "cut off" in note] == [True]


def test_equal_stamps(tmp_path, tables):
    """A clock of 20 ms at 100 Hz: pairs of samples share a stamp."""
    imu = tables["imu"]
    imu.assign(t=np.ceil(imu.t / 0.02 - 1e-9) * 0.02).to_csv(tmp_path / "imu.csv", index=False)
    drive = read(tmp_path, tables, imu__time={"column": "t", "respace": True})
    np.testing.assert_allclose(drive.imu.t, imu.t, atol=1e-9)
    assert spread_stamps(np.repeat([1.0, 2.0, 3.0, 9.0], 2)).tolist() == [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 7.5, 9.0]


def test_stamps_of_packets(tmp_path, tables):
    """A host that gets ten samples at a time stamps them 0.2 ms apart, here as a packet's last one is taken."""
    imu = tables["imu"]
    place = np.arange(len(imu))
    arrived = imu.t.to_numpy()[np.minimum(place // 10 * 10 + 9, len(imu) - 1)] + 2e-4 * (place % 10 - 9)
    imu.assign(t=arrived).to_csv(tmp_path / "imu.csv", index=False)
    drive = read(tmp_path, tables, imu__time={"column": "t", "respace": True})
    whole = len(imu) // 10 * 10
    np.testing.assert_allclose(drive.imu.t[:whole], imu.t[:whole], atol=1e-9)


def test_a_pose_in_degrees(tmp_path, tables):
    turn = Rotation.from_euler("ZYX", [90.0, -20.0, 5.0], degrees=True).as_matrix()
    odd = tables["imu"].copy()
    for s in ("gyro", "accel"):
        names = [f"{s}_{a}" for a in "xyz"]
        odd[names] = odd[names].to_numpy() @ turn
    odd.to_csv(tmp_path / "imu.csv", index=False)
    pose = {"roll": 5.0, "pitch": -20.0, "yaw": 90.0}
    drive = read(tmp_path, tables, imu__accel__axes=pose, imu__gyro__axes=pose)
    np.testing.assert_allclose(drive.imu.accel_z, tables["imu"].accel_z, atol=1e-9)


def test_no_position_yet(tmp_path, tables):
    """0°/0° is no position with zero=none, and −1 no accuracy."""
    gnss = tables["gnss"].copy()
    gnss.loc[:2, ["lat_deg", "lon_deg"]] = 0.0
    gnss.loc[5, "std_pos_n"] = -1.0
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    drive = read(tmp_path, tables, gnss__position__zero="none")
    assert drive.gnss.quality.tolist()[:4] == [0, 0, 0, 4] and np.isnan(drive.gnss.std_pos_n[5])


MISTAKES = {
    "unknown key": ({"imu__accel__unti": "g"}, "reader.imu.accel: unknown key unti; did you mean unit? known"),
    "unknown format": ({"gnss__format": "gpx"}, "reader.gnss.format=gpx: unknown; known are csv"),
    "rows": ({"imu__rows": "some"}, "reader.imu.rows is 'some', must be filled, changed, once or"),
    "no row left": ({"imu__rows": {"column": "t", "is": ["x"]}}, "no row is left"),
    "pattern": ({"imu__lines": "("}, "is no regular expression"),
    "a name for columns": ({"imu__accel__columns": "accel_x"}, "has a single name, must have 3"),
    "offset": ({"imu__time__offset_s": "late"}, "reader.imu.time.offset_s is 'late', must be a number"),
    "pose": ({"imu__accel__axes": {"roll": 1, "yaw": 2}}, "must have roll, pitch and yaw"),
    "zero": ({"gnss__position__zero": "drop"}, "reader.gnss.position.zero=drop"),
    "frame": ({"gnss__position__frame": "utm"}, "must be llh or ecef"),
    "hemispheres": ({"gnss__position__hemispheres": "ns"}, "must be two columns"),
    "sure": ({"sure": {"angle": 3}}, "reader.sure: unknown key angle"),
    "lever arm": ({"lever_arm_m": 0.5}, "reader.lever_arm_m=0.5: must be three numbers"),
    "separator": ({"separator": "((("}, "reader.separator='(((' is no regular expression"),
    "encoding": ({"encoding": "klingon"}, "reader.encoding=klingon"),
    "dates that start again": (
        {"gnss__time": {"column": "when", "unit": "iso", "wraps_s": 86_400}},
        "wraps_s=86400: stamps with a date do not start again",
    ),
    "text stamps": ({"gnss__time__column": "when"}, "reader.gnss.time.unit=iso"),
    "no GNSS for auto": ({"gnss__file": None, "imu__accel__axes": "auto"}, "needs GNSS to compare with"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(tmp_path, tables, case):
    changes, expected = MISTAKES[case]
    tables["gnss"].assign(when="2025-07-05T12:00:00").to_csv(tmp_path / "gnss.csv", index=False)
    with pytest.raises(InputError) as error:
        read(tmp_path, tables, **changes)
    assert expected in str(error.value) and "\n" not in str(error.value)


def test_another_format_than_said(tmp_path, tables):
    """Every decoder tells in one line that a file is none of its own."""
    for name in ("ubx", "nmea", "rosbag", "matlab", "rtklib", "novatel", "parquet", "kitti"):
        with pytest.raises(InputError) as error:
            read(tmp_path, tables, gnss__format=name)
        assert "gnss.csv" in str(error.value) or name == "kitti", name
        assert "\n" not in str(error.value), name


def test_a_missing_library(tmp_path, tables, monkeypatch):
    import builtins

    real = builtins.__import__

    def without(name, *rest, **more):
        if name.startswith("pyubx2"):
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr("dlkf.data.readers.formats.importlib.import_module", lambda name: without(name) or real(name))
    from dlkf.data.readers.formats import library

    with pytest.raises(InputError, match=r"a UBX log needs the package pyubx2; install it with: pip install"):
        library("pyubx2", "a UBX log")
