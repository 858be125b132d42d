"""Drives that are broken: exit code 2, one line on stderr that says what and where, nothing half-written.

Of all that can be wrong in a table (tests/data/test_validate.py) one fault of each kind of file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from dlkf.data.schema import drive_file
from tests.commands.refusals import DRIVE, FAST, is_refused


def put(kind: str, column: str, row: int, value: float) -> Callable[[Path], None]:
    """A fault: a value in a table of one drive."""

    def apply(folder: Path) -> None:
        path = drive_file(folder, kind, DRIVE)
        table = pd.read_parquet(path, partitioning=None)
        table.loc[row, column] = value
        table.to_parquet(path, index=False)

    return apply


def truncated(folder: Path) -> None:
    path = drive_file(folder, "imu", DRIVE)
    path.write_bytes(path.read_bytes()[:-1000])


def as_pipe(kind: str) -> Callable[[Path], None]:
    """A fault: a table from which nothing ever comes."""

    def apply(folder: Path) -> None:
        path = drive_file(folder, kind, DRIVE)
        path.unlink()
        os.mkfifo(path)

    return apply


def column_twice(folder: Path) -> None:
    path = drive_file(folder, "imu", DRIVE)
    table = pq.ParquetFile(path).read()
    pq.write_table(table.append_column("gyro_x", table["gyro_x"]), path)


def long_name(folder: Path) -> None:
    table = pd.read_parquet(folder / "drives.parquet")
    table["drive"] = table["drive"].replace(DRIVE, "x" * 300)
    table.to_parquet(folder / "drives.parquet", index=False)


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no drives.parquet": (lambda folder: (folder / "drives.parquet").unlink(), ("drives.parquet is missing",)),
    "NaN in the IMU": (put("imu", "gyro_z", 700, np.nan), (DRIVE, "row 700", "gyro_z")),
    "infinite position": (put("gnss", "height_m", 7, np.inf), (DRIVE, "row 7", "height_m")),
    "time of GNSS goes back": (put("gnss", "t", 9, 3.0), (DRIVE, "gnss", "row 9")),
    "truncated file": (truncated, (DRIVE, "not a whole Parquet file")),
    "a pipe": (as_pipe("imu"), (DRIVE, "is no file")),
    "a pipe in the reference": (as_pipe("reference"), (DRIVE, "is no file")),
    "a column twice": (column_twice, (DRIVE, "gyro_x appears twice")),
    "a name of 300 letters": (long_name, ("at most 200 bytes",)),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("command", FAST)
def test_faulty_data(command, fault, copy, call, tmp_path):
    spoil, said = FAULTS[fault]
    spoil(copy)
    done = call(command, "model=mbkf15", "dataset=town", "out=made/here", *FAST[command])
    is_refused(done, *said, folder=tmp_path)


def test_a_faulty_reference_stops_evaluate_and_not_navigate(copy, call, tmp_path):
    put("reference", "t", 9, 0.2)(copy)
    said = (DRIVE, "reference", "row 9")
    is_refused(call("evaluate", "model=ins", "dataset=town", "out=made", *FAST["evaluate"]), *said, folder=tmp_path)
    done = call("navigate", "model=ins", "dataset=town", "out=made", *FAST["navigate"])
    assert done.code == 0, done.err
