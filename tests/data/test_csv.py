"""A log with odd columns, units, axes and clocks comes out as the drive that it is."""

from __future__ import annotations

import copy

import numpy as np
import pandas as pd
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dlkf.base.errors import InputError
from dlkf.data.intake import IngestOptions, ingest_drives
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.units import rotation, seconds
from dlkf.data.tables import read_drives, read_table
from dlkf.data.validate import validate_dataset
from tests.cars import car

PLAIN = {
    "imu": {
        "file": "imu.csv",
        "time": {"column": "t"},
        "accel": {"columns": ["accel_x", "accel_y", "accel_z"]},
        "gyro": {"columns": ["gyro_x", "gyro_y", "gyro_z"]},
    },
    "gnss": {
        "file": "gnss.csv",
        "time": {"column": "t"},
        "position": {"columns": ["lat_deg", "lon_deg", "height_m"]},
        "velocity": {"columns": ["vel_n", "vel_e", "vel_d"]},
        "std_position": {"columns": ["std_pos_n", "std_pos_e", "std_pos_d"]},
        "std_velocity": {"columns": ["std_vel_n", "std_vel_e", "std_vel_d"]},
        "quality": {"column": "quality"},
    },
}
GPS_WEEK, TOW = 2350, 345_600  # and the same moment in Unix time
UNIX = GPS_WEEK * 604_800 + TOW + 315_964_800 - 18


def _plain(folder, tables) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for kind, frame in tables.items():
        frame.to_csv(folder / f"{kind}.csv", index=False)


def log_reader(**changes) -> LogReader:
    spec = copy.deepcopy(PLAIN)
    for path, value in changes.items():
        *nodes, last = path.split("__")
        node = spec
        for name in nodes:
            node = node.setdefault(name, {})
        node[last] = value
    return LogReader(spec.pop("imu"), spec.pop("gnss"), spec.pop("reference", None), **spec)


def test_an_odd_log_round_trips(tmp_path, tables):
    """Nanoseconds of Unix time, Right-Forward-Up, g and °/s; GPS weeks, ENU in km/h, radians, words."""
    imu, gnss, reference = (tables[k] for k in ("imu", "gnss", "reference"))
    folder = tmp_path / "logs" / "monday"
    folder.mkdir(parents=True)
    t = np.round((imu.t + 5) * 1e9).astype(np.int64) + UNIX * 10**9
    odd = pd.DataFrame({"#timestamp [ns]": t})
    for name, sensor, unit in (("a", "accel", 9.80665), ("w", "gyro", np.pi / 180)):
        f, r, d = (imu[f"{sensor}_{axis}"] / unit for axis in "xyz")
        odd[f"{name}x"], odd[f"{name}y"], odd[f"{name}z"] = r, f, -d
    odd.to_csv(folder / "xsens_imu.txt", index=False, sep=";")
    fix = pd.DataFrame({"week": GPS_WEEK, "tow_ms": (TOW + gnss.t + 5) * 1000})
    fix["phi"], fix["lam"], fix["h"] = (
        np.radians(gnss.lat_deg),
        np.radians(gnss.lon_deg),
        gnss.height_m * 1000,
    )
    fix["ve"], fix["vn"], fix["vu"] = 3.6 * gnss.vel_e, 3.6 * gnss.vel_n, -3.6 * gnss.vel_d
    fix["eph"], fix["epv"], fix["mode"] = 2.0, 2.0, "FIX"
    fix.loc[3, ["phi", "lam", "h"]] = np.nan
    fix.loc[4, "mode"] = "FLT"
    fix.to_csv(folder / "rtk_gnss.txt", index=False, sep=";")
    ref = pd.DataFrame({"t": UNIX + reference.t + 5, "lat": reference.lat_deg, "lon": reference.lon_deg})
    ref["h"], ref["sog"] = reference.height_m, np.hypot(reference.vel_n, reference.vel_e)
    ref["cog"], ref["climb"] = np.degrees(np.arctan2(reference.vel_e, reference.vel_n)), -reference.vel_d
    ref["r"], ref["p"] = np.degrees(reference.roll), -np.degrees(reference.pitch)
    ref["y"], ref["ok"] = 90 - np.degrees(reference.yaw), 1
    ref.loc[7, "ok"] = 0
    ref.to_csv(folder / "pos_ref.txt", index=False, sep=";")
    reader = LogReader(
        imu={
            "file": "*_imu.txt",
            "time": {"column": "#timestamp [ns]", "unit": "ns", "clock": "unix"},
            "accel": {"columns": ["ax", "ay", "az"], "unit": "g", "axes": "rfu"},
            "gyro": {"columns": ["wx", "wy", "wz"], "unit": "deg/s", "axes": ["y", "x", "-z"]},
        },
        gnss={
            "file": "*_gnss.txt",
            "time": {"column": "tow_ms", "unit": "ms", "week": "week"},
            "position": {"columns": ["phi", "lam", "h"], "unit": "rad", "height_unit": "mm"},
            "velocity": {"columns": ["ve", "vn", "vu"], "unit": "km/h", "frame": "enu"},
            "std_position": {"columns": ["eph", "epv"], "unit": "cm"},
            "quality": {"column": "mode", "map": {"FIX": 4, "FLT": 5}},
        },
        reference={
            "file": "*_ref.txt",
            "time": {"column": "t", "clock": "unix"},
            "position": {"columns": ["lat", "lon", "h"]},
            "velocity": {"columns": ["sog", "cog", "climb"], "frame": "course"},
            "attitude": {"columns": ["r", "p", "y"], "unit": "deg", "convention": "enu"},
            "valid": {"column": "ok"},
        },
        separator=";",
        lever_arm_m=[1.0, 0.5, -1.2],
        group="day-1",
        meta={"licence": "mine"},
    )
    assert ingest_drives(reader.read(tmp_path / "logs"), tmp_path / "out") == 1
    row = read_drives(tmp_path / "out")[0]
    assert (row.name, row.group, row.lever_arm_b) == ("monday", "day-1", (1.0, 0.5, -1.2))
    back = {kind: read_table(tmp_path / "out", kind, "monday") for kind in ("imu", "gnss", "reference")}
    shift = 5.0  # counted from the whole second of the first IMU stamp
    assert pd.read_parquet(tmp_path / "out" / "drives.parquet").time_zero_s[0] == GPS_WEEK * 604_800 + TOW + shift
    for name in imu:
        tolerance = 1e-9 if name == "t" else 1e-12
        np.testing.assert_allclose(back["imu"][name], imu[name], atol=tolerance, err_msg=name)
    np.testing.assert_allclose(back["gnss"]["t"], gnss.t, atol=1e-9)
    for name in ("lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d", "std_pos_n", "std_pos_d"):
        expected = gnss[name].to_numpy().copy()
        if name in ("lat_deg", "lon_deg", "height_m"):
            expected[3] = np.nan
        np.testing.assert_allclose(back["gnss"][name], expected, rtol=1e-12, atol=1e-12, err_msg=name)
    assert np.isnan(back["gnss"]["std_vel_n"]).all()
    assert back["gnss"]["quality"].tolist()[:6] == [4, 4, 4, 0, 5, 4]
    np.testing.assert_allclose(back["reference"]["t"], reference.t, atol=3e-7)  # Unix seconds as floats: 2⁻²² s
    for name in ("vel_n", "vel_e", "vel_d", "roll", "pitch", "yaw"):
        np.testing.assert_allclose(back["reference"][name], reference[name], atol=1e-9, err_msg=name)
    assert np.flatnonzero(~back["reference"]["valid"]).tolist() == [7]


def test_increments_and_stamps_at_the_start(tmp_path, tables):
    imu = tables["imu"].copy()
    imu.iloc[:, 1:] *= 0.01
    imu["t"] -= 0.01
    _plain(tmp_path / "a", {**tables, "imu": imu})
    reader = log_reader(imu__increments=True, imu__stamp="start", time_zero="keep")
    drive = next(iter(reader.read(tmp_path / "a")))
    assert drive.name == "a" and drive.reference is None
    for name in tables["imu"]:
        np.testing.assert_allclose(drive.imu[name], tables["imu"][name], atol=1e-9)


def test_increments_after_lost_rows_are_of_their_own_step(tmp_path, tables):
    """A row has what was gained since the sample before it, whether that was logged or not."""
    lost = np.arange(len(tables["imu"])) % 100 == 50
    lost |= np.arange(len(lost)) % 100 == 51
    imu = tables["imu"][~lost]
    gained = imu.assign(**{name: imu[name] * 0.01 for name in imu if name != "t"})
    _plain(tmp_path / "a", {**tables, "imu": gained})
    (drive,) = log_reader(imu__increments=True).read(tmp_path / "a")
    for name in imu:
        np.testing.assert_allclose(drive.imu[name], imu[name], atol=1e-9)


def test_a_table_without_header(tmp_path, tables):
    folder = tmp_path / "a"
    folder.mkdir()
    for kind in ("imu", "gnss"):
        tables[kind].to_csv(folder / f"{kind}.csv", index=False, header=False, sep=" ")
    reader = log_reader(
        header=False,
        separator=r"\s+",
        imu__time__column=0,
        imu__gyro__columns=[1, 2, 3],
        imu__accel__columns=[4, 5, 6],
        gnss__time__column=0,
        gnss__position__columns=[1, 2, 3],
        gnss__velocity__columns=[4, 5, 6],
        gnss__std_position=None,
        gnss__std_velocity=None,
        gnss__quality={"default": 9},
    )
    drive = next(iter(reader.read(folder)))
    np.testing.assert_allclose(drive.imu.accel_z, tables["imu"].accel_z)
    assert set(drive.gnss.quality) == {9}


MISTAKES = {
    "imu__accel__columns": (["ax", "ay", "az"], "no column 'ax'; has t, gyro_x"),
    "imu__accel__unit": ("furlong", "reader.imu.accel.unit: unknown unit 'furlong'; known are m/s2"),
    "imu__accel__axes": ("fru", "no right-handed triad"),
    "imu__gyro__axes": ("forward", "axes 'forward' must be three letters"),
    "imu__time__unit": ("h", "unknown time unit 'h'"),
    "imu__time__clock": ("tai", "unknown clock 'tai'"),
    "imu__stamp": ("late", "reader.imu.stamp=late"),
    "imu__file": ("imu.txt", "no file imu.txt and no subfolders"),
    "gnss__file": ("*.csv", "match *.csv, and are no parts of one log"),
    "gnss__velocity__frame": ("nwu", "reader.gnss.velocity.frame=nwu"),
    "gnss__quality__map": ({"5": 5}, "quality '4' is not in reader.gnss.quality.map"),
    "time_zero": ("now", "reader.time_zero=now"),
    "lever_arm_m": ([1.0], "reader.lever_arm_m"),
}


@pytest.mark.parametrize("path", MISTAKES)
def test_mistakes_in_the_mapping(tmp_path, tables, path):
    value, message = MISTAKES[path]
    _plain(tmp_path / "a", tables)
    with pytest.raises(InputError) as error:
        list(log_reader(**{path: value}).read(tmp_path / "a"))
    assert message in str(error.value) and "\n" not in str(error.value)


def test_mistakes_in_the_files(tmp_path, tables):
    _plain(tmp_path / "a", tables)
    path = tmp_path / "a" / "imu.csv"
    lines = path.read_text().splitlines()
    for line, cells, message in (
        (41, "0.4,0,0,oops,0,0,-9.8", "line 42: column 'gyro_z' is 'oops', not a number"),
        (41, "0.4,0,0,,0,0,-9.8", "line 42: column 'gyro_z' has no value"),
        (41, "0.4,0,0,inf,0,0,-9.8", "line 42: column 'gyro_z' is inf; correct or remove the line"),
        (41, "0.4,0,0,0,0,0,-9.8,7,7", "line 42 has 9 cells, those before have 7; correct the line"),
        (41, "0.39,0,0,0,0,0,-9.8", r"line 42 \(t 0.39\): t goes back"),
    ):
        path.write_text("\n".join([*lines[:line], cells, *lines[line + 1 :]]))
        with pytest.raises(InputError, match=message):
            ingest_drives(log_reader().read(tmp_path), tmp_path / "out")
        assert [p.name for p in tmp_path.iterdir()] == ["a"]  # whole or none
    path.write_text("")
    with pytest.raises(InputError, match="is empty"):
        list(log_reader().read(tmp_path))
    path.write_text(lines[0] + "\n")
    with pytest.raises(InputError, match="has no rows"):
        list(log_reader().read(tmp_path))
    with pytest.raises(InputError, match="no such file or folder"):
        list(log_reader().read(tmp_path / "b"))


def test_a_column_that_is_missing_is_named_with_its_key_and_files_that_are_not_read_with_theirs(tmp_path, tables):
    _plain(tmp_path, tables)
    (drive,) = log_reader().read(tmp_path)
    assert "files that are not read: reference.csv" in drive.notes
    with pytest.raises(InputError, match=r"no column 'alt'.*set reader\.gnss\.position\.columns$"):
        list(log_reader(gnss__position={"columns": ["lat_deg", "lon_deg", "alt"]}).read(tmp_path))
    with pytest.raises(InputError, match=r"no column 'stamp'.*set reader\.imu\.time\.column$"):
        list(log_reader(imu__time={"column": "stamp"}).read(tmp_path))


def test_drives_are_split_at_gaps(tmp_path, tables):
    imu = tables["imu"]
    holes = imu[~imu.t.between(20.0, 21.5) & ~imu.t.between(25.0, 26.0)]
    _plain(tmp_path / "logs" / "a", {**tables, "imu": holes})
    _plain(tmp_path / "logs" / "b", tables)
    with pytest.raises(InputError, match=r"drive a.*IMU gap of 1\.5.*split_gaps=true"):
        ingest_drives(log_reader().read(tmp_path / "logs"), tmp_path / "out")
    seen = []
    count = ingest_drives(
        log_reader().read(tmp_path / "logs"),
        tmp_path / "out",
        IngestOptions(split_gaps=True),
        progress=lambda taken, done: seen.extend(row["drive"] for row in taken.rows),
    )
    rows = validate_dataset(tmp_path / "out")
    assert count == 3 and seen == [r.name for r in rows] == ["a-s0", "a-s1", "b"]
    assert [r.group for r in rows] == ["a", "a", "b"]
    part = read_table(tmp_path / "out", "gnss", "a-s1")
    assert part["t"].min() > 26 and part["t"].max() <= 60


def test_axes_and_clocks():
    assert (rotation("frd", "") == np.eye(3)).all()
    assert (rotation("flu", "") == np.diag([1, -1, -1])).all()
    assert (rotation(["x", "-y", "-z"], "") == rotation("FLU", "")).all()
    assert (rotation("rfu", "") @ [1, 2, 3] == [2, 1, -3]).all()
    whole, part = seconds(np.array([1_700_000_000_123_456_789]), "ns", None, None, "")
    assert whole[0] == 1_700_000_000 and part[0] == pytest.approx(0.123456789, abs=1e-12)
    week, _ = seconds(np.array([TOW]), "s", np.array([GPS_WEEK]), None, "")
    unix, _ = seconds(np.array([UNIX]), "s", None, "unix", "")
    assert week[0] == unix[0]


def test_the_preset_reads_the_contracts_own_columns(tmp_path):
    """conf/reader/csv.yaml as it stands, with a reference."""
    from pathlib import Path

    config = OmegaConf.load(Path(__file__).parents[2] / "conf" / "reader" / "csv.yaml")
    config.reference.file = "reference.csv"
    config.gnss.quality.column = "quality"
    _plain(tmp_path / "logs", car(20))
    reader = instantiate(config, _convert_="all")
    assert ingest_drives(reader.read(tmp_path / "logs"), tmp_path / "out") == 1
    assert set(read_table(tmp_path / "out", "gnss", "logs")["quality"]) == {4}


CLOCKS_OF_GNSS = {
    "unix seconds": (UNIX, {}, True),
    "unix, said": (UNIX, {"clock": "unix"}, True),
    "gps seconds": (GPS_WEEK * 604_800 + TOW, {}, True),
    "seconds of a week that is told": (TOW, {"week_number": GPS_WEEK}, True),
    "seconds of some week": (TOW, {}, False),
    "seconds of a week whose number has gone round": (TOW, {"week_number": GPS_WEEK - 2048}, False),
}


@pytest.mark.parametrize("case", CLOCKS_OF_GNSS)
def test_gps_time_is_that_of_the_fixes_whatever_the_imu_counts(tmp_path, tables, case):
    """Stamps of the receiver + 37.5 s, and 200 ppm more from the first on, are those of an IMU that counts from 0."""
    base, message, known = CLOCKS_OF_GNSS[case]
    own = tables["gnss"].t / (1 + 2e-4)
    _plain(tmp_path / "a", {**tables, "gnss": tables["gnss"].assign(t=base - 37.5 + own)})
    time = {"column": "t", **message, "offset_s": 37.5, "drift_ppm": 200.0}
    probe = log_reader(gnss__time={**time, "offset_s": 0.0}, time_zero="keep")
    (drive,) = probe.read(tmp_path / "a")
    offset = -float(drive.gnss.t.iloc[0])
    (drive,) = log_reader(gnss__time={**time, "offset_s": offset}).read(tmp_path / "a")
    np.testing.assert_allclose(drive.gnss.t, tables["gnss"].t, atol=1e-6)  # a double of decades of seconds: 2⁻²² s
    if not known:
        assert "gps_zero_s" not in drive.meta
        return
    gps = drive.meta["gps_zero_s"] + drive.meta["gps_rate"] * drive.gnss.t
    np.testing.assert_allclose(gps, GPS_WEEK * 604_800 + TOW - 37.5 + own, atol=2e-6)
    assert drive.meta["time_zero_s"] == 0


@pytest.mark.parametrize("auto", [False, True], ids=["csv", "auto"])
def test_a_fault_of_the_stamps_names_the_line_and_the_stamp_of_the_file(tmp_path, auto):
    """As an editor shows them: lines count from 1, the header among them, and t counts from the first second."""
    tables = {kind: car(20)[kind] for kind in ("imu", "gnss")}
    tables["imu"] = pd.concat([tables["imu"][:1001], tables["imu"][1000:]])
    for kind, table in tables.items():
        table.assign(t=table.t + 4000).to_csv(tmp_path / f"{kind}.csv", index=False, float_format="%.6f")
    with pytest.raises(InputError) as refused:
        list((AutoReader() if auto else LogReader(**PLAIN)).read(tmp_path))
    line = (tmp_path / "imu.csv").read_text().splitlines()[1002]
    assert line.startswith("4010.010000") and "imu.csv: line 1003 (t 4010.01): t = 10.01" in str(refused.value)


PARTS = (
    ({"file": "imu_*.csv"}, {"file": "gnss_*.csv"}),
    ({"file": ["imu_2.csv", "imu_1.csv"]}, {"file": ["gnss_1.csv", "gnss_2.csv"]}),
)


@pytest.mark.parametrize("files", [*PARTS, ({}, {})], ids=["pattern", "list", "auto"])
@pytest.mark.parametrize("reader", [LogReader, AutoReader])
def test_files_of_one_log_are_joined_where_their_stamps_follow(tmp_path, reader, files):
    """Each file has a header of its own; parts that overlap are refused, or the first of a list is taken alone."""
    tables = {kind: car(100)[kind] for kind in ("imu", "gnss")}
    for kind, table in tables.items():
        for part, rows in (("1", table.t <= 50), ("2", table.t > 50)):
            table[rows].to_csv(tmp_path / f"{kind}_{part}.csv", index=False)
    if reader is LogReader and files == ({}, {}):
        return
    specs = [{**spec, **file} for spec, file in zip((PLAIN["imu"], PLAIN["gnss"]), files)]
    (got,) = reader(*(specs if reader is LogReader else files)).read(tmp_path)
    assert len(got.imu) == len(tables["imu"]) and len(got.gnss) == len(tables["gnss"])
    assert "joined imu_1.csv, imu_2.csv" in got.notes and not any("not read" in note for note in got.notes)
    np.testing.assert_allclose(got.imu.accel_x, tables["imu"].accel_x, atol=0.02)
    faulty = tables["imu"][5000:].astype(object)
    faulty.iloc[3, 1] = "oops"
    faulty.to_csv(tmp_path / "imu_2.csv", index=False)
    if reader is LogReader:
        with pytest.raises(InputError, match=r"line 5 of imu_2.csv: column 'gyro_x' is 'oops'"):
            list(reader(*specs).read(tmp_path))
    tables["imu"].to_csv(tmp_path / "imu_2.csv", index=False)
    if files[0] == {"file": "imu_*.csv"} or reader is AutoReader:
        with pytest.raises(InputError, match=r"no parts of one log|all hold IMU"):
            list(reader(*(specs if reader is LogReader else files)).read(tmp_path))
