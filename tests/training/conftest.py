"""Seven minutes with one IMU, in drives of a minute and a half."""

from pathlib import Path

import pytest

from dlkf.command.composing import compose_command
from tests.drives import drives_in


@pytest.fixture(scope="session")
def dataset(once) -> Path:
    size = ["simulated@dataset=one_imu", "dataset.hours=0.125", "dataset.drive_minutes=1.5", "dataset.imu_rate_hz=50"]
    config = compose_command("simulate", *size, "seed=1")
    return once("tiny", lambda folder: drives_in(config, folder / "tiny")) / "tiny"
