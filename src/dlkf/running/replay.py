"""Logged drives through the streaming filter, sample by sample, without access to later data."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import torch

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError, no_drives
from dlkf.data.aid_tables import STANDARD, AidTable
from dlkf.data.aids import LARGEST_VALUE, aid_values
from dlkf.data.alignment import SEARCH, AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.tables import Columns
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.filters.aids.attach import find_tables
from dlkf.filters.card import LowSampleRateWarning
from dlkf.filters.smoother import Filter
from dlkf.running import start
from dlkf.running.offline import Navigated
from dlkf.running.solution import Estimate, estimates_table
from dlkf.running.streaming import Status, StreamingFilter

R = TypeVar("R", covariant=True)  # its receipts


class MeasurementSink(Protocol[R]):
    """What takes samples and fixes one by one: :class:`StreamingFilter`, or the core of a vehicle."""

    def imu(self, t: float, accel: Sequence[float], gyro: Sequence[float], /) -> R:
        """A sample [s, m/s², rad/s]."""
        ...

    def gnss(
        self, t: float, lat_deg: float, lon_deg: float, height_m: float, velocity: Sequence[float],
        std: Sequence[float], quality: int, /,
    ) -> R:  # fmt: skip
        """A fix."""
        ...

    def aid(self, name: str, t: float, value: float, std: float, /) -> R:
        """A sample of a further sensor."""
        ...

    def finish(self) -> R:
        """Nothing follows."""
        ...


class UnalignedError(InputError):
    """The drive never gives a filter a start."""


def replay_drive(
    stream: MeasurementSink[R], imu: Columns, gnss: Columns, arrival: Sequence[float] | None = None,
    aids: Mapping[str, Columns] | None = None, tables: Sequence[AidTable] = (), late_s: float = 0.0,
) -> Iterator[R]:  # fmt: skip
    """Feed the tables of a drive to a stream in order of time; the receipts.

    ``arrival`` [s] is when each fix comes, by default at its own time, before a sample of the same time. ``aids`` are
    tables of further sensors, which ``tables`` explain where they are not in the contract; their samples come
    ``late_s`` after their time.
    """
    samples = np.stack([imu[c] for c in ("t", *ACCEL, *GYRO)], -1)
    fixes = np.stack([gnss[c] for c in ("t", *POSITION, *VELOCITY, *STD)], -1)
    when = gnss["t"] if arrival is None else np.asarray(arrival)
    others = sorted(_aid_samples(aids or {}, tables), key=lambda sample: sample[1])

    def fix(j: int) -> R:
        x = fixes[j].tolist()
        return stream.gnss(x[0], x[1], x[2], x[3], x[4:7], x[7:], int(gnss["quality"][j]))

    order = np.argsort(when, kind="stable")
    calls = [*(partial(fix, j) for j in order), *(partial(stream.aid, *sample) for sample in others)]
    times = np.concatenate((when[order], [sample[1] + late_s for sample in others]))
    before = np.searchsorted(imu["t"], times, side="left")
    due = deque((before[k], calls[k]) for k in np.argsort(before, kind="stable"))
    for k, row in enumerate(samples):
        while due and due[0][0] <= k:
            yield due.popleft()[1]()
        x = row.tolist()
        yield stream.imu(x[0], x[1:4], x[4:])
    yield stream.finish()
    for _, call in due:
        yield call()


def _aid_samples(aids: Mapping[str, Columns], tables: Sequence[AidTable]) -> Iterator[tuple[str, float, float, float]]:
    """Sensor, time, value and std of every sample that has a value."""
    kinds = {**STANDARD, **{table.name: table for table in tables}}
    for name, columns in aids.items():
        value = aid_values(kinds[name], columns)
        std = columns.get("std", np.full(len(value), np.nan))
        good = np.abs(value) <= LARGEST_VALUE
        yield from zip([name] * int(good.sum()), columns["t"][good].tolist(), value[good].tolist(), std[good].tolist())


def stream_drive(
    tables: CheckedTables,
    estimator: Filter,
    *,
    rate_hz: float,
    epoch_s: float,
    align: AlignConfig = SEARCH,
    arrival: Sequence[float] | None = None,
    late_s: float = 0.0,
) -> Navigated:
    """One drive through a stream, on the grid that the loader gives it: the same solution as its batch run.

    Samples of further sensors come ``late_s`` after their time. Of ``align`` what looks ahead is left out, in a batch
    run ``from_rest=False``.
    Raises UnalignedError if the drive cannot be aligned, InputError if the filter diverges.
    """
    kinds = find_tables(estimator)
    drive = drive_from_tables(tables, "", rate_hz, epoch_s, torch.float64, kinds)
    causal = replace(align, from_rest=False)
    stream = StreamingFilter(
        estimator, rate_hz=rate_hz, epoch_s=epoch_s, lever_arm_b=tables.row.lever_arm_b, align=causal,
        phase_s=drive.t0, imu_step_s=float(np.median(np.diff(tables.imu["t"]))),
    )  # fmt: skip
    found: dict[float, Estimate] = {}
    taken = {table.name: tables.aids[table.name] for table in kinds if table.name in tables.aids}
    for receipt in replay_drive(stream, tables.imu, tables.gnss, arrival, taken, kinds, late_s):
        found.update((e.t, e) for e in receipt.estimates)
        if receipt.status is Status.RESTARTED or stream.counts["diverged"]:
            reason = receipt.reason or "the filter diverged (its output is not finite)"
            raise InputError(f"drive {tables.row.name}: {reason}")
    if not found:
        raise find_why_unaligned(drive, tables.row.name, causal)
    table = estimates_table([found[t] for t in sorted(found)])
    lost = tuple(stream.lost_at)
    return Navigated(
        tables.row.name, min(found) - epoch_s, table, refused=drive.refused, restarts=lost, doubt=stream.doubt
    )


def find_why_unaligned(drive: Drive, name: str, align: AlignConfig) -> UnalignedError:
    """Why a stream of a drive gave no filter a start."""
    try:
        start.align(drive, align)
    except InputError as error:
        return UnalignedError(str(error))
    return UnalignedError(f"drive {name}: ends before a filter could start")


def stream_drives(
    folder: str | Path,
    estimator: Filter,
    *,
    rate_hz: float,
    epoch_s: float,
    align: AlignConfig = SEARCH,
    drives: Sequence[str] | None = None,
    aids: Sequence[AidTable] | None = None,
    skipped: dict[str, str] | None = None,
    progress: ProgressCallback = no_progress,
    through: Callable[..., Navigated] = stream_drive,
) -> Iterator[Navigated]:
    """The drives of a dataset, or those named, each ``through`` a stream of its own; no reference is read.

    As :func:`dlkf.running.offline.navigate_drives` does, a drive that cannot be aligned raises InputError or goes
    to ``skipped``, unless none is left. ``progress(drives done, drives in all)``.
    """
    rows = drive_rows(folder, drives)
    solved = 0
    for k, row in enumerate(rows):
        tables = read_drive(folder, row, reference=False, aids=aids)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", LowSampleRateWarning)  # commands say it once, of all drives
                result = through(tables, estimator, rate_hz=rate_hz, epoch_s=epoch_s, align=align)
        except UnalignedError as error:
            if skipped is None:
                raise
            skipped[row.name] = str(error)
        else:
            solved += 1
            yield result
        progress(k + 1, len(rows))
    if not solved:
        raise no_drives(skipped)
