"""Whole drives from IMU and GNSS alone, as rows of ``solution.parquet``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from dlkf.filters.integration import Estimator, Solution
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


def epoch_for(spacings: Iterable[Fixes], rate_hz: float, estimator: Estimator) -> float:
    """Update interval [s] that uses every fix: the closest usual spacing, at most 1 s.

    1 s where it is no whole number of IMU samples, and for filters with constraints, whose noise is meant for one a
    second.
    """
    closest = min((s.usual_s for s in spacings), default=1.0)
    samples = closest * rate_hz
    whole = samples >= 1 and abs(samples - round(samples)) < 1e-6
    return closest if closest < 1.0 and whole and not getattr(estimator, "constrained", False) else 1.0


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
        text = f"{self.drive}: aligned at t = {self.aligned_at:.1f} s, {len(self.table)} epochs, "
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
            text += f", innovations {spread:.2g} × their σ"
        return text


def in_shares(
    folder: str | Path,
    fixes: Mapping[str, Fixes],
    *,
    rate_hz: float,
    samples: int = SAMPLES_AT_ONCE,
    **grid: Any,
) -> Iterator[list[Drive]]:
    """The drives of a dataset that ``fixes`` has, loaded without a reference some at a time: ``samples`` of the IMU."""
    share, size = [], 0.0
    for name, of_drive in fixes.items():
        more = of_drive.span_s * rate_hz
        if share and size + more > samples:
            yield _loaded(folder, share, rate_hz, grid)
            share, size = [], 0.0
        share.append(name)
        size += more
    yield _loaded(folder, share, rate_hz, grid)


def _loaded(folder: str | Path, names: list[str], rate_hz: float, grid: Mapping[str, Any]) -> list[Drive]:
    return load_dataset(folder, dtype=torch.float64, reference=False, drives=names, rate_hz=rate_hz, **grid)


def navigate_shares(
    shares: Iterable[Sequence[Drive]],
    estimator: Estimator,
    count: int,
    *,
    align: AlignConfig = ALIGN,
    skipped: dict[str, str] | None = None,
    progress: Counted | None = None,
) -> Iterator[Navigated]:
    """As :func:`navigate_drives` for ``count`` drives in shares; where one is forgotten before the next is loaded,
    memory does not grow with their number."""
    done, any_ran = 0, False
    for drives in shares:
        try:
            for result in navigate_drives(drives, estimator, align=align, skipped=skipped):
                any_ran = True
                yield result
        except InputError:
            if not {d.name for d in drives} <= set(skipped or {}):  # else drives of other shares may start
                raise
        done += len(drives)
        del drives  # before the next are loaded
        if progress is not None:
            progress(done, count)
    if not any_ran:
        raise InputError(next(iter((skipped or {}).values()), "no drives: give a dataset with at least one"))


def navigate_drives(
    drives: Sequence[Drive],
    estimator: Estimator,
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
