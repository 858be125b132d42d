"""What a drive tells of its own log is right, and what it cannot tell is not given as sure."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from dlkf.base.errors import InputError
from dlkf.data.discovery.clock import ImuSums, describe_offset, find_lag
from dlkf.data.discovery.drift import compare_ends, ends_std, find_drifting_pose, find_step, middle
from dlkf.data.discovery.findings import Finding, discover, find_value
from dlkf.data.discovery.motion import find_motion, integrate_level, position_delay
from dlkf.data.discovery.orientation import find_pose
from dlkf.data.discovery.units import accel_units, nearest_unit, time_unit, unit_left
from dlkf.data.intake import ingest_drives
from dlkf.data.plausibility import check_clocks, describe_clocks
from dlkf.data.readers import units
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.settling import _take_stated_unit
from dlkf.data.readers.units import rotation
from dlkf.data.schema import ACCEL, GYRO, VELOCITY
from dlkf.data.tables import read_drives
from dlkf.diagnosis.checkup import checkup
from tests.cars import car

TURN = Rotation.from_euler("ZYX", [130.0, -35.0, 70.0], degrees=True).as_matrix()  # car → sensor


def _arrays(tables, turn=TURN, offset=0.0):
    imu, gnss = tables["imu"], tables["gnss"]
    accel, gyro = (imu[list(c)].to_numpy() @ turn.T for c in (ACCEL, GYRO))
    return imu.t.to_numpy(), accel, gyro, find_motion(gnss.assign(t=gnss.t - offset))


@pytest.mark.parametrize("offset", [0.0, 18.0, -5123.4, 604_800.0 * 3 + 0.37])
def test_any_clock_offset(drive, offset):
    """To a quarter of a second by correlation, to a millisecond with the pose: the sensors are perfect."""
    t, accel, gyro, gnss = _arrays(drive, offset=offset)
    lag = find_lag(ImuSums.of(t, accel, gyro), gnss)
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
    level = integrate_level(t, accel, gyro, np.array([0.0, 0.0, 1.0]))
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


def test_fast_fixes_make_no_more_intervals(drive):
    """Up to 20 Hz one from every fix; beyond, five to eleven that overlap, and the same pose."""
    for hz, phase in ((1, 1), (5, 1), (10, 1), (20, 1), (50, 4), (100, 9)):
        gnss = find_motion(car(100, gnss_hz=hz)["gnss"])
        first, last = gnss.intervals(overlapping=True)
        assert gnss.phase == phase and len(first) <= 100 * 20 and (last - first == gnss.stride).all()
    t, accel, gyro, _ = _arrays(drive)
    pose = find_pose(t, accel, gyro, gnss, 0.0)
    assert pose is not None and abs(pose.lag_s) < 2e-3
    assert math.degrees(Rotation.from_matrix(pose.matrix @ TURN).magnitude()) < 0.1


@pytest.mark.parametrize("name, value", [("ax", -9999.0), ("gz", -32768.0), ("gz", 400.0)])
def test_a_damaged_sample_takes_nothing_from_what_is_found(tmp_path, drive, name, value):
    """Beyond full scale, or a spike, in g and °/s that are yet to be found."""
    imu = drive["imu"]
    table = {"time": imu.t, **{f"a{x}": imu[f"accel_{x}"] / 9.80665 for x in "xyz"}}
    table |= {f"g{x}": np.degrees(imu[f"gyro_{x}"]) for x in "xyz"}
    whole, damaged = pd.DataFrame(table), pd.DataFrame(table)
    damaged.loc[[3000, 7000], name] = value
    found = []
    for folder, one in ((tmp_path / "whole", whole), (tmp_path / "damaged", damaged)):
        folder.mkdir()
        one.to_csv(folder / "imu.csv", index=False)
        drive["gnss"].to_csv(folder / "gnss.csv", index=False)
        (got,) = AutoReader().read(folder)
        found.append({key: got.mapping["imu"][key]["unit"] for key in ("accel", "gyro")})
        found[-1]["offset_s"] = got.mapping["gnss"]["time"]["offset_s"]
    assert found[0] == found[1] == {"accel": "g", "gyro": "deg/s", "offset_s": 0.0}


@pytest.mark.parametrize("decades_s", [0.0, -1.457507878e9])  # a counter that began today, beside GPS time
@pytest.mark.whole
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


@pytest.mark.whole
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


@pytest.mark.parametrize("ppm", [1000, 3000, 5000])
def test_a_drift_is_no_step_of_a_clock(streets, ppm):
    t, accel, gyro, moved = _arrays({**streets, "imu": streets["imu"].assign(t=(1 + 1e-6 * ppm) * streets["imu"].t)})
    sums = ImuSums.of(t, accel, gyro)
    ends = compare_ends(sums, moved)
    assert ends is not None and find_step(sums, moved, ends) is None


@pytest.mark.parametrize(("step_s", "at"), [(0.6, 90.0), (1.0, 70.0), (1.0, 110.0), (4.0, 70.0)])
def test_a_clock_that_steps_is_no_drift(tmp_path, streets, step_s, at):
    """No offset and no drift is right then: the line says when, and nothing is taken for sure."""
    gnss = streets["gnss"].assign(t=streets["gnss"].t + np.where(streets["gnss"].t > at, step_s, 0.0))
    when = r"between t = (\d+) and (\d+) s"
    with pytest.raises(InputError, match=f"the clock of IMU or GNSS steps {when}") as refused:
        check_clocks({c: streets["imu"][c].to_numpy() for c in streets["imu"]}, gnss, "drive")
    first, last = map(int, re.findall(when, str(refused.value))[0])
    assert first - 3 <= at <= last + 3 and last - first < 60  # a straight road
    streets["imu"].to_csv(tmp_path / "imu.csv", index=False)
    gnss.to_csv(tmp_path / "gnss.csv", index=False)
    with pytest.raises(InputError, match=rf"a clock steps by {step_s:.1f} s, \d+ to \d+ s after the first"):
        list(AutoReader(sure={"time_s": 1.0}).read(tmp_path))


def test_a_drift_that_no_lag_fits_is_found(streets):
    """5000 ppm over three minutes, 0.9 s: the fit at one lag sees nothing of it, the drive's two ends do.

    What is left is the car's: rolling in its turns, sideslip. They are in the 1σ, 100 ppm.
    """
    t, accel, gyro, moved = _arrays({"imu": streets["imu"].assign(t=1.005 * streets["imu"].t), "gnss": streets["gnss"]})
    ends = compare_ends(ImuSums.of(t, accel, gyro), moved)
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
    for factor, expected in ((1.002, True), (1.0002, False)):
        folder = tmp_path / f"x{factor}"
        imu = streets["imu"].assign(t=factor * streets["imu"].t)
        frames = DriveFrames({"drive": "a", "group": "a"}, imu, streets["gnss"])
        taken = []
        ingest_drives([frames], folder, progress=lambda one, _, into=taken: into.append(one))
        assert bool(taken[0].notes) == expected
    (row,) = read_drives(tmp_path / "x1.002")
    (seen,) = [seen for seen in checkup(tmp_path / "x1.002", row) if "ppm" in seen.text]
    assert seen.grade == "note" and "drift_ppm=auto" in seen.text


def test_positions_on_another_clock_than_velocities_are_told_with_one_remedy(tmp_path, streets):
    """Velocities 0.15 s late, positions on time: no offset of the IMU suits both."""
    gnss = streets["gnss"]
    spline = CubicSpline(gnss.t, gnss[list(VELOCITY)])
    frames = DriveFrames(
        {"drive": "a", "group": "a"}, streets["imu"], gnss.assign(**dict(zip(VELOCITY, spline(gnss.t - 0.15).T)))
    )
    ingest_drives([frames], tmp_path / "x")
    (row,) = read_drives(tmp_path / "x")
    (seen,) = [seen for seen in checkup(tmp_path / "x", row) if seen.text.startswith("clocks")]
    apart = re.search(
        r"add \+(0\.\d+) s .* for the velocities, ([+-]0\.\d+) s for the positions, .* newer than they", seen.text
    )
    assert apart and abs(float(apart[1]) - 0.15) < 0.03 and abs(float(apart[2])) < 0.03
    autos = " ".join(f"reader.{x}=auto" for x in ("imu.time.offset_s", "gnss.time.drift_ppm", "gnss.position.delay_s"))
    assert seen.grade == "note" and seen.text.endswith(f"ingest with {autos}")


def test_a_drift_over_a_long_drive_is_told(drive):
    """Where a third of the drive is a second from another: no lag fits the whole."""
    imu, gnss = ({k: v.to_numpy() for k, v in drive[kind].items()} for kind in ("imu", "gnss"))
    check_clocks(imu, gnss, "drive")
    with pytest.raises(InputError, match=r"drift apart, by about \d+ ppm"):
        check_clocks(imu | {"t": imu["t"] * 1.02}, gnss, "drive")


@pytest.mark.parametrize(("late_s", "turned", "said"), [(0.0, 0, ""), (5.0, 0, "5.0 s apart"), (0.0, 90, "turned by")])
def test_coarse_positions_alone_show_another_clock_or_a_turned_sensor(streets, late_s, turned, said):
    """Half a metre of noise in a position a second: differences are noise, lines through five seconds are not."""
    noise = 0.5 / 111e3 * np.random.default_rng(4).standard_normal((len(streets["gnss"]), 2))
    gnss = streets["gnss"].assign(t=streets["gnss"].t + late_s, **dict.fromkeys(VELOCITY, np.nan))
    gnss[["lat_deg", "lon_deg"]] += noise
    gnss = gnss.iloc[:: max(1, round(1 / np.median(np.diff(gnss.t))))]
    turn = Rotation.from_euler("Z", turned, degrees=True).as_matrix()
    imu = streets["imu"].copy()
    for axes in (ACCEL, GYRO):
        imu[list(axes)] = imu[list(axes)].to_numpy() @ turn
    tables = [{c: frame[c].to_numpy() for c in frame} for frame in (imu, gnss)]
    if not said:
        check_clocks(*tables, "drive")
        return
    with pytest.raises(InputError, match=said):
        check_clocks(*tables, "drive")


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
    delay, std = position_delay(late)
    assert delay == pytest.approx(0.2, abs=5e-3) and std < 0.02


def test_nothing_is_made_up():
    """A car at rest, one that drives straight on at one speed, and noise: no pose, no clear clock."""
    tables = car(120)
    rng = np.random.default_rng(1)
    t = tables["imu"].t.to_numpy()
    noise = rng.normal(0, 0.3, (2, len(t), 3)) + np.array([[[0, 0, -9.8]], [[0, 0, 0]]])
    gnss = tables["gnss"]
    for moved in (find_motion(gnss), find_motion(gnss.assign(**dict.fromkeys(VELOCITY, 0.0)))):
        lag = find_lag(ImuSums.of(t, noise[0], noise[1]), moved)
        assert lag is None or not lag.clear
        pose = find_pose(t, noise[0], noise[1], moved, 0.0)
        assert pose is None or pose.explained < 0.8 or pose.yaw_std > math.radians(2)


def test_without_a_usable_fix_clock_and_axes_are_unsure():
    tables = car(60)
    imu, gnss = ({c: t[c].to_numpy() for c in t} for t in (tables["imu"], tables["gnss"].iloc[:0]))
    found = discover(imu, gnss, {"imu.axes", "gnss.time.offset_s", "lever_arm_m"})
    assert not any(f.sure for f in found if f.setting in ("imu.axes", "gnss.time.offset_s"))
    assert find_value(found, "lever_arm_m") == [0.0, 0.0, 0.0]


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
    assert "leap seconds" in describe_offset(18.1) and "3 GPS weeks" in describe_offset(3 * 604_800.0)
    assert "time zone of +2 h" in describe_offset(7200.0) and describe_offset(-63.0) == ""
    assert "has no date" in describe_offset(-1_421_625_596.8) and describe_offset(20 * 3600.0) == ""


@pytest.mark.parametrize("late_s, said", [(0.0, ""), (0.15, ""), (0.5, "0.5 s later"), (-0.7, "0.7 s earlier")])
def test_fixes_that_are_late_get_a_line(streets, late_s, said):
    imu, gnss = ({k: v.to_numpy() for k, v in streets[kind].items()} for kind in ("imu", "gnss"))
    lines = describe_clocks(imu, {**gnss, "t": gnss["t"] + late_s})
    assert lines == [] if not said else said in lines[0]


def test_a_sensor_that_seems_turned_gets_a_line(streets):
    """By 75° about the vertical; the line asks for less than the check that refuses, none as the drive is."""
    imu, gnss = ({k: v.to_numpy() for k, v in streets[kind].items()} for kind in ("imu", "gnss"))
    assert describe_clocks(imu, gnss) == []
    turn = Rotation.from_euler("Z", 75.0, degrees=True).as_matrix()
    turned = {**imu, **dict(zip(ACCEL, turn @ np.stack([imu[c] for c in ACCEL])))}
    (line,) = describe_clocks(turned, gnss)
    assert "turned by" in line


@pytest.mark.parametrize("name, unit", [("gyroRotation{}(rad/s)", "rad/s"), ("gyro_{}", None)])
def test_a_unit_in_the_names_counts_where_turns_leave_it_open(name, unit, tmp_path):
    """Fifteen seconds are too few for turns."""
    tables = car(15)
    imu = tables["imu"].rename(columns={c: name.format(c[-1].upper()) for c in GYRO})
    imu.to_csv(tmp_path / "imu.csv", index=False)
    tables["gnss"].to_csv(tmp_path / "gnss.csv", index=False)
    axes = {"accel": {"axes": "frd"}, "gyro": {"axes": "frd"}}
    reader = AutoReader(axes, {"time": {"offset_s": 0.0, "drift_ppm": 0.0}}, lever_arm_m=[0.0, 0.0, 0.0])
    if unit is None:
        with pytest.raises(InputError, match=r"not sure of reader\.imu\.gyro\.unit"):
            list(reader.read(tmp_path))
        return
    (got,) = reader.read(tmp_path)
    assert got.mapping["imu"]["gyro"]["unit"] == unit
    assert any("gyro.unit=rad/s  (as the columns' names state; " in note for note in got.notes)


def test_turns_count_more_than_a_unit_in_the_names():
    """A finding that is sure, or five sigma from the unit, stays."""
    imu = {"gyro": {"columns": ["wx (rad/s)", "wy (rad/s)", "wz (rad/s)"]}}
    for value, std, sure, kept in (("deg/s", 1e-4, True, True), (0.3, 0.1, False, True), (0.3, 0.2, False, False)):
        found = Finding("imu.gyro.unit", value, sure, "", std=std)
        assert (_take_stated_unit(found, imu) == found) == kept
