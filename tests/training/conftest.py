"""A quarter of an hour with one IMU, in drives of three minutes."""

from pathlib import Path

import pytest

from dlkf.command.composing import composed
from tests.drives import drives_in


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    size = ["simulated@dataset=one_imu", "dataset.hours=0.25", "dataset.drive_minutes=3", "seed=1"]
    return drives_in(composed("simulate", *size), tmp_path_factory.mktemp("data") / "tiny")
