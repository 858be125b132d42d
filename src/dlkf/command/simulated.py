"""Datasets by the presets of ``dlkf simulate``: a recipe, and the missing datasets of a training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hydra import compose
from rich.console import Console

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.command.composing import compose_command, to_plain
from dlkf.simulation.dataset import Recipe, SimulateSettings, simulate


def compose_recipe(*overrides: str) -> Recipe:
    """What ``dlkf simulate`` makes drives by with these words."""
    return settings_from(SimulateSettings, compose_command("simulate", *overrides), "").recipe


HOUR_SEED = 71  # the roads of the long drives are not those of the others


def simulate_missing(datasets: Sequence[str], console: Console, seed: int = 1) -> None:
    """Simulate the datasets under ``data/`` that have a preset and are not there yet."""
    for dataset in datasets:
        path = Path(dataset)
        preset_file = config_dir() / "simulated" / f"{path.name}.yaml"
        if path.exists() or path.parent != Path("data") or not preset_file.is_file():
            continue
        console.print(f"{dataset} does not exist: simulating it")
        preset = compose("simulate", overrides=[f"simulated@dataset={path.name}", f"seed={seed}"])
        try:
            simulate(settings_from(SimulateSettings, to_plain(preset), "").recipe, path)
        except InputError:
            if not path.exists():  # else a run beside this one made the same drives first
                raise
