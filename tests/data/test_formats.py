"""The same drive through every reader gives the same tables of the contract, within the format's resolution."""

from __future__ import annotations

from datetime import datetime, timedelta
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
from hydra.utils import get_class

from dlkf.base.errors import InputError
from dlkf.command.composing import compose_command
from dlkf.data.intake import ingest_drives
from dlkf.data.readers.formats import novatel, rtklib
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.readers.units import WEEK_S
from dlkf.data.schema import driven_distance
from dlkf.data.summary import drive_line
from tests.cars import car
from tests.data import logs


class Resolution(NamedTuple):
    """What a format can hold: seconds, m/s², rad/s, metres, m/s."""

    t: float = 1e-6
    accel: float = 1e-9
    gyro: float = 1e-9
    position: float = 1e-4
    velocity: float = 1e-5
    down: bool = True  # has a vertical velocity
    speed: bool = True
    std: bool = True  # has a std of velocity
    spread: float = 1e-6  # of 1σ, relative


# half a step of the format each: UBX a sample of time (its tags are brought to GPS time by the order of messages),
# 2⁻¹⁰ m/s², 2⁻¹² °/s, 1e-9 deg (0.1 mm) and truncation, mm/s; NMEA with 7 digits of a minute, 4 of knots and degrees;
# seconds since 1970 as doubles 2⁻²² s; text with as many digits as it has;
# NAV-PVT in ROS has 1e-7 deg (1 cm) and whole mm
RESOLUTION = {
    "ubx": Resolution(t=0.0101, accel=5e-4, gyro=2.2e-6, position=1e-3, velocity=5.1e-4),
    "ubx_meas": Resolution(t=0.0101, accel=5e-4, gyro=2.2e-6, position=1e-3, velocity=5.1e-4),
    "nmea": Resolution(position=1e-3, velocity=1e-4, down=False, std=False),
    "navego": Resolution(t=1e-9),
    "navego_73": Resolution(t=1e-9),
    "matlab": Resolution(t=1e-9),
    "parquet": Resolution(t=5e-7),
    "kitti": Resolution(position=1e-3, velocity=1e-8),
    "kfgins": Resolution(speed=False, std=False, position=1e-3),
    "rtklib": Resolution(position=3e-4, velocity=5.1e-6),
    "rtklib_ecef": Resolution(position=3e-4, velocity=5.1e-5),
    "rtklib_dms": Resolution(position=1e-3, speed=False, std=False),
    "inertial_explorer": Resolution(position=1e-4, velocity=5.1e-6),
    "gnss_logger": Resolution(accel=5e-8, gyro=1e-9, down=False, velocity=2e-6),
    "sensor_logger": Resolution(down=False),
    "phyphox": Resolution(down=False, std=False),
    "phyphox_android": Resolution(down=False, std=False),
    "novatel": Resolution(accel=8e-7, gyro=5e-8, velocity=5.1e-5, std=False),
    "novatel_x": Resolution(accel=8e-7, gyro=5e-8, velocity=5.1e-5, std=False),
    "ros1": Resolution(std=False),
    "ros2": Resolution(),
    "ros1_nmea": Resolution(position=1e-3, velocity=1e-4, down=False, std=False),
    "ros1_ublox": Resolution(position=1e-2, velocity=5.1e-4, spread=0.02),
    "ros2_ublox": Resolution(position=1e-2, velocity=5.1e-4, spread=0.02),
}


@pytest.fixture(scope="module")
def drive():
    """Twenty seconds; ``fine`` has the state at every IMU sample."""
    tables = car(20)
    fine = car(20, gnss_hz=100)["gnss"].iloc[1:].reset_index(drop=True)
    return {**tables, "fine": fine}


def read(folder, overrides: list[str]) -> list[DriveFrames]:
    """The drives of a folder, by overrides as on the command line."""
    own = [f"++{o}" if o.startswith("reader.") else o for o in overrides]
    settings = compose_command("ingest", *own)["reader"]
    return list(get_class(settings.pop("_target_"))(**settings).read(folder))


@pytest.mark.parametrize("writer", logs.WRITERS, ids=lambda w: w.__name__)
def test_the_same_drive(writer, drive, tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    fine = RESOLUTION.get(writer.__name__, Resolution())
    options = writer(folder, drive)
    (got,) = read(folder if not writer.__name__.startswith("ros2") else folder / "drive", options)
    imu, gnss = got.imu, got.gnss
    want = drive["imu"].iloc[: len(imu)]
    assert len(drive["imu"]) - len(imu) <= 1  # UBX: samples after the last fix have no fix before them
    shift = np.round(np.median(imu.t - want.t))  # a whole second: IMU clocks start at their own
    np.testing.assert_allclose(imu.t - shift, want.t, atol=fine.t)
    for names, tolerance in (
        (("accel_x", "accel_y", "accel_z"), fine.accel),
        (("gyro_x", "gyro_y", "gyro_z"), fine.gyro),
    ):
        for name in names:
            np.testing.assert_allclose(imu[name], want[name], atol=tolerance, err_msg=name)
    truth = drive["gnss"]
    if writer is logs.kitti:  # its first row is that of the first IMU sample
        truth = drive["fine"].iloc[::100].reset_index(drop=True)
    assert len(gnss) == len(truth)
    np.testing.assert_allclose(gnss.t - shift, truth.t, atol=1e-6)
    assert logs.metres(gnss, truth).max() < fine.position
    if fine.speed:
        for name in ("vel_n", "vel_e", *(["vel_d"] if fine.down else [])):
            np.testing.assert_allclose(gnss[name], truth[name], atol=fine.velocity, err_msg=name)
    else:
        assert gnss[["vel_n", "vel_e", "vel_d"]].isna().all(axis=None)
    np.testing.assert_allclose(gnss.std_pos_e, 0.02, rtol=fine.spread)
    if writer is logs.gnss_logger:  # with accuracies of its own for heights
        np.testing.assert_allclose(gnss.std_pos_d, 0.03)
    if fine.std:
        np.testing.assert_allclose(gnss.std_vel_e, 0.05, rtol=fine.spread)
    assert set(gnss.quality) == {4}
    assert ingest_drives([got], tmp_path / "out") == 1
    assert "IMU 100 Hz" in drive_line(got) and "RTK fixed 100 %" in drive_line(got) and "stands" not in drive_line(got)


def test_standstills_are_told(drive):
    """Three seconds at the beginning and five in the middle; a second of creeping does not count."""
    gnss = drive["gnss"].copy()
    for first, last in ((0, 3), (8, 13), (16, 17)):
        gnss.loc[first:last, ["vel_n", "vel_e"]] = 0.05
    frames = DriveFrames({"drive": "a", "group": "a"}, drive["imu"], gnss)
    assert drive_line(frames).endswith("stands 2 times for 8 s in all") and "missing" not in drive_line(frames)
    thinned = DriveFrames(frames.meta, drive["imu"][np.arange(len(drive["imu"])) % 4 > 0], gnss)
    assert "25 % of its samples missing" in drive_line(thinned)


@pytest.mark.parametrize(
    ("short", "said"),
    [("imu", "the IMU covers 60 of 100 s of the fixes"), ("gnss", "the fixes cover 60 of 100 s of the IMU")],
)
def test_a_log_that_ends_before_the_other_is_told(tmp_path, short, said):
    """In one line; fixes and way are those that both have."""
    tables = {kind: car(100)[kind] for kind in ("imu", "gnss")}
    both = tables["gnss"][tables["gnss"].t <= (61 if short == "imu" else 60)]
    tables[short] = tables[short][tables[short].t <= 60]
    notes, lines = [], []
    ingest_drives(
        [DriveFrames({"drive": "a", "group": "a"}, *tables.values())],
        tmp_path / "out",
        progress=lambda one, _: (notes.extend(one.notes), lines.extend(one.lines)),
    )
    assert notes == [f"a: {said}"]
    table = pd.read_parquet(tmp_path / "out" / "drives.parquet")
    assert table["distance_m"].tolist() == pytest.approx([driven_distance(both)])
    assert f"{driven_distance(both) / 1000:.2f} km" in lines[0] and f"{len(both)} fixes" in lines[0]


def _pykitti():
    """pykitti.utils alone: the package as a whole wants OpenCV, for its images."""
    folder = Path(find_spec("pykitti").submodule_search_locations[0])
    spec = spec_from_file_location("pykitti_utils", folder / "utils.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_kitti_as_its_own_tool_reads_it(drive, tmp_path):
    """The layout that the test above reads, written by hand, is that of pykitti: the same numbers under its names."""
    logs.kitti(tmp_path, drive)
    files = sorted((tmp_path / "oxts" / "data").iterdir())
    packets = [one.packet for one in _pykitti().load_oxts_packets_and_poses(files)]
    imu, state = drive["imu"].iloc[: len(packets)], drive["fine"]
    read = {name: np.array([getattr(p, name) for p in packets]) for name in packets[0]._fields}
    for names, columns in (("af al au", "accel_"), ("wf wl wu", "gyro_")):
        for name, axis, sign in zip(names.split(), "xyz", (1, -1, -1)):
            np.testing.assert_allclose(read[name], sign * imu[columns + axis], atol=1e-9)
    for name, column in {"lat": "lat_deg", "lon": "lon_deg", "alt": "height_m", "vn": "vel_n", "ve": "vel_e"}.items():
        np.testing.assert_allclose(read[name], state[column], rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(read["vu"], -state["vel_d"], atol=1e-9)
    assert set(read["pos_accuracy"]) == {0.02} and set(read["posmode"]) == {4}


def _utc(gps: float) -> datetime:
    return datetime(1980, 1, 6) + timedelta(seconds=round(gps - 18, 3))


def _sow(gps: float) -> str:
    return f"{gps % WEEK_S:.3f}"


IE_TIMES = {
    "sow": ("Week GPSTime", "(weeks) (sec)", lambda gps: f"{gps // WEEK_S:.0f} {_sow(gps)}"),
    "utc": ("UTCDate UTCTime", "(MDY) (HMS)", lambda gps: f"{_utc(gps):%m/%d/%Y %H:%M:%S.%f}"),
    "utc, day first": ("UTCDate UTCTime", "(DMY) (HMS)", lambda gps: f"{_utc(gps):%d/%m/%Y %H:%M:%S.%f}"),
    "utc, year first, no units": ("UTCDate UTCTime", "", lambda gps: f"{_utc(gps):%Y-%m-%d %H:%M:%S.%f}"),
    "gps date": ("GPSDate GPSTime", "(YMD) (HMS)", lambda gps: f"{_utc(gps + 18):%Y/%m/%d %H:%M:%S.%f}"),
    "date and week's seconds": ("UTCDate GPSTime", "(MDY) (sec)", lambda gps: f"{_utc(gps):%m/%d/%Y} {_sow(gps)}"),
    "both": (
        "UTCDate Week GPSTime",
        "(MDY) (weeks) (sec)",
        lambda gps: f"{_utc(gps):%m/%d/%Y} {gps // WEEK_S:.0f} {_sow(gps)}",
    ),
}


@pytest.mark.parametrize("begin", [2350 * WEEK_S + 345_600, 2350 * WEEK_S - 5], ids=["midweek", "week's end"])
@pytest.mark.parametrize("time", IE_TIMES)
def test_an_export_of_inertial_explorer_in_any_time(time, begin, tmp_path):
    """The same instants, under names in another order, whatever they are told by; over the end of a week, too."""
    names, marks, cell = IE_TIMES[time]
    stamps = begin + np.arange(20.0)
    lines = [f" 1 48.{k:07d} {cell(t)} 11.5 500.0" for k, t in enumerate(stamps)]
    head = f"Q Latitude {names} Longitude H-Ell"
    below = "\n" + " ".join(["(1-6)", "(deg)", marks, "(deg)", "(m)"]) if marks else ""
    top = "Project: town\nProgram: Inertial Explorer\n\n"
    (tmp_path / "town.txt").write_text(f"{top}{head}{below}\n" + "\n".join(lines))
    table = novatel.read(tmp_path / "town.txt", kind="gnss", table=None, text={}).frame
    np.testing.assert_allclose(table["Week"] * WEEK_S + table["GPSTime"], stamps, atol=1e-6)
    np.testing.assert_allclose(table["Latitude"], [float(f"48.{k:07d}") for k in range(20)])


@pytest.mark.parametrize(
    ("date", "said"), [("03/04/2025", "day or month first"), ("13/13/2025", "no day"), ("today", "must be a date")]
)
def test_a_date_that_says_not_which_is_refused(date, said, tmp_path):
    (tmp_path / "town.txt").write_text(f"UTCDate UTCTime Latitude\n{date} 10:00:00 48.0\n{date} 10:00:01 48.0\n")
    with pytest.raises(InputError, match=said):
        novatel.read(tmp_path / "town.txt", kind="gnss", table=None, text={})


def test_units_that_some_columns_lack_stand_under_their_names(tmp_path):
    """Q and Name have none; the latitude's three cells are seen by the unit below it."""
    head = "   Week      GPSTime  Name       Latitude  Q\n  (weeks)      (sec)        (+/-D M S)   \n"
    (tmp_path / "town.txt").write_text(head + "   2350  1.0  a  -48 30 00.0 1\n   2350  2.0  b  -48 30 36.0 1\n")
    table = novatel.read(tmp_path / "town.txt", kind="gnss", table=None, text={}).frame
    np.testing.assert_allclose(table["Latitude"], [-48.5, -48.51])
    assert list(table["Name"]) == ["a", "b"] and list(table["Q"]) == [1, 1]


def test_the_latency_of_novatels_velocities_is_taken_off(tmp_path):
    """Dopplers of 0.25 s before under steady acceleration; none for the last fix, nor beside one that is missing."""
    lines, t = [], np.arange(20.0)
    for s in t:
        head = f"COM1,0,90.0,FINESTEERING,2350,{1000 + s:.3f},02000040,cdba,15823;SOL_COMPUTED"
        lines.append(f'#BESTPOSA,{head},SINGLE,52.1,9.9,35.0,45.0,WGS84,1,1,2,"",0,0,20,18,18,18,00,06,39,33')
        if s != 10:
            north, east, up = 3 + (s - 0.25), 2 * (s - 0.25), 0.1 * (s - 0.25)
            course = np.degrees(np.arctan2(east, north))
            cells = f"DOPPLER_VELOCITY,0.250,0.000,{np.hypot(north, east):.7f},{course:.7f},{up:.7f},0.0"
            lines.append(f"#BESTVELA,{head},{cells}")
    (tmp_path / "town.asc").write_text("\n".join(lines))
    table = novatel.read(tmp_path / "town.asc", kind="gnss", table=None, text={})
    assert "up to 0.25 s older than their stamps" in table.notes[0]
    want = np.stack((3 + t, 2 * t, -0.1 * t), -1)
    want[[9, 10, 19]] = np.nan
    np.testing.assert_allclose(table.frame[["vel_n", "vel_e", "vel_d"]], want, atol=1e-5)


def test_minutes_and_seconds_west_of_greenwich_keep_their_sign(tmp_path):
    """Minus zero degrees is a whole number without a sign."""
    head = "%  UTC                   latitude(d'\")   longitude(d'\")  height(m)   Q\n"
    rows = "".join(f"2025/07/05 10:00:0{k}.000  51 30 00.00000   -0 07 30.00000   40.0000   1\n" for k in (1, 2))
    (tmp_path / "town.pos").write_text(head + rows)
    table = rtklib.read(tmp_path / "town.pos", kind="gnss", table=None, text={}).frame
    np.testing.assert_allclose(table[["lat_deg", "lon_deg"]], [[51.5, -0.125]] * 2)
