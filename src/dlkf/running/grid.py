"""The grid on which a filter runs a log where nothing is set: samples a second, and the update interval."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dlkf.data.aid_tables import AidTable
from dlkf.data.kinds import drive_rates
from dlkf.data.resampling import usual_rate
from dlkf.data.store import choose_aids, drive_rows
from dlkf.data.tables import read_table
from dlkf.data.validate import usable_fixes
from dlkf.filters.aids.attach import find_kalman, find_tables, refuse_left_out, with_aids
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.saved import choose_grid
from dlkf.filters.smoother import Filter
from dlkf.running.start.no_motion import SLACK_S, SLOWEST_FIXES_S, SLOWEST_START_S


@dataclass(frozen=True)
class UsableFixes:
    """The fixes in a drive's file that a filter could use: times [s], places [°], NMEA GGA quality."""

    t: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    quality: np.ndarray

    @staticmethod
    def of(folder: str | Path, drive: str) -> UsableFixes:
        """Of a drive of a dataset."""
        gnss = read_table(folder, "gnss", drive)
        assert gnss is not None  # read_table raises where there is none
        return UsableFixes.among(gnss)

    @staticmethod
    def among(gnss: dict[str, np.ndarray]) -> UsableFixes:
        """Of a drive's table of fixes."""
        usable = usable_fixes(gnss)
        return UsableFixes(*(gnss[c][usable] for c in ("t", "lat_deg", "lon_deg", "quality")))

    @property
    def span_s(self) -> float:
        """From the first to the last."""
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0

    @property
    def usual_s(self) -> float:
        """Median spacing, to the millisecond; infinite with fewer than two fixes."""
        return round(float(np.median(np.diff(self.t))), 3) if len(self.t) > 1 else np.inf

    def between(self, first: float, last: float) -> int:
        """Fixes after ``first`` and not after ``last``."""
        return int(((self.t > first + 1e-3) & (self.t <= last + 1e-3)).sum())


def choose_epoch(spacings: Iterable[UsableFixes], rate_hz: float, estimator: Filter) -> float:
    """Update interval [s] that uses every fix: the closest usual spacing.

    1 s where it is no whole number of IMU samples, and at least for filters with constraints, whose noise is meant for
    one a second. Of slow receivers that spacing in whole seconds.
    """
    closest = min((s.usual_s for s in spacings), default=1.0)
    if SLOWEST_FIXES_S <= closest <= SLOWEST_START_S:
        return float(math.ceil(closest - SLACK_S))
    samples = closest * rate_hz if math.isfinite(closest) else 0.0  # no drive has two fixes: any grid will do
    whole = samples >= 1 and abs(samples - round(samples)) < 1e-6
    sources = getattr(find_kalman(estimator), "sources", ())
    constrained = any(isinstance(source, CarConstraints) for source in sources)
    return closest if closest < 1.0 and whole and not constrained else 1.0


def choose_grid_for_logs(
    estimator: Filter, fixes: Iterable[UsableFixes], rates: Collection[float], rate_hz: float | None = None,
    epoch_s: float | None = None,
) -> dict[str, Any]:  # fmt: skip
    """``rate_hz`` and ``epoch_s`` of a filter over drives with these fixes and IMU sample rates [Hz]: as set, else as
    the weights of the filter need it, else what uses every fix and sample."""
    usual = choose_epoch(fixes, rate_hz or usual_rate(rates), estimator)
    return choose_grid([estimator], rate_hz, epoch_s, usual, rates)


class RunPlan(NamedTuple):
    """A filter with the sensors of some drives, the sensors that count, by drive their fixes and IMU sample rates [Hz],
    and the loader's options."""

    estimator: Filter
    aids: tuple[AidTable, ...]
    fixes: dict[str, UsableFixes]
    rates: dict[str, float]
    grid: dict[str, Any]

    @staticmethod
    def of(
        folder: str | Path, estimator: Filter, name: str, *, aids: Sequence[str] | str | None = None,
        drives: Sequence[str] | None = None, rate_hz: float | None = None, epoch_s: float | None = None,
    ) -> RunPlan:  # fmt: skip
        """For the drives of a dataset, or those named. InputError where the filter, called ``name``, takes none of the
        ``aids``, or cannot run on such a grid."""
        fixes = {row.name: UsableFixes.of(folder, row.name) for row in drive_rows(folder, drives)}
        rates = drive_rates(folder, fixes)
        step = choose_grid_for_logs(estimator, fixes.values(), rates.values(), rate_hz, epoch_s)
        chosen = choose_aids(folder, aids, drives)
        if aids is not None:
            refuse_left_out({name: estimator}, chosen)
        estimator = with_aids(estimator, chosen)
        return RunPlan(estimator, chosen, fixes, rates, {**step, "aids": find_tables(estimator)})
