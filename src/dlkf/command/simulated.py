"""Of the commands that simulate: recipes by the presets of ``dlkf simulate``, missing datasets of a training, settings
of the consistency check. Apart, as the other commands load no simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose
from rich.console import Console

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.base.ranges import has_ranges, range_middle
from dlkf.base.settings import Ranged, bounded_field, settings_from
from dlkf.command.composing import compose_command, to_plain
from dlkf.command.settings import FilterSettings
from dlkf.data.segments import StartLaw
from dlkf.diagnosis.matched_drives import MatchedDrives
from dlkf.evaluation.outages import OutagePlan
from dlkf.simulation.dataset import Recipe, SimulateSettings, simulate
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import VehicleConfig


def compose_recipe(*overrides: str) -> Recipe:
    """What ``dlkf simulate`` makes drives by with these words."""
    return settings_from(SimulateSettings, compose_command("simulate", *overrides), "").recipe


SEMI_REAL = "semi_real"  # the preset that needs real drives
HOUR_SEED = 71  # the roads of the long drives are not those of the others


def simulate_missing(datasets: Sequence[str], console: Console, seed: int = 1) -> None:
    """Simulate the datasets under ``data/`` that have a preset and are not there yet."""
    for dataset in datasets:
        path = Path(dataset)
        preset_file = config_dir() / "simulated" / f"{path.name}.yaml"
        if path.exists() or path.parent != Path("data") or not preset_file.is_file() or path.name == SEMI_REAL:
            continue
        console.print(f"{dataset} does not exist: simulating it")
        preset = compose("simulate", overrides=[f"simulated@dataset={path.name}", f"seed={seed}"])
        try:
            simulate(settings_from(SimulateSettings, to_plain(preset), "").recipe, path)
        except InputError:
            if not path.exists():  # else a run beside this one made the same drives first
                raise


@dataclass(frozen=True)
class FixNoise:
    """White noise of the fixes, 1σ per axis."""

    position_m: float
    velocity_mps: float


@dataclass(frozen=True, kw_only=True)
class ConsistencySettings(FilterSettings, Ranged, where="consistency"):
    """``dlkf consistency``; ``vehicle`` and ``chassis`` may hold ranges; :class:`MatchedDrives` has the limits."""

    chassis: Mapping[str, Any]
    vehicle: Mapping[str, Any]
    start: StartLaw
    outage: OutagePlan | None = None
    drives: int
    minutes: float
    rate_hz: int
    gnss: FixNoise
    settle_s: float = bounded_field(10.0, 0, math.inf)
    seed: int

    @property
    def matched(self) -> MatchedDrives:
        """The drives to simulate."""
        return MatchedDrives(
            drives=self.drives,
            minutes=self.minutes,
            rate_hz=self.rate_hz,
            position_m=self.gnss.position_m,
            velocity_mps=self.gnss.velocity_mps,
            vehicle=settings_from(VehicleConfig, range_middle(self.vehicle), "vehicle"),
            chassis=settings_from(ChassisConfig, range_middle(self.chassis), "chassis"),
            start=self.start,
            seed=self.seed,
            cars=self.chassis if has_ranges(self.chassis) else None,
        )
