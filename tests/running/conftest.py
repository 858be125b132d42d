"""Drives for the tests of streams."""

from __future__ import annotations

import pytest

from dlkf.data.store import drive_rows
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from tests.running.streams import ARM, IMU, until


@pytest.fixture(scope="session")
def streets(tmp_path_factory):
    """Two drives of a minute, an antenna away from the IMU."""
    folder = tmp_path_factory.mktemp("town")
    config = DatasetConfig("town", hours=2 / 60, drive_minutes=1.0, gnss=GnssConfig(lever_arm_b=ARM))
    return simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)


@pytest.fixture(scope="session")
def drive(streets) -> CheckedTables:
    """A minute; the car drives off after 7 s."""
    return read_drive(streets, drive_rows(streets)[0])


@pytest.fixture(scope="session")
def segment(drive) -> CheckedTables:
    """Its first 35 s."""
    return until(drive, 35.0)
