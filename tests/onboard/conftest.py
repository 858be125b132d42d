"""A drive of a minute with all sensors, and a filter that takes them as C: made once for all workers."""

from __future__ import annotations

import pytest
import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_drive
from dlkf.filters.aids.attach import with_aids
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Estimator
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.onboard.c_source import write_source
from dlkf.onboard.functions import Grid, count_output_numbers, make_layout
from dlkf.onboard.library import LIBRARY, Library, build
from dlkf.onboard.recording import export_mode
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.sensors import BaroConfig, HeadingConfig, SensorsConfig, WheelConfig
from dlkf.tracking.models import resolve_model

IMU = ImuSpec(
    "mems", SensorErrors(2.5e-3, 0.02, 1e-3, 3600.0, 3e-3, 3e-3), SensorErrors(9e-5, 1e-3, 1e-4, 3600.0, 3e-3, 3e-3)
)
ARM = (1.0, 0.3, -1.2)
GRID = Grid(50, 0.02)


KIND = "mbkf15_nhc_gated"
QUICK = ("-O0",)  # compiled in a third of the time of -O3, and fast enough for a minute's drive
SENSORS = SensorsConfig(
    WheelConfig(scale=0.02, right_m=0.75, delay_s=0.1, jitter_s=0.01),
    HeadingConfig(rate_hz=1.0),
    BaroConfig(rate_hz=1.0),
)


def model_of(name: str) -> Estimator:
    """A filter by name; ``dlkf`` of the paper's sizes with fresh weights, whose values do not change its speed."""
    if name != "dlkf":
        return resolve_model(name, IMU)
    settings = {"outage_mode": "run", "frame": "heading", "imu_error": "affine", "imu_error_bound": 4.0}
    return LearnedFilter(LearnedConfig.from_mapping({**settings, "network": {"dropout": 0.0}})).eval()


@pytest.fixture(scope="session")
def tables(once):
    """A minute; the car drives off after some seconds."""
    gnss = GnssConfig(lever_arm_b=ARM)
    config = DatasetConfig("town", hours=1 / 60, drive_minutes=1.0, gnss=gnss, sensors=SENSORS)
    dataset = once(
        "onboard_town", lambda folder: simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)
    ) / "data"  # fmt: skip
    return read_drive(dataset, drive_rows(dataset)[0], reference=False)


@pytest.fixture(scope="session")
def drive(tables):
    """On the grid."""
    return drive_from_tables(tables, "", 50.0, 1.0, torch.float64, tuple(STANDARD.values()))


@pytest.fixture(scope="session")
def exported(once):
    """A gated filter that knows a car and takes all sensors as C, compiled: folder, filter, layout, library."""
    estimator = with_aids(build_filter(KIND, IMU), STANDARD.values())

    def made(folder):
        write_source(folder, estimator, GRID, KIND, {})
        build(folder, flags=QUICK)

    folder = once("exported", made)
    layout = layout_of(estimator)
    return folder, estimator, layout, Library(folder / LIBRARY, layout.size, count_output_numbers(estimator))


def layout_of(estimator):
    """Of the memory."""
    with export_mode():
        return make_layout(estimator, GRID)
