"""Settings of each command, typed: the keys of ``conf/<command>.yaml``, whose comments explain them.

Of the commands that score in :mod:`dlkf.command.scored`, of ``simulate`` in :mod:`dlkf.simulation.dataset`, of
``train`` in :mod:`dlkf.training.settings`. A mapping stands where a class of one's own or ranges may be named.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dlkf.base.errors import InputError
from dlkf.data.alignment import AlignConfig
from dlkf.filters.build import check_prior_taken
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec, imu_spec

Names = Any  # a word or a list of words, of which some may be numbers to YAML: drives=2011


@dataclass(frozen=True)
class StoreSettings:
    """An MLflow store, and what of this command is to be kept there."""

    uri: str | None
    log: bool = True


@dataclass(frozen=True)
class PriorSettings:
    """Prior information of filters with ``_prior``, if any."""

    mean: Sequence[float] | None
    std: Sequence[float] | None


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """Of the commands that take filters: which, and their settings."""

    model: Names
    imu: Mapping[str, Any]
    tuning: Tuning
    prior: PriorSettings = PriorSettings(None, None)
    out: str
    overwrite: bool = False

    @property
    def filter_options(self) -> dict[str, Any]:
        """For :func:`dlkf.tracking.models.resolve_model`, beside the preset."""
        mean, std = self.prior.mean, self.prior.std
        if (mean is None) != (std is None):
            given, missing = ("std", "mean") if mean is None else ("mean", "std")
            raise InputError(f"prior.{given} is given without prior.{missing}; give both or neither")
        prior = None if mean is None or std is None else Prior(mean, std)
        if prior is not None:
            check_prior_taken(self.models)
        return {"tuning": self.tuning, "prior": prior}

    @property
    def spec(self) -> ImuSpec:
        """The preset of ``imu=``."""
        return imu_spec(self.imu)

    @property
    def models(self) -> list[str]:
        """One or several; InputError for none."""
        if not isinstance(self.model, (str, list, tuple)):
            raise InputError(f"model is {self.model!r}, must be a name or a list of names")
        names = [self.model] if isinstance(self.model, str) else [str(name) for name in self.model]
        if not names:
            raise InputError("model is an empty list; give at least one, such as model=mbkf15")
        return names


@dataclass(frozen=True, kw_only=True)
class DriveSelection:
    """Of the commands that read drives of a dataset."""

    dataset: str
    drives: Names
    rate_hz: float | None
    epoch_s: float | None
    aids: Names = None


@dataclass(frozen=True, kw_only=True)
class NavigateSettings(FilterSettings, DriveSelection):
    """``dlkf navigate``, which alone finds the noise itself with ``imu=auto``."""

    export: Names
    export_clock: str
    parallel: int | str | None
    smoother: str | None
    streaming: bool
    compiled: bool
    align: AlignConfig
    skip_unaligned: bool
    tracking: StoreSettings

    @property
    def spec(self) -> ImuSpec:
        """The preset of ``imu=``, or that of ``imu=auto``."""
        return imu_spec(self.imu, auto=True)


@dataclass(frozen=True, kw_only=True)
class ExportSettings(FilterSettings):
    """``dlkf export``."""

    rate_hz: float | None
    epoch_s: float | None
    precision: Literal["double", "float"]
    dataset: str | None
    drive: Names
    aids: Names = None
    latency: bool
    tracking: StoreSettings


@dataclass(frozen=True, kw_only=True)
class IngestSettings:
    """``dlkf ingest``; ``reader`` names its class."""

    reader: Mapping[str, Any]
    source: str
    out: str
    overwrite: bool
    split_gaps: bool
    shortest_s: float
    gap_s: float
    gap_samples: float
    skip_unsure: bool
    parallel: int | str | None


@dataclass(frozen=True, kw_only=True)
class AllanSettings:
    """``dlkf allan``."""

    imu: Mapping[str, Any]
    dataset: str
    drive: Names
    from_s: float | None
    to_s: float | None
    name: str
    out: str
    in_run: Literal["fit", "keep"]

    def __post_init__(self) -> None:
        check_file_name(self.name)


@dataclass(frozen=True)
class DoctorSettings:
    """``dlkf doctor``."""

    dataset: str
    drives: Names


@dataclass(frozen=True)
class CompareSettings:
    """``dlkf compare``."""

    runs: Names
    out: str
    overwrite: bool


@dataclass(frozen=True)
class RegisterSettings:
    """``dlkf register``."""

    run: str | None
    model: str | None
    name: str
    alias: str | None
    tracking: StoreSettings


def check_file_name(name: str) -> None:
    """InputError for what should not name a preset's file."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise InputError(f"name={name} must be letters, digits, _ and -: it names a file")
