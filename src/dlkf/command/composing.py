"""Hydra's configuration as plain values: that of a command, or one composed elsewhere from the same files."""

from __future__ import annotations

from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from dlkf.config import config_dir
from dlkf.navigation.imu_errors import ImuSpec, imu_spec


def composed(command: str, *overrides: str) -> dict[str, Any]:
    """What a command is given with these words, without running it."""
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        return plain(compose(command, overrides=list(overrides)))


def imu_preset(name: str) -> ImuSpec:
    """Of ``conf/imu``."""
    return imu_spec(composed("allan", f"imu={name}")["imu"])


def plain(config: DictConfig) -> dict[str, Any]:
    """Mappings, lists and values, with what refers to other keys filled in."""
    made = OmegaConf.to_container(config, resolve=True)
    assert isinstance(made, dict)
    return {str(key): value for key, value in made.items()}
