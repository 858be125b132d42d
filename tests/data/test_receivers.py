"""Tables of fixes with several speeds, heights or receivers: which columns go together, in which units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import DriveFrames
from tests.cars import Tables
from tests.data.test_validate import hilly

FRD = {"accel": {"axes": "frd"}, "gyro": {"axes": "frd"}}


def read(folder: Path, imu: pd.DataFrame, table: pd.DataFrame) -> tuple[DriveFrames, str]:
    """The drive of these samples and this table of fixes, and what was found."""
    imu.to_csv(folder / "imu.csv", index=False)
    table.to_csv(folder / "gnss.csv", index=False)
    (got,) = AutoReader(FRD, {"time": {"offset_s": 0.0}}).read(folder)
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
