"""Whole drives from IMU and GNSS alone, as rows of ``solution.parquet``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch

from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.segments import whole_drives
from dlkf.errors import InputError
from dlkf.filters.integration import Estimator
from dlkf.running.batched import CHUNK_SAMPLES, run_filter
from dlkf.running.solution import solution_table
from dlkf.running.start import align_each


@dataclass(frozen=True)
class Navigated:
    """A drive's solution: its table, and the time [s, file clock] at which the filter could start."""

    drive: str
    aligned_at: float
    table: pd.DataFrame

    def summary(self) -> str:
        """One line: rows, alignment, fixes used, and the filter's own 1σ at the end."""
        last = self.table.iloc[-1]
        text = (
            f"{self.drive}: aligned at t = {self.aligned_at:.1f} s, {len(self.table)} epochs, "
            f"{int(self.table.gnss_used.sum())} fixes used"
        )
        position = np.hypot(last.std_pos_n, last.std_pos_e)
        if np.isfinite(position):
            text += f", final 1σ {position:.2g} m horizontal, {np.degrees(last.std_yaw):.2g}° heading"
        return text


def navigate_drives(
    drives: Sequence[Drive],
    estimator: Estimator,
    *,
    align: AlignConfig = ALIGN,
    skipped: dict[str, str] | None = None,
    progress: Callable[[int, int | None], None] | None = None,
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
        solution = run_filter(batch, estimator)
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
            yield Navigated(drives[k].name, float(batch.t_start[row]), table)
        done += len(part)
        if progress is not None:
            progress(done, len(todo))
