"""Pictures: motion over the ground from tables, closed forms on a circle, files for drives with and without truth."""

import numpy as np
import pandas as pd
import pytest
from tests.drives import drives_in
from tests.simulation.test_dataset import config

from dlkf.base.errors import InputError
from dlkf.data.tables import read_drives
from dlkf.data.validate import read_checked
from dlkf.simulation.pictures import driving, write_pictures


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return drives_in(config(hours=0.05), tmp_path_factory.mktemp("pictures") / "toy")


def circled(tables, speed: float, radius: float):
    """The tables with their reference replaced by a circle at constant speed."""
    t = np.arange(600) / 10
    angle = speed / radius * t
    reference = {
        "t": t,
        "lat_deg": 52 + np.degrees(radius * np.sin(angle) / 6.371e6),
        "lon_deg": 9 + np.degrees(radius * (1 - np.cos(angle)) / 6.371e6) / np.cos(np.radians(52)),
        "height_m": 0 * t,
        "vel_n": speed * np.cos(angle),
        "vel_e": speed * np.sin(angle),
        "valid": np.ones(len(t), dtype=bool),
    }
    return type(tables)(tables.row, tables.imu, tables.gnss, reference)


def test_motion_on_a_circle(dataset):
    """A parabola over 0.5 s of a cosine of 0.2 rad/s is off by (ωh)²/6 or so: below 1e-3."""
    moved = driving(circled(read_checked(dataset, read_drives(dataset)[0]), speed=10.0, radius=50.0))
    assert moved.yaw_rate[5:-5] == pytest.approx(0.2, rel=1e-3)
    assert moved.lateral[5:-5] == pytest.approx(2.0, rel=1e-3)
    assert np.abs(moved.along[5:-5]).max() < 1e-3
    assert moved.steady[5:-5].all() and moved.turning.all()
    assert np.hypot(moved.north, moved.east - 50) == pytest.approx(50, rel=1e-3)


def test_pictures_of_a_simulated_dataset_and_of_one_drive(dataset, tmp_path):
    names = [row.name for row in read_drives(dataset)]
    paths = write_pictures(dataset, tmp_path)
    assert [path.name for path in paths] == [f"{names[0]}.png", "motion.png"]
    paths = write_pictures(dataset, tmp_path, names[1:2])
    assert [path.name for path in paths] == [f"{names[1]}.png", "motion.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000 for path in paths)


def test_pictures_without_a_reference_use_the_fixes(dataset, tmp_path):
    tables = read_checked(dataset, read_drives(dataset)[0])
    bare = driving(type(tables)(tables.row, tables.imu, tables.gnss, None))
    full = driving(tables)
    assert len(bare.t) == len(tables.gnss["t"]) < len(full.t)
    assert np.abs(np.interp(bare.t, full.t, full.speed) - bare.speed).max() < 0.2  # fixes have 0.02 m/s of noise


def test_an_unknown_drive_is_one_clear_line(dataset, tmp_path):
    with pytest.raises(InputError, match="no drive nowhere"):
        write_pictures(dataset, tmp_path / "none", ["nowhere"])
    assert not (tmp_path / "none").exists()


def test_a_drive_that_nobody_knows_cannot_be_drawn(dataset):
    tables = read_checked(dataset, read_drives(dataset)[0])
    blank = pd.DataFrame(tables.reference).assign(valid=False)
    with pytest.raises(InputError, match="nothing to draw"):
        driving(type(tables)(tables.row, tables.imu, tables.gnss, {c: blank[c].to_numpy() for c in blank}))
