"""Settings of the commands that take GNSS away and score against a reference: evaluate, tune."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dlkf.base.settings import Ranged, bounded_field
from dlkf.command.settings import DriveSelection, FilterSettings, StoreSettings, check_file_name
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
class EvaluateSettings(FilterSettings, DriveSelection, ScoringSettingsBase, Ranged, where="evaluate"):
    """``dlkf evaluate``."""

    name: str
    align: AlignConfig
    injected_bias: BiasLaw | None
    reference: str
    parallel: int | str | None
    unseen: bool
    settle_s: float = bounded_field(10.0, 0, math.inf)
    baseline: str | None
    figures: bool
    tracking: StoreSettings


@dataclass(frozen=True, kw_only=True)
class TuneSettings(FilterSettings, DriveSelection, ScoringSettingsBase, Ranged, where="tune"):
    """``dlkf tune``."""

    name: str
    objective: str
    minutes: float = bounded_field(20.0, 0.01, math.inf)
    rounds: int = bounded_field(2, 1, 1000)
    segments: int | None = bounded_field(150, 1, math.inf)
    split: Split
    fractions: Sequence[float]
    split_seed: int
    rate_hz: float
    epoch_s: float
    tracking: StoreSettings

    def __post_init__(self) -> None:
        super().__post_init__()
        check_file_name(self.name)
