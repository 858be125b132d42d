"""Whole drives from IMU and GNSS alone, as rows of ``solution.parquet``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError, no_drives
from dlkf.data.alignment import SEARCH, AlignConfig, Start
from dlkf.data.drive import Batch, Drive
from dlkf.data.limits import NONE_REFUSED, Refused
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.filters.aids.attach import aid_columns
from dlkf.filters.aids.estimates import describe_estimate
from dlkf.filters.integration import BatchSolution, WholeLoop
from dlkf.filters.receiver import ARM, DELAY, DRIFT, VELOCITY_DELAY
from dlkf.filters.slow_errors import NAMES as PASSING
from dlkf.filters.smoother import Filter, SmoothedSolution
from dlkf.navigation.compiled import without_loops
from dlkf.running.batched import CHUNK_SAMPLES, pack, run_filter
from dlkf.running.grid import UsableFixes
from dlkf.running.innovations import FAR, Innovation, fit_sigma, rms, worst_stretch
from dlkf.running.loss import find_first_loss
from dlkf.running.mounting import describe_mounting
from dlkf.running.solution import SCHEMA, solution_table
from dlkf.running.start import align_each

FEW_DRIVES = 8  # whose start in tensor operations takes less than numba takes to load
WORTH_SAYING = 0.01  # probability of another heading
SIGMAS = 3.0  # what differs from what a log says by so many 1σ is worth saying
# s, m, ppm: 1σ of what no model of a car contains
OF_RECEIVER = {DELAY: 0.01, VELOCITY_DELAY: 0.01, **dict.fromkeys(ARM, 0.1), DRIFT: 30.0}
SAMPLES_AT_ONCE = CHUNK_SAMPLES  # IMU samples of drives in memory, 8 h at 50 Hz
LONG_RESTART_S = 10.0  # without rows, before the next is named
VIBRATION = "vibration_speed"
MOSTLY = 0.5  # of the updates of a further sensor; where fewer are used, its numbers are likely wrong
EARLY_S = 3.0  # before a solution begins, from which on a fix without one is worth saying
REFUSED = "most of them refused: see its unit, sign and clock"


@dataclass(frozen=True)
class Navigated:
    """A drive's solution: its table, the time [s, file clock] at which the filter could start, and the probability
    that it then faced another way."""

    drive: str
    aligned_at: float
    table: pd.DataFrame
    innovation: Innovation | None = None
    refused: Refused = NONE_REFUSED  # samples and fixes that were rejected as implausible
    restarts: tuple[float, ...] = ()  # times [s] at which the filter was lost and restarted
    doubt: float = 0.0

    def summary(self, spacing: UsableFixes | None = None) -> str:
        """One line: rows, where they begin, fixes used (of those in the file), and the filter's own 1σ at the end."""
        first, last, used = self.table.t.iloc[0], self.table.iloc[-1], int(self.table.gnss_used.sum())
        text = f"{self.drive}: solution from t = {round(first, 1) + 0.0:.1f} s, "
        if spacing is not None and spacing.between(-np.inf, self.aligned_at - EARLY_S):
            text += f"none for the {int((spacing.t < first - 1e-3).sum())} fixes before, while it aligned, "
        if self.doubt > WORTH_SAYING:
            text += f"heading ambiguous (the alternatives have probability {self.doubt:.2g}), "
        text += f"{len(self.table)} epochs, "
        text += describe_mounting(self.table)
        if spacing is None:
            text += f"{used} fixes used"
        else:
            text += f"{used} of {len(spacing.t)} fixes used"
            if spacing.between(self.aligned_at, last.t) > 1.5 * len(self.table):
                text += f" (one an epoch; epoch_s={spacing.usual_s:g} takes all)"
        position = np.hypot(last.std_pos_n, last.std_pos_e)
        if np.isfinite(position):
            text += f", final 1σ {position:.2g} m horizontal, {np.degrees(last.std_yaw):.2g}° heading"
        if self.innovation is not None and np.isfinite(spread := self.innovation.normalised_rms):
            text += f", normalised innovation RMS {spread:.2g} (expected 1)"
        said = self.sensors()
        estimates = [name for name in said if f"std_{name}" in self.table]
        text += "".join(f", {said[name]}" for name in said if name not in estimates)
        if estimates:
            text += f", at the end {', '.join(said[name] for name in estimates)}"
        if any(self.refused):
            text += f", rejected as implausible: {self.refused}"
        if self.restarts:
            text += ", lost and started over at t = " + ", ".join(self._describe_restart(t) for t in self.restarts[:5])
            text += " s" + (f" and {more} times more" if (more := len(self.restarts) - 5) > 0 else "")
        return text

    def _describe_restart(self, t: float) -> str:
        """Its time [s], with that of the next row where it took long."""
        rows = self.table.t.to_numpy()
        after = rows[rows > t + 1e-6]
        missing = f"no solution until {after[0]:.0f}" if len(after) else "no solution after it"
        return f"{t:.0f}" if len(after) and after[0] - t < LONG_RESTART_S else f"{t:.0f} ({missing})"

    @property
    def sensor_columns(self) -> list[str]:
        """Columns of the table that further sensors added."""
        return [column for column in self.table.columns if column not in SCHEMA.names]

    @property
    def sensor_updates(self) -> dict[str, tuple[int, int, float]]:
        """Of further sensors: updates that used them, all updates, and RMS of the innovations over their 1σ."""
        found, table = {}, self.table
        for name in (c.removesuffix("_used") for c in self.sensor_columns if c.endswith("_used")):
            ratio = (table[f"{name}_innovation"] / table[f"{name}_innovation_std"]).to_numpy()
            found[name] = int(table[f"{name}_used"].sum()), int((~np.isnan(ratio)).sum()), rms(ratio)
        return found

    @property
    def unfit_sensors(self) -> tuple[str, ...]:
        """Further sensors of which most measurements were refused; vibration has neither unit nor clock."""
        updates = self.sensor_updates.items()
        return tuple(name for name, (used, seen, _) in updates if used < MOSTLY * seen and name != VIBRATION)

    def sensors(self) -> dict[str, str]:
        """Of further sensors: how many updates used them, how they fit, and what was found of them at the end."""
        said, table = {}, self.table
        for name, (used, seen, spread) in self.sensor_updates.items():
            if not seen:
                if name != VIBRATION:  # which needs none while there is GNSS
                    said[name] = f"{name}: no update"
                continue
            refused = f", {REFUSED}" if name in self.unfit_sensors else ""
            said[name] = f"{name} in {used} of {seen} updates{refused} (normalised innovation RMS {spread:.2g})"
        for std in (column for column in self.sensor_columns if column.startswith("std_")):
            name, last = std.removeprefix("std_"), table.iloc[-1]
            floor = OF_RECEIVER.get(name)
            if name in PASSING:
                continue
            if floor is not None and abs(last[name]) <= SIGMAS * np.hypot(last[std], floor):
                continue
            said[name] = describe_estimate(name, last[name], last[std])
        return said


def sigma_warning(drives: Iterable[Navigated], model: str, remedy: str) -> str | None:
    """One line where a filter's 1σ is smaller than its innovations in these drives allow, or in a stretch of one, else
    None."""
    ratios = [(drive, drive.innovation.ratio) for drive in drives if drive.innovation is not None]
    fit = fit_sigma(*(ratio for _, ratio in ratios))
    if fit is not None and fit.too_small:
        return fit.warning(model, remedy)
    for drive, ratio in ratios:
        off, first, last = worst_stretch(ratio)
        if off > FAR:
            t = drive.table.t.iloc[[first, last]].to_numpy()
            where = f"in drive {drive.drive} " if len(ratios) > 1 else ""
            return (
                f"{model} is overconfident {where}from t = {t[0]:.0f} to {t[1]:.0f} s: its innovations there are "
                f"{off:.2g} times their 1σ, so its position is further off than its 1σ says; {remedy}"
            )
    return None


def chunk_drives(
    fixes: Mapping[str, UsableFixes], rate_hz: float, samples: int = SAMPLES_AT_ONCE
) -> list[tuple[str, ...]]:
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


class DriveChunk(NamedTuple):
    """Drives that were navigated together, how many were to be, and why others were left out."""

    results: list[Navigated]
    count: int
    skipped: dict[str, str]


def load_chunk(run: Callable[..., Iterable[Navigated]], skip: bool, names: tuple[str, ...]) -> DriveChunk:
    """``run(drives=names, skipped=…)``; with ``skip`` drives that cannot be aligned are left out, even if all are."""
    skipped: dict[str, str] | None = {} if skip else None
    try:
        results = list(run(drives=names, skipped=skipped))
    except InputError:
        if not set(names) <= set(skipped or {}):
            raise
        results = []
    return DriveChunk(results, len(names), skipped or {})


def navigate_chunks(
    shares: Iterable[DriveChunk],
    count: int,
    *,
    skipped: dict[str, str] | None = None,
    progress: ProgressCallback = no_progress,
) -> Iterator[Navigated]:
    """The solutions of ``count`` drives, share by share; InputError where no drive of any could start."""
    done, any_ran = 0, False
    for share in shares:
        if skipped is not None:
            skipped |= share.skipped
        any_ran |= bool(share.results)
        yield from share.results
        done += share.count
        progress(done, count)
    if not any_ran:
        raise no_drives(skipped)


def navigate_dataset(
    folder: str | Path,
    estimator: Filter,
    *,
    align: AlignConfig = SEARCH,
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
    align: AlignConfig = SEARCH,
    skipped: dict[str, str] | None = None,
    progress: ProgressCallback = no_progress,
) -> Iterator[Navigated]:
    """Run a filter over whole drives, from the first moment at which each can be aligned by ``align``.

    Drives of like length run together, a bounded number at a time. A drive that cannot be aligned raises
    InputError; with ``skipped`` it is left out and the reason put there, unless none is left. Raises
    InputError where a solution is not finite. ``progress(drives done, drives in all)``.
    """
    starts = {}
    with _forms(estimator, len(drives)):
        aligned = align_each(drives, align)
    for k, start in enumerate(aligned):
        if not isinstance(start, InputError):
            starts[k] = start
        elif skipped is None:
            raise start
        else:
            skipped[drives[k].name] = str(start)
    if not starts:
        raise no_drives(skipped)
    todo = sorted(starts, key=lambda k: drives[k].epochs - starts[k].first, reverse=True)
    done = 0
    for rows in pack([drives[k].epochs * drives[k].imu.shape[1] for k in todo], CHUNK_SAMPLES):
        part = [todo[row] for row in rows]
        batch = whole_drives([drives[k] for k in part], [starts[k] for k in part])
        solution = _run(batch, estimator)
        for row, k in enumerate(part):
            yield _solve_drive(drives[k], starts[k], batch, row, solution, estimator, align)
        done += len(part)
        progress(done, len(todo))


def _forms(estimator: Filter, drives: int) -> AbstractContextManager:
    """Leaves numba unloaded where a filter in C runs a few drives: loading takes longer than the work."""
    return without_loops() if isinstance(estimator, WholeLoop) and drives < FEW_DRIVES else nullcontext()


def _run(batch: Batch, estimator: Filter) -> BatchSolution:
    try:
        with _forms(estimator, len(batch.imu)):
            return run_filter(batch, estimator, keep_innovations=True)
    except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
        names = ", ".join(batch.drive[:3]) + (", …" if len(batch.drive) > 3 else "")
        which = f"drive {names}" if len(batch.drive) == 1 else f"one of the drives {names}"
        raise InputError(
            f"{which}: the filter diverged (a covariance is no longer positive definite); check the 1σ of its start "
            "and tuning"
        ) from None


def _solve_drive(
    drive: Drive, start: Start, batch: Batch, row: int, solution: BatchSolution, estimator: Filter, align: AlignConfig
) -> Navigated:
    """One drive of a batch; where the filter was lost (:mod:`dlkf.running.loss`) it is aligned and run again.

    As in a stream the epoch at whose end it was lost has no row, nor have those until it is aligned again.
    """
    tables, found, restarts = [], [], []
    aligned_at, doubt = float(batch.t_start[row]), start.doubt
    while True:
        end = find_first_loss(batch, row, solution)
        if end is not None and isinstance(estimator, SmoothedSolution) and end > 0:
            short = drive.part(0, start.first + end)  # what came after would be smoothed into what was before
            batch, row = whole_drives([short], [start]), 0
            solution = _run(batch, estimator)
        table, innovation = _rows(drive.name, batch, row, solution, end, aid_columns(estimator))
        tables.append(table)
        found.append(innovation)
        if end is None:
            break
        restarts.append(float(batch.t_start[row]) + (end + 1) * batch.epoch_s)
        try:
            again = align_each([drive], align, earliest=start.first + end + 1)[0]
        except IndexError:  # nothing is left of the drive
            break
        if isinstance(again, InputError):
            break
        start = again
        batch, row = whole_drives([drive], [start]), 0
        solution = _run(batch, estimator)
    table = pd.concat([t for t in tables if len(t)] or tables[:1], ignore_index=True)
    if not len(table):
        raise InputError(f"drive {drive.name}: the filter diverged from its first update on")
    innovation = Innovation(*(np.concatenate(x) for x in zip(*found)))
    return Navigated(drive.name, aligned_at, table, innovation, drive.refused, tuple(restarts), doubt)


def _rows(
    drive: str, batch: Batch, row: int, solution: BatchSolution, end: int | None, aids: Sequence[str]
) -> tuple[pd.DataFrame, Innovation]:
    """The solution of one drive of a batch up to epoch ``end``, with columns ``aids`` of further sensors; InputError
    where it is not finite."""
    n = int(batch.present[row].sum()) if end is None else min(end, int(batch.present[row].sum()))
    state = type(solution.posterior)(*(x[row, :n] for x in solution.posterior))
    if not all(bool(x.isfinite().all()) for x in state):
        raise InputError(f"drive {drive}: the filter diverged (its output is not finite)")
    t = batch.t_start[row] + batch.epoch_s * torch.arange(1, n + 1, dtype=torch.float64)
    table = solution_table(
        t,
        batch.frame[row : row + 1],
        state,
        solution.imu_error[row, :n],
        None if solution.std is None else solution.std[row, :n],
        solution.used[row, :n],
    )
    if solution.aids is not None:
        table = table.join(pd.DataFrame(solution.aids[row, :n].cpu().double().numpy(), columns=list(aids)))
    S = solution.innovation_covariance
    return table, Innovation.of(solution.innovation[row, :n], solution.used[row, :n], None if S is None else S[row, :n])
