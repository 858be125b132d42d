"""Hydra's configuration as plain values: that of a command, or one composed elsewhere from the same files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from dlkf.base.config import config_dir, read_preset
from dlkf.base.settings import settings_from
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, imu_spec

NOT_HASHED = ("tracking", "resume")


def compose_command(command: str, *overrides: str, resolve: bool = True) -> dict[str, Any]:
    """What a command is given with these words, without running it."""
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        return to_plain(compose(command, overrides=list(overrides)), resolve=resolve)


def imu_preset(name: str) -> ImuSpec:
    """Of ``conf/imu``."""
    return imu_spec(read_preset("imu", name))


def tuning_preset(name: str) -> Tuning:
    """Of ``conf/tuning``."""
    return settings_from(Tuning, read_preset("tuning", name), "tuning")


def configuration_hash(values: Mapping[str, Any]) -> str:
    """Eight hex digits of everything that decides a training's weights and scores."""
    kept = {k: v for k, v in values.items() if k not in NOT_HASHED}
    if "trainer" in kept:
        kept["trainer"] = {k: v for k, v in kept["trainer"].items() if k != "devices"}  # the same training on more
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()[:8]


def to_plain(config: DictConfig, *, resolve: bool = True) -> dict[str, Any]:
    """Mappings, lists and values, with what refers to other keys filled in."""
    made = OmegaConf.to_container(config, resolve=resolve)
    assert isinstance(made, dict)
    return {str(key): value for key, value in made.items()}
