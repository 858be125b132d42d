"""Settings of the commands that take GNSS away and score against a reference: evaluate, tune."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dlkf.command.settings import (
    DriveSelection,
    FilterSettings,
    StoreSettings,
    check_above_zero,
    check_file_name,
    check_not_below_zero,
)
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.masks import BiasLaw
from dlkf.data.segments import StartLaw
from dlkf.data.splits import Split
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol


@dataclass(frozen=True, kw_only=True)
class ScoringSettingsBase:
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
class EvaluateSettings(FilterSettings, DriveSelection, ScoringSettingsBase):
    """``dlkf evaluate``."""

    name: str
    align: AlignConfig
    injected_bias: BiasLaw | None
    reference: str
    parallel: int | str | None
    unseen: bool
    settle_s: float
    baseline: str | None
    figures: bool
    tracking: StoreSettings

    def __post_init__(self) -> None:
        check_not_below_zero(self, "settle_s")


@dataclass(frozen=True, kw_only=True)
class TuneSettings(FilterSettings, DriveSelection, ScoringSettingsBase):
    """``dlkf tune``."""

    name: str
    objective: str
    minutes: float
    rounds: int
    segments: int | None
    split: Split
    fractions: Sequence[float]
    split_seed: int
    rate_hz: float
    epoch_s: float
    tracking: StoreSettings

    def __post_init__(self) -> None:
        check_file_name(self.name)
        check_above_zero(self, "minutes", "rounds", "segments")
