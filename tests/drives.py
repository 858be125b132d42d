"""Simulated drives, on disk or in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from dlkf.data.drive import Drive
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import DriveRow
from dlkf.data.validate import CheckedTables
from dlkf.simulation.dataset import Recipe, make_drive, make_recipe, simulate


def recipe_of(config: dict[str, Any]) -> Recipe:
    """What the drives are made by."""
    dataset, imu, seed = (config[key] for key in ("dataset", "imu", "seed"))
    return make_recipe(dataset, imu, seed, config.get("receiver"), raw=config.get("raw", False))


def drives_in(config: dict[str, Any], out: Path, **options: Any) -> Path:
    """The dataset, in ``out``."""
    given = {key: config[key] for key in ("workers", "parallel") if key in config}
    return simulate(recipe_of(config), out, progress=False, **given, **options)


def tables_in_memory(made_by: Recipe, index: int, seconds: int) -> CheckedTables:
    """Drive ``index`` of the dataset, never written."""
    tables, row = make_drive(made_by, index, seconds)
    columns = ({str(c): t[c].to_numpy(copy=True) for c in t} for t in (tables.imu, tables.gnss, tables.reference))
    arm = tuple(row[f"lever_arm_{axis}_m"] for axis in "xyz")
    return CheckedTables(DriveRow(row["drive"], row["group"], arm), *columns)


def drive_in_memory(made_by: Recipe, index: int, seconds: int, dtype: torch.dtype = torch.float32) -> Drive:
    """The same at 50 Hz, in epochs of a second."""
    return drive_from_tables(tables_in_memory(made_by, index, seconds), "memory", 50.0, 1.0, dtype)
