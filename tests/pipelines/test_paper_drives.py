"""Pictures: motion over the ground from tables, closed forms on a circle, files for drives with and without truth."""

from pathlib import Path

import numpy as np
import pytest

from dlkf.data.tables import read_drives
from dlkf.data.validate import read_drive
from tests.drives import drives_in
from tests.simulation.test_dataset import config


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "pipelines")
    import paper_drives

    return paper_drives


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


def test_motion_on_a_circle(script, dataset):
    """A parabola over 0.5 s of a cosine of 0.2 rad/s is off by (ωh)²/6 or so: below 1e-3."""
    moved = script.driving(circled(read_drive(dataset, read_drives(dataset)[0]), speed=10.0, radius=50.0))
    assert moved.yaw_rate[5:-5] == pytest.approx(0.2, rel=1e-3)
    assert moved.lateral[5:-5] == pytest.approx(2.0, rel=1e-3)
    assert np.abs(moved.along[5:-5]).max() < 1e-3
    assert moved.steady[5:-5].all() and moved.turning.all()
    assert np.hypot(moved.north, moved.east - 50) == pytest.approx(50, rel=1e-3)


def test_pictures_of_a_simulated_dataset(script, dataset, tmp_path):
    name = read_drives(dataset)[0].name
    paths = script.write_pictures(dataset, tmp_path)
    assert [path.name for path in paths] == [f"{name}.png", "motion.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 10_000 for path in paths)
