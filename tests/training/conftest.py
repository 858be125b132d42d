"""A quarter of an hour with one IMU, in drives of three minutes."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dlkf.config import config_dir
from dlkf.simulation.dataset import simulate_from_config


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    size = ["simulated@dataset=one_imu", "dataset.hours=0.25", "dataset.drive_minutes=3", "seed=1"]
    with initialize_config_dir(config_dir=str(config_dir()), version_base="1.3"):
        config = OmegaConf.to_container(compose("simulate", size), resolve=True)
    return simulate_from_config(config, tmp_path_factory.mktemp("data") / "tiny", progress=False)
