"""``reader=auto``: logs of which nothing is known, and what is refused in one line."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from dlkf.base.errors import InputError
from dlkf.data.intake import ingest_drives
from dlkf.data.readers.auto import AutoReader, _find_velocities
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.offers import find_format, recognise_file
from dlkf.data.readers.recognise import gnss_spec, imu_spec
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import read_table
from tests.cars import car
from tests.data.logs.bags import _Bag, ros1, ros2, ros2_ublox
from tests.data.logs.receivers import ubx_fixes
from tests.data.test_discovery import TURN
from tests.data.test_formats import read

UNIX = 1_751_760_000


def _hidden(folder, tables):
    """Two files of odd units on clocks of their own."""
    folder.mkdir(parents=True)
    imu, gnss = tables["imu"], tables["gnss"]
    odd = pd.DataFrame({"stamp": np.round(1000 * imu.t).astype(int)})
    for name, columns, unit in (("acc", ACCEL, 9.80665), ("gyr", GYRO, np.pi / 180)):
        values = imu[list(columns)].to_numpy() @ TURN.T / unit
        odd[[f"{name}_{a}" for a in "xyz"]] = values
    odd.to_csv(folder / "box.txt", index=False, sep=";")
    fix = pd.DataFrame({"unix_time": UNIX + gnss.t - 1234.5, "Latitude": gnss.lat_deg, "Longitude": gnss.lon_deg})
    fix["Altitude"], fix["speed"] = gnss.height_m, 3.6 * np.hypot(gnss.vel_n, gnss.vel_e)
    fix["course"] = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    fix.to_csv(folder / "receiver.csv", index=False)


def test_logs_of_which_nothing_is_known(tmp_path, drive):
    """Formats, columns, units, pose and clocks found; the written preset reads the logs to the same tables."""
    _hidden(tmp_path / "logs" / "monday", drive)
    (got,) = AutoReader().read(tmp_path / "logs")
    found = "\n".join(got.notes)
    for expected in (
        "accel.unit=g",
        "gyro.unit=deg/s",
        "velocity.unit=km/h",
        "offset_s=",
        "axes={roll",
        "lever_arm_m",
    ):
        assert f"{expected}" in found, expected
    assert "±" in found and got.name == "monday"
    # half a percent of an axis: 0.1° of pose; the rates' unit is exact
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], drive["imu"][name], atol=0.02, err_msg=name)
    np.testing.assert_allclose(got.gnss.t, drive["gnss"].t, atol=3e-3)
    ingest_drives([got], tmp_path / "out")
    preset = yaml.safe_load((tmp_path / "out" / "reader" / "found.yaml").read_text())
    assert preset.pop("_target_").endswith("LogReader")
    (again,) = LogReader(**preset).read(tmp_path / "logs")
    pd.testing.assert_frame_equal(again.imu, got.imu)
    pd.testing.assert_frame_equal(again.gnss, got.gnss)
    assert read_table(tmp_path / "out", "imu", "monday") is not None


def test_a_folder_with_a_date_for_a_name(tmp_path, drive):
    """Not the year alone, as of a file what stands before the first point."""
    _hidden(tmp_path / "2025.07.05", drive)
    for reader in (AutoReader(), LogReader({"file": "box.txt"}, {"file": "receiver.csv"})):
        assert reader.places(tmp_path / "2025.07.05") == [(tmp_path / "2025.07.05", "2025.07.05", None)]
        assert [name for _, name, _ in reader.places(tmp_path / "2025.07.05" / "box.txt")] == ["box"]


def _table(text, name="a.csv"):
    return LogTable(pd.read_csv(io.StringIO(text)), Path(name))


def test_a_receivers_table_with_km_h_in_its_names_and_words_for_its_quality():
    rows = "1751760000000000000,50,8,9,36,0,RTK float\n" * 3
    spec = gnss_spec(_table("time_ns,lat,lon,alt,speed_kmh,course,fix\n" + rows)).spec
    assert spec["velocity"] == {"columns": ["speed_kmh", "course"], "frame": "course"}
    assert spec["quality"] == {"column": "fix", "map": {"RTK float": 5}}
    odd = gnss_spec(_table("t,lat,lon,alt,fix\n1751760000,50,8,9,rather good\n1751760001,50,8,9,RTK\n"))
    assert "quality" not in odd.spec and "rather good" in odd.notes[0]


def test_rows_of_imu_and_fixes_in_one_table():
    """Each kind by its own rows: their stamps, and columns that are empty for most."""
    fast = "".join(f"{0.01 * k:.2f},0,0,-9.8,0,0,0,,,\n" for k in range(40))
    both = _table("t,ax,ay,az,gx,gy,gz,lat,lon,alt\n" + fast + "0.20,,,,,,,50,8,90\n0.40,,,,,,,50,8,90\n")
    assert imu_spec(both).spec["time"] == gnss_spec(both).spec["time"] == {"column": "t", "unit": "s"}


def test_fixes_repeated_beside_every_sample(tmp_path, drive):
    """A table of both kinds without empty cells: a row whose position is new is a fix."""
    both = pd.merge_asof(drive["imu"], drive["gnss"].drop(columns="quality"), on="t")
    both.rename(columns={"lat_deg": "lat", "lon_deg": "lon", "height_m": "alt"}).to_csv(tmp_path / "a.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.gnss.t, drive["gnss"].t, atol=0.02)  # found at the sample that follows
    assert "took 101 of 10000 rows for fixes: the others repeat the position before" in got.notes


def test_stamps_under_a_name_of_their_own():
    """The only column that rises all the way; a count of the rows tells no time, and of two clocks none is chosen."""
    rows = [f"{4711000 + 10 * k},{k},{20 * k},0,0,-1,{k % 3},0,0\n" for k in range(40)]
    table = _table("Stand [ms],Nr,Odo,accX,accY,accZ,gyrX,gyrY,gyrZ\n" + "".join(rows))

    def without(*names: str) -> LogTable:
        return LogTable(table.frame.drop(columns=list(names)), table.path)

    spec = imu_spec(without("Odo"))
    assert spec is not None and spec.spec["time"] == {"column": "Stand [ms]", "unit": "ms"}
    assert imu_spec(without("Odo", "Stand [ms]")) is None is imu_spec(table)


def test_a_sentence_in_a_column_of_a_table_makes_no_nmea_log(tmp_path):
    """A logger's table with the sentence beside what it read from it; one with a stamp before each sentence is NMEA."""
    gga = "$GPGGA,183244.000,4220.2322,N,07105.3712,W,1,09,1.1,16.6,M,-33.8,M,,0000*5A"
    for name, row, found in (
        ("table", '{},42.3,-71.1,16.6,"' + gga + '"', "csv"),
        ("stamped", "{}," + gga, "nmea"),
        ("plain", gga, "nmea"),
    ):
        (tmp_path / name).write_text("t,lat,lon,alt,read\n" + "".join(f"{row.format(k)}\n" for k in range(9)))
        assert find_format(tmp_path / name) == found, name
    (tmp_path / "stamped").rename(tmp_path / "stamped.csv")
    assert recognise_file(tmp_path / "stamped.csv").offers[0].detail.startswith("nmea")
    stated = {"gnss": {"file": "stamped.csv", "format": "csv"}}
    assert not any(one.detail.startswith("nmea") for one in recognise_file(tmp_path / "stamped.csv", stated).offers)


def test_columns_that_are_named_count(tmp_path, drive):
    """Under any names, for the IMU and for the fixes; the rest is found. What is still not found has one line."""
    names = dict(zip(("t", *GYRO, *ACCEL), ("t", "p1", "p2", "p3", "s1", "s2", "s3")))
    imu = drive["imu"].assign(more=1.0).rename(columns=names)
    imu[["p1", "s1", "p2", "more", "s2", "s3", "p3", "t"]].to_csv(tmp_path / "imu.csv", index=False)
    fix = {"lat_deg": "a", "lon_deg": "b", "height_m": "c", "vel_n": "d", "vel_e": "e", "vel_d": "f"}
    drive["gnss"][["t", *fix]].rename(columns=fix).assign(n=7.0).to_csv(tmp_path / "gnss.csv", index=False)
    known = {"accel": {"columns": ["s1", "s2", "s3"]}, "gyro": {"columns": ["p1", "p2", "p3"]}}
    place = {"position": {"columns": ["a", "b", "c"]}, "velocity": {"columns": ["d", "e", "f"]}}
    for file in ({}, {"file": "imu.csv"}):
        (got,) = AutoReader({**file, **known}, place).read(tmp_path)
        np.testing.assert_allclose(got.imu.accel_z, drive["imu"].accel_z, atol=0.02)
        np.testing.assert_allclose(got.gnss.vel_d, drive["gnss"].vel_d, atol=1e-6)
    with pytest.raises(
        InputError, match=r"no IMU found in imu.csv \(columns p1, .*; name its columns \(reader.imu.acc"
    ):
        list(AutoReader({"file": "imu.csv", "accel": known["accel"]}, place).read(tmp_path))


def test_a_log_at_rest_in_units_of_its_own(tmp_path):
    """Gravity tells the accelerometers' unit; what nothing tells is said, and what is given is kept."""
    rest = np.random.default_rng(1).normal(0, 0.002, (1000, 7)) + [0, 0, 0, -1.0, 0, 0, 0]
    names = ["t", "acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]
    pd.DataFrame(rest, columns=names).assign(t=0.01 * np.arange(1000)).to_csv(tmp_path / "bench.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    assert got.gnss is None and got.imu.accel_z.mean() == pytest.approx(-9.80665, abs=1e-3)
    assert any("took reader.imu.gyro.unit=rad/s" in note for note in got.notes)
    (said,) = AutoReader(imu={"gyro": {"unit": "deg/s"}}).read(tmp_path)
    np.testing.assert_allclose(said.imu.gyro_x, np.radians(got.imu.gyro_x))
    assert not any("gyro.unit" in note for note in said.notes)


def test_a_file_of_a_folder_says_what_is_missing(tmp_path):
    """A receiver's log without its IMU; the part of a bag stands for the whole, where there is one."""
    tables = car(6)
    ubx_fixes(tmp_path / "town.ubx", tables)
    with pytest.raises(
        InputError, match=r"no IMU found in town.ubx \(ubx, no IMU \(has no IMU in ESF-RAW .*; give the folder"
    ):
        list(AutoReader().read(tmp_path / "town.ubx"))
    (tmp_path / "lone.db3").touch()
    with pytest.raises(InputError, match="ros2 bag reindex"):
        AutoReader().places(tmp_path / "lone.db3")
    ros2(tmp_path, tables)
    (part,) = (tmp_path / "drive").glob("*.db3")
    assert AutoReader().places(part) == [(tmp_path / "drive", "drive", tmp_path / "drive" / "metadata.yaml")]


def test_velocities_in_a_file_beside_the_fixes(tmp_path):
    """Of the same column of time, and none but they."""
    for name, columns, row in (
        ("pos", "t,lat,lon,alt", "1751760000,50,8,9"),
        ("vel", "t,speed,course", "1751760000,9,45"),
    ):
        (tmp_path / f"{name}.csv").write_text(f"{columns}\n" + f"{row}\n" * 3)
    (chosen,) = recognise_file(tmp_path / "pos.csv").offers
    found = _find_velocities(chosen, chosen.specs["gnss"], tmp_path.iterdir())
    assert found == {"columns": ["speed", "course"], "frame": "course", "file": "vel.csv"}


@pytest.mark.parametrize("writer", [ros1, ros2])
def test_velocities_of_a_bag_lie_in_a_topic_of_their_own(tmp_path, writer):
    """NavSatFix has none; NavPVT has, so that nothing is looked for."""
    tables = car(6)
    writer(tmp_path, tables)
    (path,) = (p for pattern in ("*.bag", "drive/metadata.yaml") for p in tmp_path.glob(pattern))
    (chosen,) = recognise_file(path).offers
    assert _find_velocities(chosen, chosen.specs["gnss"], []) == {"table": "/gnss/vel"}
    (got,) = read(path.parent, ["reader=rosbag"])
    assert any("reader.gnss.velocity.table=/gnss/vel" in note for note in got.notes)
    (tmp_path / "ublox").mkdir()
    ros2_ublox(tmp_path / "ublox", tables)
    (other,) = recognise_file(tmp_path / "ublox" / "drive" / "metadata.yaml").offers
    assert _find_velocities(other, other.specs["gnss"], []) is None


def test_a_bag_with_two_imus_or_cut_off_says_so(tmp_path):
    """With reader=auto too: topics to choose from, or that the bag is not whole."""
    tables = car(6)
    with _Bag(tmp_path / "two", True) as bag:
        for topic in ("/imu/roof", "/imu/seat"):
            write = bag.write
            bag.write = lambda _, *rest, write=write, topic=topic: write(topic, *rest)
            bag.imu(tables, 0)
            bag.write = write
    with pytest.raises(InputError, match=r"2 topics with .*/imu/roof .*/imu/seat .*; set reader\.imu\.table"):
        list(AutoReader().read(tmp_path / "two"))
    (log,) = (tmp_path / "two").glob("*.db3")
    log.write_bytes(log.read_bytes()[:5000])
    with pytest.raises(InputError, match="cannot be read as a bag"):
        list(AutoReader().read(tmp_path / "two"))


def test_a_table_beside_the_imu_of_which_nothing_is_known_is_no_log_at_rest(tmp_path):
    (tmp_path / "imu.csv").write_text(
        "t,ax,ay,az,gx,gy,gz\n" + "".join(f"{k / 100},0,0,-9.8,0,0,0\n" for k in range(9))
    )
    (tmp_path / "ecef.csv").write_text("t,x,y,z\n" + "".join(f"{k},4e6,6e5,5e6\n" for k in range(9)))
    with pytest.raises(InputError, match=r"no fixes found in ecef\.csv"):
        list(AutoReader().read(tmp_path))
    (tmp_path / "ecef.csv").rename(tmp_path / "ecef.notes")
    (tmp_path / "town.nmea").touch()
    with pytest.raises(InputError, match=r"no fixes found in town\.nmea \(it is empty\)"):
        list(AutoReader().read(tmp_path))


def test_what_is_not_sure_is_refused(tmp_path):
    """Twenty seconds are too few for a pose within 2°."""
    _hidden(tmp_path / "logs", car(20))
    with pytest.raises(InputError, match=r"drive logs: not sure of reader\.") as error:
        list(AutoReader().read(tmp_path / "logs"))
    assert "\n" not in str(error.value)


def test_a_clock_that_was_set_back_is_named_before_anything_is_estimated(tmp_path):
    _hidden(tmp_path / "logs", car(20))
    box = tmp_path / "logs" / "box.txt"
    imu = pd.read_csv(box, sep=";")
    imu.loc[500:, "stamp"] -= 9000
    imu.to_csv(box, sep=";", index=False)
    with pytest.raises(InputError, match=r"box.txt: line 502 .*the clock was set back there: make two drives of it"):
        list(AutoReader().read(tmp_path / "logs"))


def test_kf_gins_files_by_their_numbers(tmp_path, drive):
    """No header, increments, blanks: told by gravity and by what rises."""
    folder = tmp_path / "a"
    folder.mkdir()
    imu, gnss = drive["imu"], drive["gnss"]
    table = np.column_stack((345_600 + imu.t, imu[[*GYRO, *ACCEL]].to_numpy() * 0.01))
    np.savetxt(folder / "box.txt", table, fmt="%.10g")
    place = gnss[["lat_deg", "lon_deg", "height_m"]].to_numpy()
    np.savetxt(folder / "rtk.txt", np.column_stack((345_600 + gnss.t, place)), fmt="%.12g")
    (got,) = AutoReader().read(folder)
    np.testing.assert_allclose(got.imu.gyro_z, imu.gyro_z, atol=0.003)
    # velocities of positions: 1 s means, so a time of 20 ms is what can be asked
    np.testing.assert_allclose(got.gnss.t, gnss.t, atol=0.02)
    assert "with 4, 5, 6, 1, 2, 3" in got.notes[0]


def test_an_opposite_accelerometer(tmp_path, streets):
    """Some phones give the reaction's opposite: found by the turns, which then go the wrong way."""
    drive = streets
    tables = {**drive, "imu": drive["imu"].assign(**{c: -drive["imu"][c] for c in ACCEL})}
    _hidden(tmp_path / "a", tables)
    (got,) = AutoReader().read(tmp_path / "a")
    assert got.mapping["imu"]["accel"]["unit"] == pytest.approx(-9.80665)
    np.testing.assert_allclose(got.imu.accel_z, drive["imu"].accel_z, atol=0.02)


def test_latitude_and_longitude_under_each_others_names(tmp_path, drive):
    _hidden(tmp_path / "a", drive)
    file = tmp_path / "a" / "receiver.csv"
    fixes = pd.read_csv(file)
    fixes.rename(columns={"Latitude": "Longitude", "Longitude": "Latitude"}).to_csv(file, index=False)
    with pytest.raises(InputError, match=r"look swapped: exchange them in reader\.gnss\.position\.columns"):
        list(AutoReader().read(tmp_path / "a"))


def test_sensor_logger_without_gravity_is_not_taken_for_phyphox(tmp_path, drive):
    """Its Accelerometer.csv, a file of both apps, is without gravity; TotalAcceleration.csv was not recorded."""
    imu, gnss = drive["imu"], drive["gnss"]
    for name, columns, mean in (("Accelerometer", ACCEL, 1), ("Gyroscope", GYRO, 0)):
        values = imu[list(columns)].to_numpy() - mean * imu[list(columns)].to_numpy().mean(0)
        frame = pd.DataFrame({"time": ((UNIX + imu.t) * 1e9).astype("int64"), **dict(zip("xyz", values.T))})
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
    fix = {"time": ((UNIX + gnss.t) * 1e9).astype("int64"), "latitude": gnss.lat_deg, "longitude": gnss.lon_deg}
    pd.DataFrame({**fix, "altitude": gnss.height_m}).to_csv(tmp_path / "Location.csv", index=False)
    with pytest.raises(InputError, match=r"there is no gravity in the accelerations"):
        list(AutoReader().read(tmp_path))


def test_the_names_of_a_racebox():
    rows = "".join(f"{1e9 + 0.04 * k:.2f},0,0.1,1,2,3,4\n" for k in range(50))
    spec = imu_spec(_table(f"Time,GForceX,GForceY,GForceZ,GyroX,GyroY,GyroZ\n{rows}"))
    assert spec is not None and spec.spec["accel"]["columns"] == ["GForceX", "GForceY", "GForceZ"]


def test_a_chosen_file_that_is_not_there(tmp_path):
    _hidden(tmp_path / "a", car(20))
    with pytest.raises(InputError, match=r"reader.imu.file=nope.csv: no such file here; IMU found in box.txt"):
        list(AutoReader(imu={"file": "nope.csv"}).read(tmp_path / "a"))


def _twice(folder):
    (folder / "other.txt").write_bytes((folder / "box.txt").read_bytes())


MISTAKES = {
    "two IMUs": (_twice, "box.txt, other.txt all hold IMU; choose one with reader.imu.file"),
    "no IMU": (lambda f: (f / "box.txt").unlink(), "no IMU found in receiver.csv"),
    "nothing": (lambda f: [p.unlink() for p in f.iterdir()], "holds no log that can be recognised"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(tmp_path, case):
    spoil, expected = MISTAKES[case]
    _hidden(tmp_path / "a", car(20))
    spoil(tmp_path / "a")
    with pytest.raises(InputError, match=expected) as error:
        list(AutoReader().read(tmp_path / "a"))
    assert "\n" not in str(error.value)
