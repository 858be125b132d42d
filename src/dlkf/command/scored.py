"""What the commands are told that take GNSS away and measure: evaluate, tune, consistency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dlkf.command.settings import (
    FilterSettings,
    OnDrives,
    Store,
    check_above_zero,
    check_file_name,
    check_not_below_zero,
)
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.masks import BiasLaw
from dlkf.data.segments import StartLaw
from dlkf.data.splits import Split
from dlkf.diagnosis.matched_drives import MatchedDrives
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol
from dlkf.ranges import has_ranges, middle
from dlkf.settings import settings_from
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import VehicleConfig


@dataclass(frozen=True, kw_only=True)
class Scored:
    """The scenes, and what is taken away in them."""

    mode: str
    length_s: float
    stride_s: float | None
    start: StartLaw
    outage: OutagePlan | None = None
    seed: int

    def protocol(self, align: AlignConfig = ALIGN) -> Protocol:
        """The rules of the comparison."""
        stride = self.length_s if self.stride_s is None else self.stride_s
        return Protocol(self.mode, self.length_s, stride, self.start, align, self.outage, self.seed)


@dataclass(frozen=True, kw_only=True)
class EvaluateSettings(FilterSettings, OnDrives, Scored):
    """``dlkf evaluate``."""

    name: str
    align: AlignConfig
    injected_bias: BiasLaw | None
    reference: str
    parallel: int | str | None
    unseen: bool
    settle_s: float
    baseline: str
    tracking: Store

    def __post_init__(self) -> None:
        check_not_below_zero(self, "settle_s")


@dataclass(frozen=True, kw_only=True)
class TuneSettings(FilterSettings, OnDrives, Scored):
    """``dlkf tune``."""

    name: str
    objective: str
    minutes: float
    rounds: int
    pieces: int | None
    split: Split
    fractions: Sequence[float]
    split_seed: int
    rate_hz: float
    epoch_s: float
    tracking: Store

    def __post_init__(self) -> None:
        check_file_name(self.name)
        check_above_zero(self, "minutes", "rounds", "pieces")


@dataclass(frozen=True)
class Fixes:
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
    gnss: Fixes
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
            vehicle=settings_from(VehicleConfig, middle(self.vehicle), "vehicle"),
            chassis=settings_from(ChassisConfig, middle(self.chassis), "chassis"),
            start=self.start,
            seed=self.seed,
            cars=self.chassis if has_ranges(self.chassis) else None,
        )
