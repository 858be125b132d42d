"""MATLAB files: scipy for versions 4 to 7, h5py for 7.3; NaveGo's structures and plain matrices.

A structure gives a column for each of its vectors and, of matrices with as many rows, ``name_0``, ``name_1``, …; a
plain matrix gives columns ``0``, ``1``, …
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.io

from dlkf.data.readers.formats import library
from dlkf.data.readers.frames import Table
from dlkf.errors import InputError


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> Table:
    """The variable ``table``; without a name the one called like ``kind``, or the only one of its size."""
    variables = _variables(path)
    usual = (kind, kind.upper(), "ref" if kind == "reference" else kind)
    name = table or next((n for n in usual if n in variables), None)
    if name is None and len(variables) == 1:
        name = next(iter(variables))
    if name is None or name not in variables:
        have = ", ".join(variables) or "nothing"
        raise InputError(f"{path}: no variable {name or kind}; has {have}; set reader.{kind}.table")
    frame = _frame(variables[name])
    if not len(frame):
        raise InputError(f"{path}: {name} has no rows; give a structure of vectors or a matrix")
    return Table(frame, path)


def _variables(path: Path) -> dict[str, Any]:
    try:
        loaded = scipy.io.loadmat(path, simplify_cells=True)
        return {name: value for name, value in loaded.items() if not name.startswith("__")}
    except NotImplementedError:  # version 7.3 is HDF5
        pass
    except (scipy.io.matlab.MatReadError, ValueError, OSError, TypeError, IndexError, KeyError) as error:
        raise InputError(f"{path}: cannot be read as a MATLAB file ({_first_line(error)}); save it again") from None
    h5py = library("h5py", "a MATLAB file of version 7.3")
    try:
        with h5py.File(path) as file:
            return {name: _hdf5(h5py, node) for name, node in file.items() if not name.startswith("#")}
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a MATLAB file ({_first_line(error)}); save it again") from None


def _hdf5(h5py: Any, node: Any) -> Any:
    """MATLAB keeps columns together, so HDF5 has its matrices transposed."""
    if isinstance(node, h5py.Group):
        return {name: _hdf5(h5py, part) for name, part in node.items()}
    value = np.asarray(node)
    return value.T if value.dtype.kind in "fiub" else None


def _frame(value: Any) -> pd.DataFrame:
    if not isinstance(value, Mapping):
        matrix = np.atleast_2d(np.asarray(value, dtype=float))
        if matrix.shape[0] < matrix.shape[1] and matrix.shape[0] <= 30 < matrix.shape[1]:
            matrix = matrix.T  # a series per row
        return pd.DataFrame(matrix, columns=[str(k) for k in range(matrix.shape[1])])
    arrays = {n: np.squeeze(np.asarray(v)) for n, v in value.items() if _is_numeric(v)}
    rows = max((a.shape[0] for a in arrays.values() if a.ndim == 1), default=0)
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
    return pd.DataFrame(out)


def _is_numeric(value: Any) -> bool:
    return value is not None and not isinstance(value, (Mapping, str)) and np.asarray(value).dtype.kind in "fiub"


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]
