"""MATLAB files: scipy for versions 4 to 7, h5py for 7.3; structures, plain matrices, vectors of one length.

A structure gives a column for each of its vectors and, of matrices with as many rows, ``name_0``, ``name_1``, …; a
plain matrix gives columns ``0``, ``1``, …; vectors of one length that stand by themselves are the table ``vectors``.
Serial date numbers (days since the year 0) become nanoseconds since 1970.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.io

from dlkf.base.errors import InputError, first_line
from dlkf.data.readers import units
from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import LogTable

DATENUMS = (723_000.0, 767_000.0)  # 1979 to 2099
LARGEST_BYTES = 4 << 30
DAMAGED = (scipy.io.matlab.MatReadError, MemoryError)
DEEPEST = 6  # of structures in structures
VECTORS = "vectors"


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """The variable ``table``; without a name the one called like ``kind``, or the only one of its size."""
    tables = variables(path)
    usual = (kind, kind.upper(), "ref" if kind == "reference" else kind)
    name = table or next((n for n in usual if n in tables), None)
    if name is None and len(tables) == 1:
        name = next(iter(tables))
    if name is None or name not in tables:
        have = ", ".join(tables) or "nothing"
        raise InputError(f"{path}: no variable {name or kind}; has {have}; set reader.{kind}.table")
    frame = _frame(tables[name], f"{path}: {name}")
    if not len(frame):
        raise InputError(f"{path}: {name} has no rows; give a structure of vectors or a matrix")
    return LogTable(frame, path)


def frames(path: Path) -> dict[str, pd.DataFrame]:
    """The variables that are tables of more than one row, by name."""
    found = {name: _frame(value, f"{path}: {name}", strict=False) for name, value in variables(path).items()}
    return {name: frame for name, frame in found.items() if len(frame) > 1}


def variables(path: Path) -> dict[str, Any]:
    """What a file holds, by name; InputError for one that cannot be read."""
    found = _load(path)
    vectors = {n: np.squeeze(v) for n, v in found.items() if isinstance(v, np.ndarray) and v.dtype.kind in "fiub"}
    vectors = {n: v for n, v in vectors.items() if v.ndim == 1 and v.size > 1}
    length = max((v.size for v in vectors.values()), default=0)
    alike = {n: v for n, v in vectors.items() if v.size == length}
    return found | ({VECTORS: _convert_dates(pd.DataFrame(alike))} if len(alike) > 3 and VECTORS not in found else {})


def _load(path: Path) -> dict[str, Any]:
    try:
        try:
            loaded = scipy.io.loadmat(path, simplify_cells=True)
        except NotImplementedError:  # version 7.3 is HDF5
            return _hdf5_variables(path)
    except InputError:
        raise
    except (*DAMAGED, ValueError, OSError, TypeError, LookupError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as a MATLAB file ({first_line(error)}); save it again") from None
    found = {name: value for name, value in loaded.items() if not name.startswith("__")}
    objects = [n for n, v in found.items() if isinstance(v, scipy.io.matlab.MatlabOpaque)]
    if objects and len(objects) == len(found):
        name = objects[0]
        raise InputError(
            f"{path}: {', '.join(objects)} are objects (timetables?) that MATLAB alone reads; save structures there: "
            f"{name} = table2struct(timetable2table({name}), 'ToScalar', true)"
        )
    return found


def _hdf5_variables(path: Path) -> dict[str, Any]:
    h5py = library("h5py", "a MATLAB file of version 7.3")
    with h5py.File(path) as file:
        _check_size(h5py, file, path)
        return {name: _hdf5(h5py, node, DEEPEST) for name, node in file.items() if not name.startswith("#")}


def _check_size(h5py: Any, file: Any, path: Path) -> None:
    """No variable is larger than memory is: a file of some bytes may claim terabytes."""

    def size(_: str, node: Any) -> int | None:
        return node.nbytes if isinstance(node, h5py.Dataset) and node.nbytes > LARGEST_BYTES else None

    if (large := file.visititems(size)) is not None:  # visits every object once, whatever links lead to it
        raise InputError(f"{path}: holds a variable of {large / 2**30:.0f} GiB, which no log is; save the log alone")


def _hdf5(h5py: Any, node: Any, depth: int) -> Any:
    """MATLAB keeps columns together, so HDF5 has its matrices transposed; groups that hold themselves end somewhere."""
    if isinstance(node, h5py.Group):
        return {name: _hdf5(h5py, part, depth - 1) for name, part in node.items()} if depth else None
    if not isinstance(node, h5py.Dataset) or node.dtype.kind not in "fiub":
        return None
    return np.asarray(node).T


def _frame(value: Any, where: str, strict: bool = True) -> pd.DataFrame:
    if isinstance(value, pd.DataFrame):
        return value
    if not isinstance(value, Mapping):
        try:
            matrix = np.atleast_2d(np.asarray(value, dtype=float))
        except (TypeError, ValueError):
            if strict:
                raise InputError(f"{where} is no matrix of numbers and no structure of vectors") from None
            return pd.DataFrame()
        if matrix.ndim > 2:
            return pd.DataFrame()
        if matrix.shape[0] < matrix.shape[1] and matrix.shape[0] <= 30 < matrix.shape[1]:
            matrix = matrix.T  # a series per row
        return pd.DataFrame(matrix, columns=[str(k) for k in range(matrix.shape[1])])
    arrays = {n: np.squeeze(np.asarray(v)) for n, v in value.items() if _is_numeric(v)}
    rows = max((a.shape[0] for a in arrays.values() if a.ndim == 1), default=0)
    rows = rows or max((a.shape[0] for a in arrays.values() if a.ndim == 2), default=0)
    out: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if array.ndim == 2 and array.shape[0] != rows and array.shape[1] == rows:
            array = array.T
        if array.ndim == 1 and array.shape[0] == rows:
            out[name] = array
        elif array.ndim == 2 and array.shape[0] == rows:
            out |= {f"{name}_{k}": column for k, column in enumerate(array.T)}
        elif array.ndim == 1 and array.size == 3 and name in ("stdm", "stdv"):  # NaveGo: one 1σ for all rows
            out |= {f"{name}_{k}": np.full(rows, x) for k, x in enumerate(array)}
    return _convert_dates(pd.DataFrame(out))


def _convert_dates(frame: pd.DataFrame) -> pd.DataFrame:
    """Serial date numbers, which have 10 µs at best, as nanoseconds since 1970."""
    for name in frame.columns:
        values = frame[name].to_numpy(float)
        within = len(values) > 1 and DATENUMS[0] < values.min() and values.max() < DATENUMS[1] and np.ptp(values) < 30
        if within and np.all(np.diff(values) >= 0) and np.any(values != np.round(values)):
            frame[name] = np.round((values - units.DAYS["datenum"]) * 86_400e6).astype(np.int64) * 1000
    return frame


def _is_numeric(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiub"
    except ValueError:  # a list of vectors of several lengths
        return False
