"""Simulated drives of a mapping with the keys of ``conf/simulate.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dlkf.simulation.dataset import Recipe, recipe, simulate


def recipe_of(config: dict[str, Any]) -> Recipe:
    """What the drives are made by."""
    dataset, imu, seed = (config[key] for key in ("dataset", "imu", "seed"))
    return recipe(dataset, imu, seed, config.get("receiver"), raw=config.get("raw", False))


def drives_in(config: dict[str, Any], out: Path, **options: Any) -> Path:
    """The dataset, in ``out``."""
    given = {key: config[key] for key in ("workers", "parallel") if key in config}
    return simulate(recipe_of(config), out, progress=False, **given, **options)
