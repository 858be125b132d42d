"""The Parquet contract of a dataset: its columns, and writers that leave whole files or none.

::

    <dataset>/drives.parquet                       one row per drive
    <dataset>/imu/drive=<id>/part-0.parquet        t, gyro_x|y|z [rad/s], accel_x|y|z [m/s²]; mean over the
                                                   interval that ends at t, FRD, −g on z at rest
    <dataset>/gnss/drive=<id>/part-0.parquet       antenna, instantaneous at t; quality = NMEA GGA code
    <dataset>/reference/drive=<id>/part-0.parquet  optional; instantaneous at t
    <dataset>/speed/drive=<id>/part-0.parquet      optional; t, speed [m/s, forward positive or never negative], std
    <dataset>/heading/drive=<id>/part-0.parquet    optional; t, heading [rad] of the car from North over East, std
    <dataset>/baro/drive=<id>/part-0.parquet       optional; t, pressure [Pa] or height_m, std of height_m
    <dataset>/raw/drive=<id>/part-0.parquet        optional; satellite observations, see
                                                   dlkf.simulation.gnss.satellite_fixes.Received

NaN stands for unknown values. Any other column is carried along.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from dlkf.base.errors import InputError
from dlkf.base.files import is_url, replace_file, replace_folder, require_empty, resolve_place

F, I, B = pa.float64(), pa.int8(), pa.bool_()
ACCEL = ("accel_x", "accel_y", "accel_z")
GYRO = ("gyro_x", "gyro_y", "gyro_z")
POSITION = ("lat_deg", "lon_deg", "height_m")
VELOCITY = ("vel_n", "vel_e", "vel_d")
STD = ("std_pos_n", "std_pos_e", "std_pos_d", "std_vel_n", "std_vel_e", "std_vel_d")
ATTITUDE = ("roll", "pitch", "yaw")
IMU_ERROR = ("accel_error_x", "accel_error_y", "accel_error_z", "gyro_error_x", "gyro_error_y", "gyro_error_z")
QUALITIES = {  # of a fix, by NMEA's GGA code
    0: "no fix", 1: "single", 2: "DGNSS", 3: "PPS", 4: "RTK fixed", 5: "RTK float", 6: "dead reckoning", 7: "manual",
    8: "simulated", 9: "SBAS",
}  # fmt: skip
LONGEST_NAME = 200  # bytes of a drive's name: a file system takes 255 with what stands before it
LEVER_ARM = ("lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m")


def _schema(kinds: Mapping[str, Any]) -> pa.Schema:
    return pa.schema([pa.field(name, kind) for name, kind in kinds.items()])


SCHEMAS: dict[str, pa.Schema] = {
    "imu": _schema(dict.fromkeys(("t", *GYRO, *ACCEL), F)),
    "gnss": _schema(dict.fromkeys(("t", *POSITION, *VELOCITY, *STD), F) | {"quality": I}),
    "reference": _schema(dict.fromkeys(("t", *POSITION, *VELOCITY, *ATTITUDE), F) | {"valid": B}),
}
AIDS: dict[str, pa.Schema] = {  # tables that a drive may have: of other sensors than IMU and GNSS
    "speed": _schema(dict.fromkeys(("t", "speed"), F)),
    "heading": _schema(dict.fromkeys(("t", "heading"), F)),
    "baro": _schema({"t": F}),
}
OPTIONAL: dict[str, pa.Schema] = {  # read where present
    "imu": pa.schema([]),
    "gnss": pa.schema([]),
    "reference": _schema(dict.fromkeys(IMU_ERROR, F)),
    "speed": _schema({"std": F}),
    "heading": _schema({"std": F}),
    "baro": _schema(dict.fromkeys(("pressure", "height_m", "std"), F)),
}
TEXTS = ("drive", "group", "source", "licence", "imu", "gnss", "reference")
NUMBERS = ("imu_rate_hz", "gnss_rate_hz", "duration_s", "distance_m", *LEVER_ARM)
DRIVES = _schema({**dict.fromkeys(TEXTS, pa.string()), **dict.fromkeys(NUMBERS, F)})
DRIVES_REQUIRED = ("drive", "group")


def own_schema(column: str = "") -> pa.Schema:
    """Of a table of a user's own: time and a column of values."""
    return _schema(dict.fromkeys(("t", column) if column else ("t",), F))


def stack_columns(table: Mapping[str, Any] | pd.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Columns of a table side by side, (rows, names)."""
    return np.stack([table[name] for name in names]).T


def drive_file(folder: Path, kind: str, drive: str) -> Path:
    """Where a table of a drive is written; ``kind`` is imu, gnss, reference or one of :data:`AIDS`."""
    return resolve_place(folder) / kind / f"drive={drive}" / "part-0.parquet"


@contextmanager
def new_dataset(folder: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write a dataset into, which becomes ``folder`` when the block ends well, else vanishes.

    Raises InputError if ``folder`` already holds something and ``overwrite`` is False.
    """
    require_empty(folder, overwrite=overwrite)
    with replace_folder(folder) as beside:
        yield beside


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a table beside its place, then rename it into place.

    Noise repeats no number, so floats go without a dictionary and byte by byte (first bytes of all rows, then second
    ones): two thirds of the size, read three times as fast, written four times.
    """
    floats = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    others = [name for name in table.column_names if name not in floats]
    with replace_file(path) as beside:
        pq.write_table(
            table, beside, compression="zstd", write_page_checksum=True,
            use_dictionary=others, use_byte_stream_split=floats,  # pyright: ignore[reportArgumentType]  names do as well
        )  # fmt: skip


def write_drive(
    folder: str | Path,
    meta: Mapping[str, Any],
    imu: pd.DataFrame,
    gnss: pd.DataFrame | None,
    reference: pd.DataFrame | None = None,
    aids: Mapping[str, pd.DataFrame] | None = None,
) -> dict[str, Any]:
    """Write the tables of a drive and return its completed row for :func:`write_drives_table`.

    ``aids`` are tables of :data:`AIDS`, or of one's own, by name.

    ``meta`` needs ``drive``; ``group`` defaults to it, rates, duration and distance are filled in from the
    tables where absent; a log for :mod:`dlkf.allan` needs no GNSS. Columns beyond the contract are kept. Raises
    InputError for a missing column.
    """
    row = dict(meta)
    name = check_name(str(row["drive"]))
    folder = resolve_place(folder)
    for kind, frame in {"imu": imu, "gnss": gnss, "reference": reference, **(aids or {})}.items():
        if frame is not None:
            write_parquet(drive_file(folder, kind, name), contract_table(kind, frame, name))
    row.setdefault("group", name)
    row.setdefault("imu_rate_hz", _rate(imu["t"]))
    if gnss is not None:
        row.setdefault("gnss_rate_hz", _rate(gnss["t"]))
    row.setdefault("duration_s", float(imu["t"].iloc[-1] - imu["t"].iloc[0]) if len(imu) else 0.0)
    way = gnss if reference is None else reference
    row.setdefault("distance_m", float("nan") if way is None else driven_distance(way_with_imu(way, imu)))
    return row


def write_drives_table(folder: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write ``drives.parquet``; texts that a row lacks become empty, numbers NaN, lever arms zero."""
    frame = pd.DataFrame([dict(row) for row in rows])
    for name in TEXTS:
        frame[name] = frame[name].fillna("").astype(str) if name in frame else ""
    for name in NUMBERS:
        default = 0.0 if name in LEVER_ARM else np.nan
        frame[name] = frame[name].astype(float).fillna(default) if name in frame else default
    ordered = frame[[*DRIVES.names, *(c for c in frame.columns if c not in DRIVES.names)]]
    write_parquet(resolve_place(folder) / "drives.parquet", pa.Table.from_pandas(ordered, preserve_index=False))


def contract_table(kind: str, frame: pd.DataFrame, drive: str) -> pa.Table:
    """A frame in the contract's column order and types, extra columns last.

    Raises InputError naming the drive and what is missing.
    """
    schema = {**SCHEMAS, **AIDS}.get(kind, own_schema())
    if missing := [name for name in schema.names if name not in frame]:
        raise InputError(f"drive {drive}, {kind}: column {', '.join(missing)} missing; has {', '.join(frame.columns)}")
    extra = [name for name in frame.columns if name not in schema.names]
    columns = [pa.array(frame[n].to_numpy(), type=schema.field(n).type) for n in schema.names]
    columns += [pa.array(frame[name]) for name in extra]
    return pa.table(dict(zip([*schema.names, *extra], columns)))


def check_name(drive: str) -> str:
    """The drive's name, if it can be part of a path ``drive=<name>``; InputError if not."""
    if not drive or drive.startswith(".") or any(c in drive for c in "/\\=") or drive != drive.strip():
        raise InputError(f"drive {drive!r}: a drive's name must be non-empty, without '/', '\\', '=' or a leading dot")
    if len(drive.encode(errors="replace")) > LONGEST_NAME:
        raise InputError(f"drive {drive[:40]!r}…: a drive's name names a folder, with at most {LONGEST_NAME} bytes")
    return drive


def _rate(t: pd.Series) -> float:
    step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    return 1 / step if step else float("nan")


def remove_drive(folder: str | Path, name: str) -> None:
    """Delete the tables of a drive that :func:`write_drive` wrote."""
    for kind in resolve_place(folder).iterdir():
        drive: Any = kind / f"drive={name}"
        if is_url(drive) and drive.exists():
            drive.fs.rm(drive.path, recursive=True)
        elif not is_url(drive):
            shutil.rmtree(drive, ignore_errors=True)


def way_with_imu(frame: pd.DataFrame, imu: pd.DataFrame) -> pd.DataFrame:
    """The rows at times of the IMU, a second before and after it included."""
    t = imu["t"].to_numpy()
    return frame[frame["t"].between(t[0] - 1, t[-1] + 1)] if len(t) else frame


def driven_distance(frame: pd.DataFrame) -> float:
    """Length of the way [m] from the horizontal velocities (trapezoid); unknown velocities count as zero."""
    speed = np.nan_to_num(np.hypot(frame["vel_n"], frame["vel_e"]))
    return float(np.trapezoid(speed, frame["t"])) if len(frame) > 1 else 0.0
