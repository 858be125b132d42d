"""What ``dlkf simulate`` is told, and the recipe that its presets make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose
from rich.console import Console

from dlkf.command.composing import composed, plain
from dlkf.config import config_dir
from dlkf.errors import InputError
from dlkf.settings import settings_from
from dlkf.simulation.dataset import Recipe, recipe, simulate


@dataclass(frozen=True, kw_only=True)
class SimulateSettings:
    """``dlkf simulate``; the presets may hold ranges."""

    dataset: Mapping[str, Any]
    imu: Mapping[str, Any]
    receiver: Mapping[str, Any] | None
    seed: int
    out: str
    raw: bool
    source: str | None
    pictures: bool
    overwrite: bool
    workers: int | None
    parallel: int | str | None

    @property
    def recipe(self) -> Recipe:
        """What the drives are made by."""
        return recipe(self.dataset, self.imu, self.seed, self.receiver, raw=self.raw)


def composed_recipe(*overrides: str) -> Recipe:
    """What ``dlkf simulate`` makes drives by with these words."""
    return settings_from(SimulateSettings, composed("simulate", *overrides), "").recipe


HOUR_SEED = 71  # the roads of the long drives are not those of the others


def make_missing(datasets: Sequence[str], console: Console, seed: int = 1) -> None:
    """Simulate the datasets under ``data/`` that have a preset and are not there yet."""
    for dataset in datasets:
        path = Path(dataset)
        preset_file = config_dir() / "simulated" / f"{path.name}.yaml"
        if path.exists() or path.parent != Path("data") or not preset_file.is_file():
            continue
        console.print(f"{dataset} is not there: simulating it")
        preset = compose("simulate", overrides=[f"simulated@dataset={path.name}", f"seed={seed}"])
        try:
            simulate(settings_from(SimulateSettings, plain(preset), "").recipe, path)
        except InputError:
            if not path.exists():  # else a run beside this one made the same drives first
                raise
