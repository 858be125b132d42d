"""Drives that are broken: exit code 2, one line on stderr that says what and where, nothing half-written."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from dlkf.data.schema import drive_file
from tests.commands.refusals import DRIVE, FAST, is_refused


def change(kind: str, edit: Callable[[pd.DataFrame], pd.DataFrame | None]) -> Callable[[Path], None]:
    """A fault that edits one table of one drive."""

    def apply(folder: Path) -> None:
        path = drive_file(folder, kind, DRIVE)
        table = pd.read_parquet(path, partitioning=None)
        edited = edit(table)
        (table if edited is None else edited).to_parquet(path, index=False)

    return apply


def put(column: str, row: int, value: float) -> Callable[[pd.DataFrame], None]:
    def edit(table: pd.DataFrame) -> None:
        table.loc[row, column] = value

    return edit


def scale(prefix: str, factor: float) -> Callable[[pd.DataFrame], None]:
    def edit(table: pd.DataFrame) -> None:
        columns = [c for c in table if c.startswith(prefix)]
        table[columns] *= factor

    return edit


def swapped(table: pd.DataFrame) -> None:
    table[["lat_deg", "lon_deg"]] = table[["lon_deg", "lat_deg"]].to_numpy()


def as_text(table: pd.DataFrame) -> None:
    table["accel_x"] = table["accel_x"].map("{:.3f}".format)


def back_in_time(table: pd.DataFrame) -> None:
    table.loc[500:, "t"] -= 1.0


def twice(table: pd.DataFrame) -> pd.DataFrame:
    return table.iloc[[*range(500), *range(499, len(table))]]


def no_fix(table: pd.DataFrame) -> None:
    table["quality"] = np.int8(0)


def truncated(folder: Path) -> None:
    path = drive_file(folder, "imu", DRIVE)
    path.write_bytes(path.read_bytes()[:-1000])


def no_bytes(folder: Path) -> None:
    drive_file(folder, "imu", DRIVE).write_bytes(b"")


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


def in_drives(column: str, value: object) -> Callable[[Path], None]:
    """A fault of ``drives.parquet``."""

    def apply(folder: Path) -> None:
        table = pd.read_parquet(folder / "drives.parquet")
        table[column] = table[column].astype(object) if column in table else None
        table.loc[table["drive"] == DRIVE, column] = value
        table.to_parquet(folder / "drives.parquet", index=False)

    return apply


def drop(*parts: str) -> Callable[[Path], None]:
    """A fault: a file or folder that is not there."""

    def apply(folder: Path) -> None:
        path = folder.joinpath(*parts)
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no drives.parquet": (drop("drives.parquet"), ("drives.parquet is missing",)),
    "no IMU folder": (drop("imu", f"drive={DRIVE}"), (DRIVE, "imu")),
    "no GNSS folder": (drop("gnss", f"drive={DRIVE}"), (DRIVE, "no GNSS")),
    "missing column": (change("imu", lambda t: t.drop(columns="gyro_y")), (DRIVE, "gyro_y missing")),
    "missing GNSS column": (change("gnss", lambda t: t.drop(columns="vel_e")), (DRIVE, "vel_e missing")),
    "wrong type": (change("imu", as_text), (DRIVE, "accel_x", "must be double")),
    "NaN in the IMU": (change("imu", put("gyro_z", 700, np.nan)), (DRIVE, "row 700", "gyro_z")),
    "infinite IMU": (change("imu", put("accel_y", 700, np.inf)), (DRIVE, "row 700", "accel_y")),
    "infinite position": (change("gnss", put("height_m", 7, np.inf)), (DRIVE, "row 7", "height_m")),
    "time goes back": (change("imu", back_in_time), (DRIVE, "row 500", "goes back")),
    "time of GNSS goes back": (change("gnss", put("t", 9, 3.0)), (DRIVE, "gnss", "row 9")),
    "duplicate stamps": (change("imu", twice), (DRIVE, "row 500", "twice")),
    "gap": (change("imu", lambda t: t.drop(index=range(800, 900))), (DRIVE, "row 800", "gap of 2.0")),
    "no rows": (change("imu", lambda t: t.iloc[:0]), (DRIVE, "no rows")),
    "no GNSS rows": (change("gnss", lambda t: t.iloc[:0]), (DRIVE, "gnss", "no rows")),
    "empty file": (no_bytes, (DRIVE, "not a whole Parquet file")),
    "truncated file": (truncated, (DRIVE, "not a whole Parquet file")),
    "gyro in degrees": (change("imu", scale("gyro_", 180 / np.pi)), (DRIVE, "degrees")),
    "position in radians": (change("gnss", scale("l", np.pi / 180)), (DRIVE, "radians")),
    "accelerations in g": (change("imu", scale("accel_", 1 / 9.80665)), (DRIVE, "looks like g", "9.80665")),
    "latitude and longitude swapped": (change("gnss", swapped), (DRIVE, "swapped")),
    "no fix at all": (change("gnss", no_fix), (DRIVE, "no GNSS fix")),
    "a pipe": (as_pipe("imu"), (DRIVE, "is no file")),
    "a pipe in the reference": (as_pipe("reference"), (DRIVE, "is no file")),
    "a column twice": (column_twice, (DRIVE, "gyro_x appears twice")),
    "a name of 300 letters": (in_drives("drive", "x" * 300), ("at most 200 bytes",)),
    "another clock": (change("gnss", lambda t: t.assign(t=t["t"] + 1e6)), (DRIVE, "same clock")),
}


REFERENCE_FAULTS = {
    "attitude in degrees": (change("reference", scale("yaw", 180 / np.pi)), (DRIVE, "yaw", "degrees")),
    "reference time goes back": (change("reference", put("t", 9, 0.2)), (DRIVE, "reference", "row 9")),
    "reference without a column": (change("reference", lambda t: t.drop(columns="roll")), ("roll missing",)),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("command", FAST)
def test_faulty_data(command, fault, copy, call, tmp_path):
    spoil, said = FAULTS[fault]
    spoil(copy)
    done = call(command, "model=mbkf15", "dataset=town", "out=made/here", *FAST[command])
    is_refused(done, *said, folder=tmp_path)


@pytest.mark.parametrize("fault", REFERENCE_FAULTS)
def test_a_faulty_reference_stops_evaluate_and_not_navigate(fault, copy, call, tmp_path):
    spoil, said = REFERENCE_FAULTS[fault]
    spoil(copy)
    is_refused(call("evaluate", "model=ins", "dataset=town", "out=made", *FAST["evaluate"]), *said, folder=tmp_path)
    done = call("navigate", "model=ins", "dataset=town", "out=made", *FAST["navigate"])
    assert done.code == 0, done.err


def test_an_unknown_key(copy, call, tmp_path):
    ended = call("evaluate", "model=mbkf15", "dataset=town", "colour=red", "out=made")
    is_refused(ended, "unknown config key 'colour'", folder=tmp_path)
