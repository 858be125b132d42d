"""Logged drives through the core, sample by sample: what ``navigate streaming=true compiled=true`` runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from dlkf.base.errors import InputError
from dlkf.data.alignment import SEARCH, AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.store import drive_from_tables
from dlkf.data.validate import CheckedTables
from dlkf.filters.aids.attach import aid_columns
from dlkf.onboard.c_source import list_columns
from dlkf.onboard.compiled_filter import CompiledFilter
from dlkf.onboard.core import Core, Status
from dlkf.onboard.library import Library
from dlkf.running.offline import Navigated
from dlkf.running.replay import find_why_unaligned, replay_drive, stream_drive
from dlkf.running.solution import COLUMNS


def runs_in_core(align: AlignConfig) -> bool:
    """Whether the core begins as these settings say: it has those of a stream's default."""
    return replace(align, from_rest=False) == SEARCH


def make_core(library: Library, tables: CheckedTables, drive: Drive) -> Core:
    """A core on the grid of a loaded drive."""
    step_s = float(np.median(np.diff(tables.imu["t"])))
    return Core(library.path, tables.row.lever_arm_b, phase_s=drive.t0, imu_step_s=step_s)


def run_core_drive(
    tables: CheckedTables, estimator: CompiledFilter, *, rate_hz: float, epoch_s: float, align: AlignConfig = SEARCH
) -> Navigated:
    """:func:`dlkf.running.replay.stream_drive` with the core of a vehicle in the place of the stream in Python.

    A filter that was compiled without the core runs in that stream. Errors as there.
    """
    if not (estimator.whole and runs_in_core(align)):
        return stream_drive(tables, estimator, rate_hz=rate_hz, epoch_s=epoch_s, align=align)
    drive, name = drive_from_tables(tables, "", rate_hz, epoch_s, torch.float64), tables.row.name
    core = make_core(estimator.library, tables, drive)
    found: dict[float, np.ndarray] = {}
    lost: list[float] = []
    for receipt in replay_drive(core, tables.imu, tables.gnss, None, tables.aids):
        found.update((row[0], row) for row in receipt.rows)
        for ended in (Status.RESTARTED, Status.DIVERGED):
            if core.count(ended):
                raise InputError(f"drive {name}: {core.describe_status(ended)}")
        if core.count(Status.LOST) > len(lost):
            lost.append(core.latest)
    if not found:
        raise find_why_unaligned(drive, name, replace(align, from_rest=False))
    rows = np.stack([found[t] for t in sorted(found)])
    table = pd.DataFrame(rows, columns=list(list_columns(estimator)))
    table = table[[*COLUMNS, "gnss_used", *aid_columns(estimator)]].astype({"gnss_used": bool})
    return Navigated(
        name, float(rows[0, 0]) - epoch_s, table, refused=drive.refused, restarts=tuple(lost), doubt=core.doubt
    )
