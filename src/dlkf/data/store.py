"""Load a dataset: every drive checked, resampled to a uniform rate and cut into epochs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError, list_some
from dlkf.base.files import folder_name, resolve_place
from dlkf.base.parallel import parallel_map
from dlkf.data.aid_tables import STANDARD, AidTable, standard_tables
from dlkf.data.aids import aid_rows
from dlkf.data.compiled_samples import prepare
from dlkf.data.drive import Drive
from dlkf.data.resampling import assign_fixes, epoch_grid, interpolate_reference, resample_imu
from dlkf.data.spikes import remove_spikes
from dlkf.data.tables import DriveRow, dataset_digest, read_drives
from dlkf.data.validate import CheckedTables, read_drive, usable_fixes

__all__ = ["dataset_digest", "drive_from_tables", "load_dataset"]


def load_dataset(
    folder: str | Path,
    *,
    rate_hz: float = 50.0,
    epoch_s: float = 1.0,
    dtype: torch.dtype = torch.float32,
    reference: bool = True,
    drives: Sequence[str] | None = None,
    aids: Sequence[AidTable] | None = None,
    progress: ProgressCallback = no_progress,
) -> list[Drive]:
    """The drives of a dataset, or those named, on an epoch grid; IMU in ``dtype``, the rest float64.

    ``aids`` are the tables of further sensors that count, None: all of the contract that a drive has.
    With ``reference=False`` the folder ``reference/`` is not opened. ``progress(drives done, in all)`` is called
    after each drive. Raises InputError for the first fault in the data or an unknown drive.
    """

    def load(row: DriveRow) -> Drive:
        tables = read_drive(folder, row, reference=reference, aids=aids)
        return drive_from_tables(tables, folder_name(folder), rate_hz, epoch_s, dtype, aids or ())

    rows = drive_rows(folder, drives)
    prepare(len(rows))
    threads = min(len(rows), torch.get_num_threads())  # NumPy, Arrow and torch work side by side
    loaded = []
    for drive in parallel_map(load, rows, threads=threads):
        loaded.append(drive)
        progress(len(loaded), len(rows))
    return loaded


def drive_rows(folder: str | Path, drives: Sequence[str] | str | None = None) -> list[DriveRow]:
    """Rows of ``drives.parquet``: all, or those named; InputError for none, or one unknown or named twice."""
    rows = read_drives(folder)
    if drives is None:
        return rows
    if not isinstance(drives, (str, Sequence)):
        raise InputError(f"drives is {drives!r}, must be a name or a list of names")
    drives = [drives] if isinstance(drives, str) else list(drives)
    if not drives:
        raise InputError("drives=[] names no drive; null takes all")
    if doubles := sorted({name for name in drives if drives.count(name) > 1}):
        raise InputError(f"drives names {doubles[0]} twice; name each drive once")
    known = {row.name: row for row in rows}
    if unknown := [name for name in drives if name not in known]:
        raise InputError(f"dataset {folder}: no drive {unknown[0]}; has {list_some(list(known))}")
    return [known[name] for name in drives]


def choose_aids(
    folder: str | Path, aids: Sequence[str] | str | None, drives: Sequence[str] | None = None
) -> tuple[AidTable, ...]:
    """The further sensors that count: those named, None: all of the contract that at least one of the drives has.

    Raises InputError for an unknown name, or one that no drive has.
    """
    names = [row.name for row in drive_rows(folder, drives)]
    place = resolve_place(folder)

    def is_there(kind: str) -> bool:
        return any(any((place / kind / f"drive={name}").glob("*.parquet")) for name in names)

    if aids is None:
        return tuple(table for kind, table in STANDARD.items() if is_there(kind))
    if not isinstance(aids, (str, list, tuple)):
        raise InputError(f"aids is {aids!r}, must be a list such as [speed], [] for none, null for all that there are")
    tables = standard_tables([aids] if isinstance(aids, str) else list(aids))
    for table in tables:
        if not is_there(table.name):
            raise InputError(f"aids: no drive of {folder} has {table.name}/; leave it out, or null for all there are")
    return tables


def drive_from_tables(
    tables: CheckedTables,
    dataset: str,
    rate_hz: float,
    epoch_s: float,
    dtype: torch.dtype,
    aids: Sequence[AidTable] = (),
) -> Drive:
    """One drive's checked tables, without the spikes of its IMU, on its epoch grid.

    ``aids`` explains those of its further tables that are not in the contract. Raises InputError if the drive is
    shorter than an epoch.
    """
    kinds = {**STANDARD, **{aid.name: aid for aid in aids}}
    (imu, spikes), gnss = remove_spikes(tables.imu), tables.gnss
    grid = epoch_grid(imu["t"], gnss["t"][usable_fixes(gnss)], rate_hz, epoch_s, tables.row.name)
    fixes = assign_fixes(gnss, grid)
    truth = interpolate_reference(tables.reference, grid)
    return Drive(
        name=tables.row.name,
        group=tables.row.group,
        dataset=dataset,
        t0=grid.t0,
        epoch_s=epoch_s,
        rate_hz=rate_hz,
        imu=torch.from_numpy(resample_imu(imu, grid)).to(dtype),
        lever_arm_b=torch.tensor(tables.row.lever_arm_b, dtype=torch.float64),
        refused=tables.refused._replace(spikes=spikes),
        aids={name: torch.from_numpy(aid_rows(kinds[name], x, grid)) for name, x in tables.aids.items()},
        quality=torch.from_numpy(fixes.quality),
        **{f"gnss_{name}": torch.from_numpy(x) for name, x in vars(fixes).items() if name != "quality"},
        **{f"ref_{name}": torch.from_numpy(x) for name, x in vars(truth).items()},
    )
