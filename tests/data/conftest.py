"""Drives that several of these tests look into."""

import pandas as pd
import pytest

from dlkf.command.composing import compose_command
from dlkf.data.tables import read_drives, read_table
from tests.cars import car
from tests.drives import drives_in


@pytest.fixture(scope="session")
def drive():
    """A hundred seconds of perfect sensors."""
    return car(100)


@pytest.fixture(scope="session")
def streets(tmp_path_factory):
    """Three simulated minutes with perfect sensors: no turn like the one before, as the analytic path has them."""
    own = ["simulated@dataset=per_drive", "imu=perfect", "dataset.hours=0.05", "dataset.drive_minutes=3", "seed=5"]
    streets = tmp_path_factory.mktemp("data") / "streets"
    folder = drives_in(compose_command("simulate", *own), streets)
    name = read_drives(folder)[0].name
    return {kind: pd.DataFrame(read_table(folder, kind, name)) for kind in ("imu", "gnss")}
