"""Logged drives through the streaming filter: sample by sample, what a vehicle would have known by then."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dlkf.console import Counted
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.tables import Columns
from dlkf.data.validate import DriveTables, read_checked
from dlkf.errors import InputError
from dlkf.filters.card import UnheardCar
from dlkf.filters.smoother import Filter
from dlkf.running import start
from dlkf.running.estimate import Estimate, estimates_table
from dlkf.running.offline import Navigated
from dlkf.running.streaming import Receipt, Status, StreamingFilter


class UnalignedError(InputError):
    """The drive never gives a filter a start."""


def played(
    stream: StreamingFilter, imu: Columns, gnss: Columns, arrival: Sequence[float] | None = None
) -> Iterator[Receipt]:
    """Feed the tables of a drive to a stream in order of time; the receipts.

    ``arrival`` [s] is when each fix comes, by default at its own time, before a sample of the same time.
    """
    when = gnss["t"] if arrival is None else np.asarray(arrival)
    samples = np.stack([imu[c] for c in ("t", *ACCEL, *GYRO)], -1)
    fixes = np.stack([gnss[c] for c in ("t", *POSITION, *VELOCITY, *STD)], -1)
    order = np.argsort(when, kind="stable")
    before = np.searchsorted(imu["t"], when[order], side="left")
    done = 0

    def fix(j: int) -> Receipt:
        x = fixes[j].tolist()
        return stream.gnss(x[0], x[1], x[2], x[3], x[4:7], x[7:], int(gnss["quality"][j]))

    for k, row in enumerate(samples):
        while done < len(order) and before[done] <= k:
            yield fix(order[done])
            done += 1
        x = row.tolist()
        yield stream.imu(x[0], x[1:4], x[4:])
    yield stream.finish()
    for j in order[done:]:
        yield fix(j)


def stream_drive(
    tables: DriveTables,
    estimator: Filter,
    *,
    rate_hz: float,
    epoch_s: float,
    align: AlignConfig = ALIGN,
    arrival: Sequence[float] | None = None,
) -> Navigated:
    """One drive through a stream, on the grid that the loader gives it: the same solution as its batch run.

    Of ``align`` what looks ahead is left out, in a batch run ``search_s=0`` and ``from_rest=False``.
    Raises UnalignedError if the drive cannot be aligned, InputError if the filter diverges.
    """
    drive = drive_from_tables(tables, "", rate_hz, epoch_s, torch.float64)
    causal = replace(align, search_s=0.0, from_rest=False)
    stream = StreamingFilter(
        estimator, rate_hz=rate_hz, epoch_s=epoch_s, lever_arm_b=tables.row.lever_arm_b, align=causal,
        phase_s=drive.t0, imu_step_s=float(np.median(np.diff(tables.imu["t"]))),
    )  # fmt: skip
    found: dict[float, Estimate] = {}
    for receipt in played(stream, tables.imu, tables.gnss, arrival):
        found.update((e.t, e) for e in receipt.estimates)
        if receipt.status is Status.RESTARTED or stream.counts["diverged"]:
            reason = receipt.reason or "the filter diverged (its output is not finite)"
            raise InputError(f"drive {tables.row.name}: {reason}")
    if not found:
        try:
            start.align(drive, causal)
        except InputError as error:
            raise UnalignedError(str(error)) from None
        raise UnalignedError(f"drive {tables.row.name}: ends before a filter could start")
    estimates = [found[t] for t in sorted(found)]
    return Navigated(tables.row.name, estimates[0].t - epoch_s, estimates_table(estimates))


def stream_drives(
    folder: str | Path,
    estimator: Filter,
    *,
    rate_hz: float,
    epoch_s: float,
    align: AlignConfig = ALIGN,
    drives: Sequence[str] | None = None,
    skipped: dict[str, str] | None = None,
    progress: Counted | None = None,
) -> Iterator[Navigated]:
    """The drives of a dataset, or those named, each through a stream of its own; no reference is read.

    As :func:`dlkf.running.offline.navigate_drives` does, a drive that cannot be aligned raises InputError or goes
    to ``skipped``, unless none is left. ``progress(drives done, drives in all)``.
    """
    rows = drive_rows(folder, drives)
    solved = 0
    for k, row in enumerate(rows):
        tables = read_checked(folder, row, reference=False)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UnheardCar)  # commands say it once, of all drives
                result = stream_drive(tables, estimator, rate_hz=rate_hz, epoch_s=epoch_s, align=align)
        except UnalignedError as error:
            if skipped is None:
                raise
            skipped[row.name] = str(error)
        else:
            solved += 1
            yield result
        if progress is not None:
            progress(k + 1, len(rows))
    if not solved:
        raise InputError(next(iter((skipped or {}).values()), "no drives: give a dataset with at least one"))
