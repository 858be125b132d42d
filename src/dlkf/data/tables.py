"""Read the tables of a dataset, with their columns and types checked against the contract."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dlkf.data.schema import DRIVES, DRIVES_REQUIRED, LEVER_ARM, OPTIONAL, SCHEMAS, check_name
from dlkf.errors import InputError
from dlkf.files import placed, reached, readable, told

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class DriveRow:
    """What ``drives.parquet`` says of a drive that a filter or a split needs."""

    name: str
    group: str
    lever_arm_b: tuple[float, float, float]  # m, IMU → antenna, FRD


def read_drives(folder: str | Path) -> list[DriveRow]:
    """The drives of a dataset in the order of ``drives.parquet``.

    Raises InputError if the folder, the file or a needed column is missing, or a name stands twice.
    """
    folder = placed(folder)
    path = folder / "drives.parquet"
    with told(folder):
        there, whole = folder.is_dir(), path.is_file()
    if not there:
        reached(folder)
        raise InputError(f"dataset {folder}: no such folder; make one with dlkf.simulate or dlkf.ingest")
    if not whole:
        raise InputError(f"dataset {folder}: drives.parquet is missing; it holds one row per drive")
    table = _read(path, "drives.parquet")
    for name in DRIVES_REQUIRED:
        if name not in table.column_names:
            raise InputError(f"drives.parquet: column {name} missing; has {', '.join(table.column_names)}")
    names = [check_name(str(name)) for name in table["drive"].to_pylist()]
    if not names:
        raise InputError(f"dataset {folder}: drives.parquet has no rows; add one per drive")
    if doubles := sorted({n for n in names if names.count(n) > 1}):
        raise InputError(f"drives.parquet: drive {doubles[0]} stands twice; names must be unique")
    arms = []
    for column in LEVER_ARM:
        if column in table.column_names:
            kind = DRIVES.field(column).type
            arms.append(np.nan_to_num(_column(table, column, kind, "drives.parquet").astype(float)))
        else:
            arms.append(np.zeros(len(names)))
    groups = [str(g) if g else name for g, name in zip(table["group"].to_pylist(), names)]
    return [DriveRow(n, g, (float(x), float(y), float(z))) for n, g, x, y, z in zip(names, groups, *arms)]


class DriveClock(NamedTuple):
    """What a drive's ``t`` counts: ``file_s`` + t is the time of its log files, ``gps_s`` + ``gps_rate`` t GPS time by
    the receiver's own stamps [s since 1980]; NaN where it is not known."""

    file_s: float = math.nan
    gps_s: float = math.nan
    gps_rate: float = 1.0


def drive_clocks(folder: str | Path) -> dict[str, DriveClock]:
    """The clocks of the drives of a dataset."""
    path = placed(folder) / "drives.parquet"
    if not path.is_file():
        return {}
    table = pq.ParquetFile(readable(path)).read()
    columns = []
    for name, unknown in (("time_zero_s", math.nan), ("gps_zero_s", math.nan), ("gps_rate", 1.0)):
        values = np.full(len(table), np.nan)
        if name in table.column_names:
            values = _column(table, name, pa.float64(), "drives.parquet")
        columns.append(np.where(np.isfinite(values), values, unknown).tolist())
    return {str(drive): DriveClock(*row) for drive, *row in zip(table["drive"].to_pylist(), *columns)}


def read_table(folder: str | Path, kind: str, drive: str) -> Columns | None:
    """The contract's columns of a drive's table (``imu``, ``gnss`` or ``reference``) as numpy arrays.

    A missing reference gives None. Raises InputError, naming drive and file, for a missing or empty table, a
    damaged file, a missing column or a column of the wrong type.
    """
    place = Path(kind) / f"drive={drive}"
    parts = sorted((placed(folder) / place).glob("*.parquet"))
    if not parts:
        if kind == "reference":
            return None
        if kind == "gnss":
            raise InputError(f"drive {drive}: no GNSS, {place}/ has no Parquet file; a filter needs position fixes")
        raise InputError(f"drive {drive}: {place}/ has no Parquet file though drives.parquet lists the drive")
    pieces = []
    for part in parts:
        where = f"drive {drive}, {place / part.name}"
        table = _read(part, where)
        columns = {}
        for field in SCHEMAS[kind]:
            if field.name not in table.column_names:
                has = ", ".join(table.column_names)
                raise InputError(f"{where}: column {field.name} missing; has {has}")
            columns[field.name] = _column(table, field.name, field.type, where)
        for field in OPTIONAL[kind]:
            if field.name in table.column_names:
                columns[field.name] = _column(table, field.name, field.type, where)
        pieces.append(columns)
    rows = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    if len(rows["t"]) == 0 and kind != "reference":
        raise InputError(f"drive {drive}, {place}: has no rows; leave the drive out or give its data")
    return rows if len(rows["t"]) else None


def dataset_digest(folder: str | Path) -> str:
    """Hash of the contents of a dataset's files, 32 hexadecimal digits; names count, dates do not."""
    folder = placed(folder)
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.rglob("*.parquet"), key=lambda p: p.relative_to(folder).as_posix()):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()


def _read(path: Path, where: str) -> pa.Table:
    try:
        return pq.ParquetFile(readable(path)).read()
    except (pa.ArrowInvalid, OSError) as error:
        reason = str(error).splitlines()[0][:100]
        raise InputError(f"{where}: not a whole Parquet file ({reason}); write or copy it again") from None


def _column(table: pa.Table, name: str, kind: pa.DataType, where: str) -> np.ndarray:
    """A column as float64, int64 or bool; whole numbers may stand for floats, texts for nothing."""
    column = table[name]
    have = column.type
    numeric = pa.types.is_floating(have) or pa.types.is_integer(have)
    if pa.types.is_boolean(kind):
        fits = pa.types.is_boolean(have) or pa.types.is_integer(have)
    elif pa.types.is_integer(kind):
        fits = numeric
    else:
        fits = numeric or pa.types.is_null(have)
    if not fits:
        raise InputError(f"{where}: column {name} is {have}, must be {kind}; convert it")
    if pa.types.is_boolean(kind):
        return pc.fill_null(pc.cast(column, pa.bool_()), False).to_numpy().astype(bool)
    values = pc.cast(column, pa.float64()).to_numpy()
    if pa.types.is_integer(kind):
        return np.where(np.isfinite(values), values, 0).astype(np.int64)
    return np.asarray(values, dtype=np.float64)
