"""Tables of fixes with several speeds, heights or receivers: which columns go together, in which units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import DriveFrames, LogTable
from dlkf.data.readers.receivers import find_velocity
from dlkf.data.readers.recognise import gnss_spec
from tests.cars import Tables, car
from tests.data.test_validate import hilly

FRD = {"accel": {"axes": "frd"}, "gyro": {"axes": "frd"}}


def read(folder: Path, imu: pd.DataFrame, table: pd.DataFrame, **settings: object) -> tuple[DriveFrames, str]:
    """The drive of these samples and this table of fixes, and what was found."""
    imu.to_csv(folder / "imu.csv", index=False)
    table.to_csv(folder / "gnss.csv", index=False)
    (got,) = AutoReader(FRD, {"time": {"offset_s": 0.0}, **settings}).read(folder)
    return got, "\n".join(got.notes)


def fixes(gnss: pd.DataFrame, **columns: object) -> pd.DataFrame:
    """A table with stamps and these columns."""
    return pd.DataFrame({"time": gnss.t, **columns})


def motion(gnss: pd.DataFrame, speed: str, course: str, metre_per_s: float = 1.0) -> dict[str, object]:
    """Speed [``metre_per_s``] and course under these names."""
    size = np.hypot(gnss.vel_n, gnss.vel_e) / metre_per_s
    return {speed: size, course: np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360}


@pytest.mark.parametrize(
    ("climb", "metre_per_s", "height", "metre", "said"),
    [
        ("climb (m/s)", 1.0, "alt", 1.0, "height_unit=m  (they change"),
        ("climb (m/s)", 1.0, "alt", 0.3048, "height_unit=ft  (they change"),
        ("climb", 1.0, "alt", 1.0, "climb_unit=m/s  (heights change"),
        ("climb", 1 / 3.6, "alt", 1.0, "climb_unit=km/h  (heights change"),
        ("climb", 1.0, "alt (ft)", 0.3048, "climb_unit=m/s  (heights change"),
    ],
)
def test_climb_has_a_unit_of_its_own(climb, metre_per_s, height, metre, said, tmp_path: Path, drive: Tables) -> None:
    """By its name or by heights in metres; only a climb of known unit decides the unit of the heights."""
    gnss = hilly(drive["gnss"], 1.0, 0.1)
    place = {"lat": gnss.lat_deg, "lon": gnss.lon_deg, height: gnss.height_m / metre}
    table = fixes(
        gnss, **place, **motion(gnss, "Speed (km/h)", "Course", 1 / 3.6), **{climb: -gnss.vel_d / metre_per_s}
    )
    got, notes = read(tmp_path, drive["imu"], table)
    assert said in notes
    for name in ("height_m", "vel_n", "vel_d"):
        np.testing.assert_allclose(got.gnss[name], gnss[name], atol=1e-6, err_msg=name)


def test_climb_on_a_level_road_is_in_metres_a_second(tmp_path: Path, drive: Tables) -> None:
    gnss = drive["gnss"]
    place = {"lat": gnss.lat_deg, "lon": gnss.lon_deg, "alt": gnss.height_m}
    table = fixes(gnss, **place, **motion(gnss, "Speed (km/h)", "Course", 1 / 3.6), climb=-gnss.vel_d)
    got, notes = read(tmp_path, drive["imu"], table)
    assert "climb_unit=m/s  (no heights tell another unit)" in notes
    np.testing.assert_allclose(got.gnss.vel_d, gnss.vel_d, atol=1e-6)


GEOID_M = 45.2


@pytest.mark.parametrize(
    ("heights", "added"),
    [
        ({"ellipsoidal_height": 0.0}, ""),
        ({"alt_msl": -GEOID_M, "alt_ellipsoid": 0.0}, ""),
        ({"altHAE": 0.0, "altMSL": -GEOID_M}, ""),
        ({"h_hae": 0.0}, ""),
        ({"height": 0.0, "hMSL": -GEOID_M}, ""),  # u-blox'
        ({"altitude": -GEOID_M}, "added undulation to altitude"),
        ({"altitude": -GEOID_M, "alt_msl": -GEOID_M}, "added undulation to altitude"),
        ({"hMSL": -GEOID_M}, "added undulation to hMSL"),
    ],
)
def test_the_undulation_is_added_to_heights_above_sea_level(heights, added, tmp_path, drive: Tables) -> None:
    """And to no others, which are marked as such or stand beside one above sea level."""
    gnss = drive["gnss"]
    columns = {name: gnss.height_m + above for name, above in heights.items()}
    place = {"lat": gnss.lat_deg, "lon": gnss.lon_deg, **columns, "undulation": GEOID_M}
    got, notes = read(tmp_path, drive["imu"], fixes(gnss, **place, **motion(gnss, "speed", "course")))
    np.testing.assert_allclose(got.gnss.height_m, gnss.height_m, atol=1e-6)
    assert (added in notes) if added else ("added" not in notes)


def two_receivers(gnss: pd.DataFrame, apart_deg: float) -> dict[str, object]:
    """Columns of two receivers; the first latitude and the first longitude are of different ones."""
    other = gnss.assign(lat_deg=gnss.lat_deg + apart_deg, lon_deg=gnss.lon_deg + apart_deg)
    return {
        "rtk_lat": gnss.lat_deg,
        "gps_lon": other.lon_deg,
        "gps_lat": other.lat_deg,
        "rtk_lon": gnss.lon_deg,
        "gps_alt": gnss.height_m + 3.0,
        "rtk_alt": gnss.height_m,
        "gps_hacc": 2.0,
        "rtk_hacc": 0.02,
        **motion(gnss.assign(vel_n=gnss.vel_n + 0.5), "gps_speed", "gps_course"),
        **motion(gnss, "rtk_speed", "rtk_course"),
    }


def test_several_receivers_in_a_table(tmp_path: Path, drive: Tables) -> None:
    """Refused with the setting that chooses one, whose velocity and accuracy are then taken too."""
    gnss = drive["gnss"]
    table = fixes(gnss, **two_receivers(gnss, 1e-5))
    with pytest.raises(InputError, match=r"position.columns=\[rtk_lat, rtk_lon, rtk_alt\]', or another"):
        read(tmp_path, drive["imu"], table)
    for called, columns in (("rtk", ["rtk_lat", "rtk_lon", "rtk_alt"]), ("gps", ["gps_lat", "gps_lon", "gps_alt"])):
        got, _ = read(tmp_path, drive["imu"], table, position={"columns": columns})
        own = gnss if called == "rtk" else gnss.assign(lat_deg=gnss.lat_deg + 1e-5, vel_n=gnss.vel_n + 0.5)
        np.testing.assert_allclose(got.gnss.lat_deg, own.lat_deg, atol=1e-9)
        np.testing.assert_allclose(got.gnss.vel_n, own.vel_n, atol=1e-6)
        np.testing.assert_allclose(got.gnss.std_pos_n, 0.02 if called == "rtk" else 2.0)


def test_one_receiver_of_several_is_complete(tmp_path: Path, drive: Tables) -> None:
    """The other has no longitude, and gives nothing."""
    gnss = drive["gnss"]
    columns = {name: x for name, x in two_receivers(gnss, 1e-5).items() if name != "gps_lon"}
    got, _ = read(tmp_path, drive["imu"], fixes(gnss, **columns))
    for name in ("lat_deg", "lon_deg", "height_m", "vel_n"):
        np.testing.assert_allclose(got.gnss[name], gnss[name], atol=1e-6, err_msg=name)


def test_one_position_twice_is_one_receivers(tmp_path: Path, drive: Tables) -> None:
    """As Torque writes it, with the speed of the engine's bus and that of the receiver."""
    gnss = drive["gnss"]
    place = {"Longitude": gnss.lon_deg, "Latitude": gnss.lat_deg, "Altitude": gnss.height_m}
    again = {"GPS Latitude(°)": gnss.lat_deg.round(7), "GPS Longitude(°)": gnss.lon_deg.round(7)}
    bus = {"Speed (OBD)(km/h)": np.round(3.75 * np.hypot(gnss.vel_n, gnss.vel_e), 1)}
    own = motion(gnss, "Speed (GPS)(km/h)", "Bearing", 1 / 3.6)
    got, notes = read(tmp_path, drive["imu"], fixes(gnss, **place, **again, **bus, **own))
    for name in ("lat_deg", "lon_deg", "height_m", "vel_n", "vel_e"):
        np.testing.assert_allclose(got.gnss[name], gnss[name], atol=1e-6, err_msg=name)
    assert got.mapping["speed"]["value"]["columns"] == ["Speed (OBD)(km/h)"]
    assert "not used: GPS Latitude(°), GPS Longitude(°)" in notes


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (["Speed (OBD)(km/h)", "GPS Speed (km/h)", "Bearing"], ["GPS Speed (km/h)", "Bearing"]),
        (["Speed (km/h)", "GPS Speed (m/s)", "Bearing"], ["GPS Speed (m/s)", "Bearing"]),
        (["Speed (CAN)", "speed", "heading", "gps_course"], ["speed", "gps_course"]),
        (["Speed (OBD)(km/h)", "Bearing"], None),
    ],
)
def test_which_speed_is_the_receivers(names, taken) -> None:
    spec = find_velocity(names)
    assert (spec and spec["columns"]) == taken


def test_a_speed_of_the_cars_bus_is_no_velocity_of_the_receiver() -> None:
    """Not by the way between the positions either."""
    gnss = car(60)["gnss"]
    place = {"lat": gnss.lat_deg, "lon": gnss.lon_deg, "alt": gnss.height_m}
    found = gnss_spec(LogTable(fixes(gnss, **place, **motion(gnss, "Speed (OBD)", "Bearing")), Path("a.csv")))
    assert found is not None and found.spec["velocity"] == {"columns": None}
