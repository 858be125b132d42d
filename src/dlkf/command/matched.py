"""Settings of the consistency check, which simulates its drives; apart, as the other commands load no simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dlkf.base.ranges import has_ranges, range_middle
from dlkf.base.settings import settings_from
from dlkf.command.settings import FilterSettings, check_above_zero, check_not_below_zero
from dlkf.data.segments import StartLaw
from dlkf.diagnosis.matched_drives import MatchedDrives
from dlkf.evaluation.outages import OutagePlan
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import VehicleConfig


@dataclass(frozen=True)
class FixNoise:
    """White noise of the fixes, 1σ per axis."""

    position_m: float
    velocity_mps: float


@dataclass(frozen=True, kw_only=True)
class ConsistencySettings(FilterSettings):
    """``dlkf consistency``; ``vehicle`` and ``chassis`` may hold ranges."""

    chassis: Mapping[str, Any]
    vehicle: Mapping[str, Any]
    start: StartLaw
    outage: OutagePlan | None = None
    drives: int
    minutes: float
    rate_hz: int
    gnss: FixNoise
    settle_s: float
    seed: int

    def __post_init__(self) -> None:
        check_above_zero(self, "drives", "minutes", "rate_hz")
        check_not_below_zero(self, "settle_s")

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
