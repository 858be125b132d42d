"""Whole drives from IMU and GNSS alone, as rows of ``solution.parquet``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from dlkf.console import Counted
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.data.tables import read_table
from dlkf.data.validate import GNSS_QUALITIES
from dlkf.errors import InputError
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.integration import Solution
from dlkf.filters.smoother import Filter, Smoothed
from dlkf.running.batched import CHUNK_SAMPLES, run_filter
from dlkf.running.solution import solution_table
from dlkf.running.start import align_each

SAMPLES_AT_ONCE = 4_000_000  # IMU samples of drives in memory, 22 h at 50 Hz


@dataclass(frozen=True)
class Fixes:
    """The fixes in a drive's file that a filter could use: times [s], places [°], NMEA GGA quality."""

    t: np.ndarray
    lat_deg: np.ndarray
    lon_deg: np.ndarray
    quality: np.ndarray

    @staticmethod
    def of(folder: str | Path, drive: str) -> Fixes:
        """Of a drive of a dataset."""
        gnss = read_table(folder, "gnss", drive)
        assert gnss is not None  # read_table raises where there is none
        usable = np.isin(gnss["quality"], GNSS_QUALITIES)
        return Fixes(*(gnss[c][usable] for c in ("t", "lat_deg", "lon_deg", "quality")))

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


def epoch_for(spacings: Iterable[Fixes], rate_hz: float, estimator: Filter) -> float:
    """Update interval [s] that uses every fix: the closest usual spacing, at most 1 s.

    1 s where it is no whole number of IMU samples, and for filters with constraints, whose noise is meant for one a
    second.
    """
    closest = min((s.usual_s for s in spacings), default=1.0)
    samples = closest * rate_hz
    whole = samples >= 1 and abs(samples - round(samples)) < 1e-6
    kalman = estimator.filter if isinstance(estimator, Smoothed) else getattr(estimator, "kalman", estimator)
    constrained = any(isinstance(source, CarConstraints) for source in getattr(kalman, "sources", ()))
    return closest if closest < 1.0 and whole and not constrained else 1.0


class Innovation(NamedTuple):
    """GNSS − prediction (T, 6) [m, m/s] in the tangent frame, NaN where no fix was used, and its 1σ as the filter says.

    The 1σ is NaN where the filter has no covariance.
    """

    value: np.ndarray
    std: np.ndarray

    @property
    def normalised_rms(self) -> float:
        """RMS of innovation over 1σ: 1 for a filter that knows itself."""
        ratio = self.value / self.std
        return float(np.sqrt(np.nanmean(ratio**2))) if np.isfinite(ratio).any() else np.nan


@dataclass(frozen=True)
class Navigated:
    """A drive's solution: its table, and the time [s, file clock] at which the filter could start."""

    drive: str
    aligned_at: float
    table: pd.DataFrame
    innovation: Innovation | None = None

    def summary(self, spacing: Fixes | None = None) -> str:
        """One line: rows, alignment, fixes used (of those in the file), and the filter's own 1σ at the end."""
        last, used = self.table.iloc[-1], int(self.table.gnss_used.sum())
        text = f"{self.drive}: aligned at t = {round(self.aligned_at, 1) + 0.0:.1f} s, {len(self.table)} epochs, "
        if spacing is None:
            text += f"{used} fixes used"
        else:
            offered = spacing.between(self.aligned_at, last.t)
            text += f"{used} of {offered} fixes used"
            if offered > 1.5 * len(self.table):
                text += f" (one an epoch; epoch_s={spacing.usual_s:g} takes all)"
        position = np.hypot(last.std_pos_n, last.std_pos_e)
        if np.isfinite(position):
            text += f", final 1σ {position:.2g} m horizontal, {np.degrees(last.std_yaw):.2g}° heading"
        if self.innovation is not None and np.isfinite(spread := self.innovation.normalised_rms):
            text += f", innovations {spread:.2g} of their 1σ (RMS; 1 is right)"
        return text


def in_shares(fixes: Mapping[str, Fixes], rate_hz: float, samples: int = SAMPLES_AT_ONCE) -> list[tuple[str, ...]]:
    """The names of the drives, so many together as have ``samples`` of the IMU."""
    shares: list[list[str]] = [[]]
    size = 0.0
    for name, of_drive in fixes.items():
        more = of_drive.span_s * rate_hz
        if shares[-1] and size + more > samples:
            shares.append([])
            size = 0.0
        shares[-1].append(name)
        size += more
    return [tuple(share) for share in shares if share]


class Share(NamedTuple):
    """Drives that were navigated together, how many were to be, and why others were left out."""

    results: list[Navigated]
    count: int
    skipped: dict[str, str]


def share_of(run: Callable[..., Iterable[Navigated]], skip: bool, names: tuple[str, ...]) -> Share:
    """``run(drives=names, skipped=…)``; with ``skip`` drives that cannot be aligned are left out, even if all are."""
    skipped: dict[str, str] | None = {} if skip else None
    try:
        results = list(run(drives=names, skipped=skipped))
    except InputError:
        if not set(names) <= set(skipped or {}):
            raise
        results = []
    return Share(results, len(names), skipped or {})


def navigate_shares(
    shares: Iterable[Share],
    count: int,
    *,
    skipped: dict[str, str] | None = None,
    progress: Counted | None = None,
) -> Iterator[Navigated]:
    """The solutions of ``count`` drives, share by share; InputError where no drive of any could start."""
    done, any_ran = 0, False
    for share in shares:
        if skipped is not None:
            skipped |= share.skipped
        any_ran |= bool(share.results)
        yield from share.results
        done += share.count
        if progress is not None:
            progress(done, count)
    if not any_ran:
        raise InputError(next(iter((skipped or {}).values()), "no drives: give a dataset with at least one"))


def navigate_dataset(
    folder: str | Path,
    estimator: Filter,
    *,
    align: AlignConfig = ALIGN,
    drives: Sequence[str] | None = None,
    skipped: dict[str, str] | None = None,
    **grid: Any,
) -> Iterator[Navigated]:
    """:func:`navigate_drives` of the drives of a dataset, or those named, loaded together without a reference."""
    loaded = load_dataset(folder, dtype=torch.float64, reference=False, drives=drives, **grid)
    yield from navigate_drives(loaded, estimator, align=align, skipped=skipped)


def navigate_drives(
    drives: Sequence[Drive],
    estimator: Filter,
    *,
    align: AlignConfig = ALIGN,
    skipped: dict[str, str] | None = None,
    progress: Counted | None = None,
) -> Iterator[Navigated]:
    """Run a filter over whole drives, from the first moment at which each can be aligned as ``align`` says.

    Drives of like length run together, a bounded number at a time. A drive that cannot be aligned raises
    InputError; with ``skipped`` it is left out and the reason put there, unless none is left. Raises
    InputError where a solution is not finite. ``progress(drives done, drives in all)``.
    """
    starts = {}
    for k, start in enumerate(align_each(drives, align)):
        if not isinstance(start, InputError):
            starts[k] = start
        elif skipped is None:
            raise start
        else:
            skipped[drives[k].name] = str(start)
    if not starts:
        raise InputError(next(iter((skipped or {}).values()), "no drives: give a dataset with at least one"))
    todo = sorted(starts, key=lambda k: drives[k].epochs - starts[k].first, reverse=True)
    done = 0
    while done < len(todo):
        first = drives[todo[done]]
        at_once = max(1, CHUNK_SAMPLES // (first.epochs * first.imu.shape[1]))
        part = todo[done : done + at_once]
        batch = whole_drives([drives[k] for k in part], [starts[k] for k in part])
        solution = run_filter(batch, estimator, keep_covariances=True)
        innovation = _innovation(solution)
        for row, k in enumerate(part):
            n = int(batch.present[row].sum())
            state = type(solution.posterior)(*(x[row, :n] for x in solution.posterior))
            if not all(bool(x.isfinite().all()) for x in state):
                raise InputError(f"drive {drives[k].name}: the filter diverged (its output is not finite)")
            t = batch.t_start[row] + batch.epoch_s * torch.arange(1, n + 1, dtype=torch.float64)
            table = solution_table(
                t,
                batch.frame[row : row + 1],
                state,
                solution.imu_error[row, :n],
                None if solution.std is None else solution.std[row, :n],
                solution.used[row, :n],
            )
            found = Innovation(innovation.value[row, :n], innovation.std[row, :n])
            yield Navigated(drives[k].name, float(batch.t_start[row]), table, found)
        done += len(part)
        if progress is not None:
            progress(done, len(todo))


def _innovation(solution: Solution) -> Innovation:
    """Of a whole batch, (B, T, 6); components that were not seen are NaN."""
    value = solution.innovation.cpu().double()
    seen = solution.used.cpu().unsqueeze(-1) & (value != 0)
    std = torch.full_like(value, torch.nan) if solution.innovation_std is None else solution.innovation_std
    if solution.covariances is not None:
        c = solution.covariances
        std = (((c.H @ c.predicted) * c.H).sum(-1) + c.R).clamp_min(0).sqrt().cpu().double()
    nan = torch.tensor(torch.nan, dtype=torch.float64)
    return Innovation(torch.where(seen, value, nan).numpy(), torch.where(seen, std, nan).numpy())
