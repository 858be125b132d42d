"""What a drive tells of its own log is right, and what it cannot tell is not given as sure."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dlkf.command.composing import composed
from dlkf.data.discovery.clock import find_lag, known_offset
from dlkf.data.discovery.drift import ends_apart, ends_std, find_drifting_pose, middle
from dlkf.data.discovery.motion import levelled, motion, position_delay
from dlkf.data.discovery.orientation import find_pose
from dlkf.data.discovery.units import accel_units, nearest_unit, time_unit, unit_left
from dlkf.data.intake import ingest_drives
from dlkf.data.plausibility import check_clocks, turned_told
from dlkf.data.readers import units
from dlkf.data.readers.auto import AutoReader, _velocities_beside, offer
from dlkf.data.readers.frames import DriveFrames, Table
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.recognise import gnss_spec, imu_spec
from dlkf.data.readers.units import rotation
from dlkf.data.schema import ACCEL, GYRO, VELOCITY
from dlkf.data.tables import read_drives, read_table
from dlkf.diagnosis.checkup import checkup
from dlkf.errors import InputError
from tests.cars import car
from tests.data.logs.bags import _Bag, ros1, ros2, ros2_ublox
from tests.data.logs.receivers import ubx_fixes
from tests.data.test_formats import read
from tests.drives import drives_in

TURN = Rotation.from_euler("ZYX", [130.0, -35.0, 70.0], degrees=True).as_matrix()  # car → sensor
UNIX = 1_751_760_000


@pytest.fixture(scope="module")
def drive():
    """Three minutes of perfect sensors."""
    return car(180)


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """Three simulated minutes with perfect sensors: no turn like the one before, as the analytic path has them."""
    own = ["simulated@dataset=per_drive", "imu=perfect", "dataset.hours=0.05", "dataset.drive_minutes=3", "seed=5"]
    streets = tmp_path_factory.mktemp("data") / "streets"
    folder = drives_in(composed("simulate", *own), streets)
    name = read_drives(folder)[0].name
    return {kind: pd.DataFrame(read_table(folder, kind, name)) for kind in ("imu", "gnss")}


def _arrays(tables, turn=TURN, offset=0.0):
    imu, gnss = tables["imu"], tables["gnss"]
    accel, gyro = (imu[list(c)].to_numpy() @ turn.T for c in (ACCEL, GYRO))
    v = gnss[list(VELOCITY)].to_numpy()
    return imu.t.to_numpy(), accel, gyro, motion(gnss.t.to_numpy() - offset, *_place(gnss), v)


def _place(gnss):
    return gnss.lat_deg.to_numpy(), gnss.lon_deg.to_numpy()


@pytest.mark.parametrize("offset", [0.0, 18.0, -5123.4, 604_800.0 * 3 + 0.37])
def test_any_clock_offset(drive, offset):
    """To a quarter of a second by correlation, to a millisecond with the pose: the sensors are perfect."""
    t, accel, gyro, gnss = _arrays(drive, offset=offset)
    lag = find_lag(t, accel, gyro, gnss)
    assert lag is not None and lag.clear and abs(lag.lag_s - offset) < 0.3
    pose = find_pose(t, accel, gyro, gnss, lag.lag_s)
    assert pose is not None and abs(pose.lag_s - offset) < 2e-3


def test_biases_of_the_gyroscopes_are_told_from_turning_about_a_leaning_axis():
    """A loop of 360° under 3° in a minute: pitch and roll from the gyroscopes leave gravity where it was."""
    t = 0.01 * np.arange(1, 12_001)
    rate = np.where((t > 40) & (t <= 70), 2 * np.pi / 30, 0.0)
    lean = Rotation.from_euler("X", 3.0, degrees=True).as_matrix().T  # level → sensor
    bias = np.array([2e-3, -1e-3, 0.0])
    gyro = rate[:, None] * lean[:, 2] + bias
    accel = np.broadcast_to(-9.81 * lean[:, 2], gyro.shape)
    level = levelled(t, accel, gyro, np.array([0.0, 0.0, 1.0]))
    grown = np.diff(level.tilted) / np.diff(level.t)
    # what turns about down is cos 3° of the loop, half a degree short; with mean rates for biases, 2π sin 3° / 120 s
    # would have grown to 0.1 rad, 1 m/s², by the end of the loop
    assert np.abs(grown - grown[0]).max() < 0.01


def test_any_pose_and_unit(drive):
    """The car pitches and rolls not at all, so all that is left is a fit's rounding: a tenth of a degree."""
    t, accel, gyro, gnss = _arrays(drive)
    pose = find_pose(t, accel, np.degrees(gyro), gnss, 0.0)
    assert pose is not None
    assert math.degrees(Rotation.from_matrix(pose.matrix @ TURN).magnitude()) < 0.1
    assert pose.gyro_scale == pytest.approx(np.pi / 180, rel=5e-3)
    assert pose.scale == pytest.approx(1, abs=0.01) and pose.explained > 0.99
    assert abs(pose.lever_arm) < 0.1


@pytest.mark.parametrize("decades_s", [0.0, -1.457507878e9])  # a counter that began today, beside GPS time
def test_clocks_that_drift_apart(drive, decades_s):
    """1000 ppm over three minutes are 0.18 s; with perfect sensors they are seen to some ppm, and none where none are.

    The offset is that of the middle: 90 s of 1000 ppm. 20 ppm over 90 s are 2 ms.
    """
    imu, gnss = drive["imu"], drive["gnss"]
    fast = {"imu": imu.assign(t=imu.t * 1.001), "gnss": gnss}
    for tables, drift in ((fast, 1e-3), (drive, 0.0)):
        t, accel, gyro, moved = _arrays(tables)
        lag_s = drift * middle(moved) + decades_s
        pose = find_drifting_pose(t, accel, gyro, replace(moved, t=moved.t - decades_s), decades_s)
        assert pose is not None and abs(pose.drift - drift) < 2e-5 and pose.drift_std < 1e-4
        assert abs(pose.lag_s - lag_s) < 2e-3


def test_a_drift_is_found_or_refused(tmp_path, drive):
    """A reader that may find it writes it down, and reads with it; one that may not says it in one line."""
    for kind, factor in (("imu", 1.001), ("gnss", 1.0)):
        drive[kind].assign(t=drive[kind]["t"] * factor).to_csv(tmp_path / f"{kind}.csv", index=False)
    spec = {"file": "imu.csv", "accel": {"columns": list(ACCEL)}, "gyro": {"columns": list(GYRO)}}
    fixes = {"file": "gnss.csv", "position": {"columns": ["lat_deg", "lon_deg", "height_m"]}}
    fixes["velocity"] = {"columns": list(VELOCITY)}
    time = {"column": "t", "offset_s": "auto"}
    with pytest.raises(InputError, match=r"clocks drift apart, 9\d\d|clocks drift apart, 10\d\d"):
        list(LogReader({**spec, "time": {"column": "t"}}, {**fixes, "time": time}).read(tmp_path))
    own = {**fixes, "time": {"column": "t", "drift_ppm": "auto"}}
    (found,) = LogReader({**spec, "time": {"column": "t"}}, own).read(tmp_path)
    assert found.mapping["gnss"]["time"]["drift_ppm"] == pytest.approx(1000, abs=20)
    assert found.gnss is not None
    np.testing.assert_allclose(found.gnss.t, 1.001 * drive["gnss"].t, atol=4e-3)


def test_a_drift_that_no_lag_fits_is_found(streets):
    """5000 ppm over three minutes, 0.9 s: the fit at one lag sees nothing of it, the drive's two ends do.

    What is left is the car's: rolling in its turns, sideslip. They are in the 1σ, 100 ppm.
    """
    t, accel, gyro, moved = _arrays({"imu": streets["imu"].assign(t=1.005 * streets["imu"].t), "gnss": streets["gnss"]})
    ends = ends_apart(t, accel, gyro, moved)
    assert ends is not None and abs(ends.drift - 5e-3) < 1e-3
    pose = find_drifting_pose(t, accel, gyro, moved, 0.0)
    assert pose is not None and abs(pose.drift - 5e-3) < 3 * pose.drift_std < 4e-4


def test_what_is_not_known_of_a_drift_grows_to_the_ends(drive):
    """Perfect sensors: as sure in the middle as at the ends; ± 100 ppm where a drift was found, ± 30 (two crystals)
    where none was seen, over 90 s."""
    t, accel, gyro, moved = _arrays(drive)
    pose = find_pose(t, accel, gyro, moved, 0.0)
    assert pose is not None
    unsure = replace(pose, lag_std=0.004, drift=5e-4, drift_std=1e-4)
    assert ends_std(unsure, 90.0) == pytest.approx(math.hypot(0.004, 0.009))
    assert ends_std(replace(unsure, drift=0.0), 90.0) == pytest.approx(math.hypot(0.004, 0.0027))
    assert ends_std(replace(unsure, drift=0.0, drift_std=math.nan), 90.0) == pytest.approx(math.hypot(0.004, 0.0027))


def test_a_small_drift_is_told_with_its_remedy(tmp_path, streets):
    """0.2 % over three minutes are 0.36 s: taken in, with a line; 200 ppm, 0.04 s, are no line's worth."""
    for factor, told in ((1.002, True), (1.0002, False)):
        folder = tmp_path / f"x{factor}"
        imu = streets["imu"].assign(t=factor * streets["imu"].t)
        frames = DriveFrames({"drive": "a", "group": "a"}, imu, streets["gnss"])
        taken = []
        ingest_drives([frames], folder, progress=lambda one, _, into=taken: into.append(one))
        assert bool(taken[0].notes) == told
    (row,) = read_drives(tmp_path / "x1.002")
    (seen,) = [seen for seen in checkup(tmp_path / "x1.002", row) if "ppm" in seen.text]
    assert seen.grade == "note" and "drift_ppm=auto" in seen.text


def test_a_drift_over_a_long_drive_is_told(drive):
    """Where a third of the drive is a second from another: no lag fits the whole."""
    imu, gnss = ({k: v.to_numpy() for k, v in drive[kind].items()} for kind in ("imu", "gnss"))
    check_clocks(imu, gnss, "drive")
    with pytest.raises(InputError, match=r"drift apart, by about \d+ ppm"):
        check_clocks(imu | {"t": imu["t"] * 1.02}, gnss, "drive")


def test_a_lever_arm_is_seen(drive):
    """Antenna 1.2 m before and 0.5 m left of the IMU: velocities of the antenna are those of the IMU plus ω × l."""
    imu, gnss = drive["imu"], drive["gnss"].copy()
    yaw = drive["reference"]["yaw"].to_numpy()[::10][: len(gnss)]
    rate = np.interp(gnss.t, imu.t, imu.gyro_z)
    swing = np.stack((-rate * -0.5, rate * 1.2), -1)  # forward, right
    gnss["vel_n"] += swing[:, 0] * np.cos(yaw) - swing[:, 1] * np.sin(yaw)
    gnss["vel_e"] += swing[:, 0] * np.sin(yaw) + swing[:, 1] * np.cos(yaw)
    t, accel, gyro, moved = _arrays({"imu": imu, "gnss": gnss})
    pose = find_pose(t, accel, gyro, moved, 0.0)
    assert pose is not None and abs(pose.lever_arm - (1.2 - 0.5j)) < 0.1


def test_positions_older_than_velocities(drive):
    """Fixes at 4 Hz, so that a position 0.2 s old is that of the row before by interpolation: 5 ms of curvature."""
    gnss = car(120, gnss_hz=10)["gnss"]
    late = gnss.copy()
    late[["lat_deg", "lon_deg"]] = gnss[["lat_deg", "lon_deg"]].shift(2)
    late = late.iloc[2:]
    delay, std = position_delay(late.t.to_numpy(), *_place(late), late[list(VELOCITY)].to_numpy())
    assert delay == pytest.approx(0.2, abs=5e-3) and std < 0.02


def test_nothing_is_made_up():
    """A car at rest, one that drives straight on at one speed, and noise: no pose, no clear clock."""
    tables = car(120)
    rng = np.random.default_rng(1)
    t = tables["imu"].t.to_numpy()
    noise = rng.normal(0, 0.3, (2, len(t), 3)) + np.array([[[0, 0, -9.8]], [[0, 0, 0]]])
    gnss = tables["gnss"]
    v = gnss[list(VELOCITY)].to_numpy()
    for moved in (motion(gnss.t.to_numpy(), *_place(gnss), v), motion(gnss.t.to_numpy(), *_place(gnss), 0 * v)):
        lag = find_lag(t, noise[0], noise[1], moved)
        assert lag is None or not lag.clear
        pose = find_pose(t, noise[0], noise[1], moved, 0.0)
        assert pose is None or pose.explained < 0.8 or pose.yaw_std > math.radians(2)


def test_a_straight_minute_is_refused_with_the_limits_that_would_take_it(tmp_path):
    """Random throttle on a road that bends by ± 1°: the line names the way on, and that way is taken."""
    t, rng = np.arange(1, 7001) * 0.01, np.random.default_rng(4)
    pull = np.interp(t, np.arange(0, 80, 4.0), np.tile([1.0, -1.0], 10) * rng.uniform(0.1, 1.5, 20))
    speed = 14 + np.concatenate(([0.0], np.cumsum(0.5 * (pull[1:] + pull[:-1]) * 0.01)))
    course, rate = 0.02 * np.sin(0.2 * t), 0.004 * np.cos(0.2 * t)
    imu = pd.DataFrame({"t": t, "ax": pull, "ay": speed * rate, "az": -9.81, "wx": 0.0, "wy": 0.0, "wz": rate})
    imu.iloc[:, 1:4] += rng.normal(0, 0.3, (len(t), 3))
    imu.iloc[:, 4:] += np.radians(rng.normal(0, 0.3, (len(t), 3)))
    imu.iloc[:, 4:] = np.degrees(imu.iloc[:, 4:])
    imu.to_csv(tmp_path / "imu.csv", index=False)
    rows = slice(99, None, 100)
    way = np.cumsum(speed) * 0.01
    fix = {"t": t[rows], "lat": 48 + way[rows] / 111_200, "lon": 11.0, "alt": 500.0}
    fix["ve"], fix["vn"] = (speed[rows] * x[rows] for x in (np.sin(course), np.cos(course)))
    fixes = pd.DataFrame(fix)
    fixes[["ve", "vn"]] += rng.normal(0, 0.05, (len(fixes), 2))
    fixes.to_csv(tmp_path / "gnss.csv", index=False)
    with pytest.raises(InputError, match=r"or take it as it is: reader\.sure\.") as error:
        list(AutoReader(gnss={"file": "gnss.csv"}).read(tmp_path))
    words = str(error.value).partition("take it as it is: ")[2].split()
    sure = {name.removeprefix("reader.sure."): float(value) for name, _, value in (w.partition("=") for w in words)}
    (got,) = AutoReader(gnss={"file": "gnss.csv"}, sure=sure).read(tmp_path)
    assert got.mapping["imu"]["gyro"]["unit"] == "deg/s"
    off = rotation(got.mapping["imu"]["accel"]["axes"], "")
    assert math.degrees(Rotation.from_matrix(off).magnitude()) < sure.get("angle_deg", 2.0)


def test_units_by_size():
    assert accel_units(9.9, units.ACCELERATION) == ["m/s2"]
    assert accel_units(1.02, units.ACCELERATION) == ["g"]
    assert set(accel_units(990.0, units.ACCELERATION)) == {"mg", "cm/s2"}  # 2 % apart, as biases are
    assert accel_units(3.3, units.ACCELERATION) == []
    assert nearest_unit(0.0176, 1e-4, units.RATE) == "deg/s"
    assert nearest_unit(0.1, 1e-4, units.RATE) is None
    # half unknown: °/s by elimination, as long as a car would not shake in m°/s or °/h too
    assert unit_left(0.0204, 0.01, 1.2, units.RATE) == "deg/s"
    assert unit_left(0.0204, 0.01, 5000.0, units.RATE) is None and unit_left(0.5, 0.05, 1.2, units.RATE) is None
    assert time_unit(1.75e12 + 10.0 * np.arange(9), 0.2, 1e-4) == "ms"
    assert time_unit(10.0 * np.arange(9), 0.21, 2e-4) == "ms"
    assert "leap seconds" in known_offset(18.1) and "3 GPS weeks" in known_offset(3 * 604_800.0)
    assert "time zone of +2 h" in known_offset(7200.0) and known_offset(-63.0) == ""
    assert "tells no date" in known_offset(-1_421_625_596.8) and known_offset(20 * 3600.0) == ""


def _hidden(folder, tables, offset=1234.5, header=True):
    """Two files of odd units on clocks of their own."""
    folder.mkdir(parents=True)
    imu, gnss = tables["imu"], tables["gnss"]
    odd = pd.DataFrame({"stamp": np.round(1000 * imu.t).astype(int)})
    for name, columns, unit in (("acc", ACCEL, 9.80665), ("gyr", GYRO, np.pi / 180)):
        values = imu[list(columns)].to_numpy() @ TURN.T / unit
        odd[[f"{name}_{a}" for a in "xyz"]] = values
    odd.to_csv(folder / "box.txt", index=False, sep=";", header=header)
    fix = pd.DataFrame({"unix_time": UNIX + gnss.t - offset, "Latitude": gnss.lat_deg, "Longitude": gnss.lon_deg})
    fix["Altitude"], fix["speed"] = gnss.height_m, 3.6 * np.hypot(gnss.vel_n, gnss.vel_e)
    fix["course"] = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    fix.to_csv(folder / "receiver.csv", index=False)


def test_logs_of_which_nothing_is_known(tmp_path, drive):
    """Formats, columns, units, pose and clocks found; the written preset reads the logs to the same tables."""
    _hidden(tmp_path / "logs" / "monday", drive)
    (got,) = AutoReader().read(tmp_path / "logs")
    found = "\n".join(got.notes)
    for told in ("accel.unit=g", "gyro.unit=deg/s", "velocity.unit=km/h", "offset_s=", "axes={roll", "lever_arm_m"):
        assert f"{told}" in found, told
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


def _table(text, name="a.csv"):
    return Table(pd.read_csv(io.StringIO(text)), Path(name))


def test_a_receivers_table_with_km_h_in_its_names_and_words_for_its_quality():
    spec = gnss_spec(
        _table("time_ns,lat,lon,alt,speed_kmh,course,fix\n" + "1751760000000000000,50,8,9,36,0,RTK float\n" * 3)
    )
    assert spec["velocity"] == {"columns": ["speed_kmh", "course"], "frame": "course"}
    assert spec["quality"] == {"column": "fix", "map": {"RTK float": 5}}
    odd = gnss_spec(_table("t,lat,lon,alt,fix\n1751760000,50,8,9,rather good\n1751760001,50,8,9,RTK\n"))
    assert "quality" not in odd


def test_rows_of_imu_and_fixes_in_one_table():
    """Each kind by its own rows: their stamps, and columns that are empty for most."""
    fast = "".join(f"{0.01 * k:.2f},0,0,-9.8,0,0,0,,,\n" for k in range(40))
    both = _table("t,ax,ay,az,gx,gy,gz,lat,lon,alt\n" + fast + "0.20,,,,,,,50,8,90\n0.40,,,,,,,50,8,90\n")
    assert imu_spec(both)["time"] == gnss_spec(both)["time"] == {"column": "t", "unit": "s"}


def test_stamps_under_a_name_of_their_own():
    """The only column that rises all the way; a count of the rows tells no time, and of two clocks none is chosen."""
    rows = [f"{4711000 + 10 * k},{k},{20 * k},0,0,-1,{k % 3},0,0\n" for k in range(40)]
    table = _table("Zeit [ms],Nr,Odo,accX,accY,accZ,gyrX,gyrY,gyrZ\n" + "".join(rows))

    def without(*names: str) -> Table:
        return Table(table.frame.drop(columns=list(names)), table.path)

    spec = imu_spec(without("Odo"))
    assert spec is not None and spec["time"] == {"column": "Zeit [ms]", "unit": "ms"}
    assert imu_spec(without("Odo", "Zeit [ms]")) is None is imu_spec(table)


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
    with pytest.raises(InputError, match=r"town.ubx: no IMU found in it; give the folder"):
        list(AutoReader().read(tmp_path / "town.ubx"))
    (tmp_path / "lone.db3").touch()
    with pytest.raises(InputError, match="ros2 bag reindex"):
        AutoReader().places(tmp_path / "lone.db3")
    ros2(tmp_path, tables)
    (part,) = (tmp_path / "drive").glob("*.db3")
    assert AutoReader().places(part) == [(tmp_path / "drive", "drive", tmp_path / "drive" / "metadata.yaml")]


def test_a_sensor_that_seems_turned_gets_a_line(streets):
    """By 75° about the vertical; the line asks for less than the check that refuses, none as the drive is."""
    imu, gnss = ({k: v.to_numpy() for k, v in streets[kind].items()} for kind in ("imu", "gnss"))
    assert turned_told(imu, gnss) is None
    turn = Rotation.from_euler("Z", 75.0, degrees=True).as_matrix()
    turned = {**imu, **dict(zip(ACCEL, turn @ np.stack([imu[c] for c in ACCEL])))}
    assert "turned by" in (turned_told(turned, gnss) or "")


def test_velocities_in_a_file_beside_the_fixes(tmp_path):
    """Of the same column of time, and none but they."""
    for name, columns, row in (
        ("pos", "t,lat,lon,alt", "1751760000,50,8,9"),
        ("vel", "t,speed,course", "1751760000,9,45"),
    ):
        (tmp_path / f"{name}.csv").write_text(f"{columns}\n" + f"{row}\n" * 3)
    chosen = offer(tmp_path / "pos.csv")
    found = _velocities_beside(chosen, chosen.gnss, tmp_path.iterdir())
    assert found == {"columns": ["speed", "course"], "frame": "course", "file": "vel.csv"}


@pytest.mark.parametrize("writer", [ros1, ros2])
def test_velocities_of_a_bag_lie_in_a_topic_of_their_own(tmp_path, writer):
    """NavSatFix has none; NavPVT has, so that nothing is looked for."""
    tables = car(6)
    writer(tmp_path, tables)
    (path,) = (p for pattern in ("*.bag", "drive/metadata.yaml") for p in tmp_path.glob(pattern))
    chosen = offer(path)
    assert _velocities_beside(chosen, chosen.gnss, []) == {"table": "/gnss/vel"}
    (got,) = read(path.parent, ["reader=rosbag"])
    assert any("reader.gnss.velocity.table=/gnss/vel" in note for note in got.notes)
    (tmp_path / "ublox").mkdir()
    ros2_ublox(tmp_path / "ublox", tables)
    other = offer(tmp_path / "ublox" / "drive" / "metadata.yaml")
    assert _velocities_beside(other, other.gnss, []) is None


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


def test_a_chosen_file_that_is_not_there(tmp_path):
    _hidden(tmp_path / "a", car(20))
    with pytest.raises(InputError, match=r"reader.imu.file=nope.csv: no such IMU here; found in box.txt"):
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
    spoil, told = MISTAKES[case]
    _hidden(tmp_path / "a", car(20))
    spoil(tmp_path / "a")
    with pytest.raises(InputError, match=told) as error:
        list(AutoReader().read(tmp_path / "a"))
    assert "\n" not in str(error.value)
