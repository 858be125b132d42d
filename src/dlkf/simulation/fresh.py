"""Drives simulated straight into memory, so that a training can meet a new fleet as often as it likes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch

from dlkf.data.drive import Drive
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import DriveRow
from dlkf.data.validate import DriveTables
from dlkf.errors import InputError
from dlkf.simulation.dataset import Recipe, drive_of
from dlkf.simulation.tables import columns_of


def fresh_drives(
    made_by: Recipe,
    first: int,
    count: int,
    *,
    seconds: int | None = None,
    rate_hz: float = 50.0,
    epoch_s: float = 1.0,
    dtype: torch.dtype = torch.float32,
    workers: int = 1,
) -> list[Drive]:
    """Drives ``first`` … ``first + count − 1`` of the endless fleet of a recipe and its seed, on an epoch grid.

    Each drive depends on the recipe, its number and its length ``seconds`` (the dataset's ``drive_minutes`` if None)
    alone, so a training that is resumed at epoch e meets the same drives as one that never stopped. Drive k is drive k
    of the dataset that ``dlkf.simulate`` writes with drives of that length, and is never checked or written.

    A training that wants a new fleet every ten epochs makes, in a ``DriveDataModule``'s place of ``load_dataset``,

        fleet = composed_recipe("simulated@dataset=wide", "seed=7")
        stack = DriveStack(fresh_drives(fleet, 48 * (epoch // 10), 48, seconds=600, rate_hz=50.0))

    (``dlkf.command.simulated.composed_recipe``), and validates on other seeds.
    ``workers`` threads share the drives. InputError as of a dataset's settings, and for a drive shorter than an epoch.
    """
    if count < 1 or first < 0 or (seconds is not None and seconds < 1):
        raise InputError(f"fresh drives: first {first}, count {count}, seconds {seconds} must be 0, 1, 1 or more")
    length = round(made_by.dataset.drive_minutes * 60) if seconds is None else seconds

    def one(index: int) -> Drive:
        tables, row = drive_of(made_by, index, length)
        arm = tuple(row[f"lever_arm_{axis}_m"] for axis in "xyz")
        columns = (columns_of(table) for table in (tables.imu, tables.gnss, tables.reference))
        checked = DriveTables(DriveRow(row["drive"], row["group"], arm), *columns)
        return drive_from_tables(checked, made_by.dataset.name, rate_hz, epoch_s, dtype)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range(first, first + count)))
