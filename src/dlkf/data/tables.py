"""Read the tables of a dataset, with their columns and types checked against the contract."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from dlkf.base.errors import InputError, did_you_mean, first_line, list_some
from dlkf.base.files import (
    is_url,
    open_parquet,
    require_store,
    resolve_place,
    restore_folder,
    store_errors_as_input_error,
)
from dlkf.data.limits import LEVER_ARM_M
from dlkf.data.schema import AIDS, DRIVES_REQUIRED, LEVER_ARM, OPTIONAL, POSITION, SCHEMAS, check_name, own_schema

Columns = dict[str, np.ndarray]
CONTRACT = {**SCHEMAS, **AIDS}


@dataclass(frozen=True)
class DriveRow:
    """The columns of ``drives.parquet`` that a filter or a split needs."""

    name: str
    group: str
    lever_arm_b: tuple[float, float, float]  # m, IMU → antenna, FRD


def path_is_file(path: Path) -> bool:
    """Whether it is a file of this machine."""
    return not is_url(str(path)) and path.is_file()


def read_drives(folder: str | Path) -> list[DriveRow]:
    """The drives of a dataset in the order of ``drives.parquet``.

    Raises InputError if the folder, the file or a needed column is missing, or a name appears twice.
    """
    if not str(folder):
        raise InputError("dataset= is empty; give a folder")
    if not is_url(folder) and not Path(folder).exists():
        restore_folder(Path(folder).absolute())
    folder = resolve_place(folder)
    path = folder / "drives.parquet"
    with store_errors_as_input_error(folder):
        there, whole = folder.is_dir(), path.is_file()
    if not there:
        require_store(folder)
        if path_is_file(folder):
            raise InputError(f"dataset {folder}: is a file; give its folder, {folder.parent}")
        beside = () if is_url(str(folder)) else folder.parent.glob("*/")
        near = did_you_mean(folder.name, [p.name for p in beside]) or "; make one with dlkf.simulate or dlkf.ingest"
        if folder.parent != Path("."):
            near = near.replace("did you mean ", f"did you mean {folder.parent}/")
        raise InputError(f"dataset {folder}: no such folder{near}")
    if not whole:
        raise InputError(f"dataset {folder}: drives.parquet is missing; {_find_dataset(folder)}")
    table = _read(path, "drives.parquet")
    for name in DRIVES_REQUIRED:
        if name not in table.column_names:
            raise InputError(f"drives.parquet: column {name} missing; has {', '.join(table.column_names)}")
    names = [check_name(str(name)) for name in table["drive"].to_pylist()]
    if not names:
        raise InputError(f"dataset {folder}: drives.parquet has no rows; add one per drive")
    if doubles := sorted({n for n in names if names.count(n) > 1}):
        raise InputError(f"drives.parquet: drive {doubles[0]} appears twice; names must be unique")
    there = {c: _column(table, c, pa.float64(), "drives.parquet") for c in LEVER_ARM if c in table.column_names}
    arms = [np.nan_to_num(there.get(column, np.zeros(len(names)))) for column in LEVER_ARM]
    for name, arm in zip(names, zip(*arms)):
        if not math.hypot(*arm) <= LEVER_ARM_M:
            raise InputError(
                f"drives.parquet: drive {name}: a lever arm of {math.hypot(*arm):.3g} m; no antenna is further than "
                f"{LEVER_ARM_M:g} m from its IMU: lever_arm_x_m, _y_m, _z_m are in metres"
            )
    groups = [str(g) if g else name for g, name in zip(table["group"].to_pylist(), names)]
    return [DriveRow(n, g, (float(x), float(y), float(z))) for n, g, x, y, z in zip(names, groups, *arms)]


def _find_dataset(folder: Path) -> str:
    """Where the dataset is that a folder without one stands for: above it, in it, or yet to be made."""
    if path_is_file(folder.parent / "drives.parquet"):
        return f"it lies in {folder.parent}"
    inside = [] if is_url(str(folder)) else sorted(str(path.parent) for path in folder.glob("*/drives.parquet"))
    if inside:
        return f"give a dataset in it: {list_some(inside)}"
    return "it holds one row per drive; dlkf.ingest makes a dataset of logs"


LATEST_S = 1e11  # of a clock that counts seconds from 1970, 1980 or when a logger was started


class DriveClock(NamedTuple):
    """What a drive's ``t`` counts: ``file_s`` + t is the time of its log files, ``gps_s`` + ``gps_rate`` t GPS time by
    the receiver's own stamps [s since 1980]; NaN where it is not known."""

    file_s: float = math.nan
    gps_s: float = math.nan
    gps_rate: float = 1.0


def drive_clocks(folder: str | Path) -> dict[str, DriveClock]:
    """The clocks of the drives of a dataset."""
    path = resolve_place(folder) / "drives.parquet"
    if not path.is_file():
        return {}
    table = _read(path, "drives.parquet")
    columns = []
    for name, unknown in (("time_zero_s", math.nan), ("gps_zero_s", math.nan), ("gps_rate", 1.0)):
        values = np.full(len(table), np.nan)
        if name in table.column_names:
            values = _column(table, name, pa.float64(), "drives.parquet")
        if (beyond := values[np.abs(values) > LATEST_S]).size:
            raise InputError(f"drives.parquet: {name} is {beyond[0]:g}, no time in seconds; correct it or leave it out")
        columns.append(np.where(np.isfinite(values), values, unknown).tolist())
    return {str(drive): DriveClock(*row) for drive, *row in zip(table["drive"].to_pylist(), *columns)}


def read_drives_table(folder: str | Path) -> pd.DataFrame:
    """All columns of ``drives.parquet``."""
    return _read(resolve_place(folder) / "drives.parquet", "drives.parquet").to_pandas()


def read_table(folder: str | Path, kind: str, drive: str, column: str = "") -> Columns | None:
    """The contract's columns of a drive's table (``imu``, ``gnss``, ``reference`` or an aid) as numpy arrays.

    Of a table that is not in the contract, ``t``, ``column`` and ``std`` if it has one. A missing reference or aid
    gives None. Raises InputError, naming drive and file, for a missing or empty table, a
    damaged file, a missing column or a column of the wrong type.
    """
    own = own_schema(column)
    place = Path(kind) / f"drive={drive}"
    parts = sorted((resolve_place(folder) / place).glob("*.parquet"))
    if not parts:
        if kind == "reference" or kind not in SCHEMAS:
            return None
        root = resolve_place(folder)
        others = sorted(other.name for other in (root / kind).glob("drive=*"))
        if others and not (root / "imu" / place.name).exists():
            listed = list_some(others, 5)
            raise InputError(f"drive {drive}: is in drives.parquet, but {kind}/ has {listed} alone; give both one name")
        if kind == "gnss":
            raise InputError(f"drive {drive}: no GNSS, {place}/ has no Parquet file; a filter needs position fixes")
        raise InputError(f"drive {drive}: {place}/ has no Parquet file though drives.parquet lists the drive")
    segments = []
    for part in parts:
        where = f"drive {drive}, {place / part.name}"
        table = _read(part, where)
        columns = {}
        for field in CONTRACT.get(kind, own):
            if field.name not in table.column_names:
                has = ", ".join(table.column_names)
                raise InputError(f"{where}: column {field.name} missing; has {has}")
            columns[field.name] = _column(table, field.name, field.type, where)
        for field in OPTIONAL.get(kind, OPTIONAL["speed"]):
            if field.name in table.column_names:
                columns[field.name] = _column(table, field.name, field.type, where)
        segments.append(columns)
    rows = segments[0]
    if len(segments) > 1:
        rows = {name: np.concatenate([segment[name] for segment in segments]) for name in rows}
    if len(rows["t"]) == 0 and kind != "reference":
        remedy = "leave the drive out" if kind in SCHEMAS else "remove the table"
        raise InputError(f"drive {drive}, {place}: has no rows; {remedy} or give its data")
    return rows if len(rows["t"]) else None


def read_first_stamps(folder: str | Path, drive: str) -> np.ndarray:
    """The first 1000 ``t`` [s] of a drive's IMU, without reading the rest; none of one that is missing or damaged."""
    try:
        part = min((resolve_place(folder) / "imu" / f"drive={drive}").glob("*.parquet"))
        if not part.is_file():
            return np.empty(0)
        rows = next(pq.ParquetFile(open_parquet(part)).iter_batches(1000, columns=["t"]))
        return np.asarray(rows["t"].to_numpy(zero_copy_only=False), float)
    except (ValueError, KeyError, StopIteration, pa.ArrowException, OSError):
        return np.empty(0)


def refuse_rows(
    table: Columns, names: Iterable[str], is_bad: Callable[[np.ndarray], np.ndarray], where: str, remedy: str
) -> None:
    """InputError for the first row in which one of the columns is bad."""
    for name in names:
        if len(rows := np.flatnonzero(is_bad(table[name]))):
            raise InputError(f"{where}: row {rows[0]}: {name} is {table[name][rows[0]]}; {remedy}")


def dataset_digest(folder: str | Path) -> str:
    """Hash of the contents of a dataset's files, 32 hexadecimal digits; names count, dates do not."""
    folder = resolve_place(folder)
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(folder.rglob("*.parquet"), key=lambda p: p.relative_to(folder).as_posix()):
        if not path.is_file():
            raise InputError(f"{path}: is no file; take it away or copy it again")
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "blake2b").digest())
    return digest.hexdigest()


def _read(path: Path, where: str) -> pa.Table:
    if not path.is_file():
        raise InputError(f"{where}: is no file; write or copy it again")
    try:
        table = pq.ParquetFile(open_parquet(path), page_checksum_verification=True).read()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = first_line(error)
        raise InputError(f"{where}: not a whole Parquet file ({reason}); write or copy it again") from None
    if doubles := sorted({name for name in table.column_names if table.column_names.count(name) > 1}):
        raise InputError(f"{where}: column {doubles[0]} appears twice; leave one")
    return table


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
    if name in POSITION[:2] and pa.types.is_integer(have):
        raise InputError(f"{where}: column {name} is {have}: whole degrees are 100 km apart; write it as double")
    values = pc.cast(column, pa.float64(), safe=False).to_numpy()
    if pa.types.is_integer(kind):
        return np.where(np.isfinite(values), values, 0).astype(np.int64)
    return np.asarray(values, dtype=np.float64)
