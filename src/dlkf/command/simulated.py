"""What ``dlkf simulate`` is told, and the recipe that its presets make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dlkf.command.composing import composed
from dlkf.settings import settings_from
from dlkf.simulation.dataset import Recipe, recipe


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
