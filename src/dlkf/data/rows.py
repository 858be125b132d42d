"""A drive as one table for a service: rows of IMU samples and of fixes, or both in one, NaN where a row has none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.tables import DriveRow
from dlkf.data.validate import CheckedTables, check_tables

IMU_COLUMNS = (*ACCEL, *GYRO)
GNSS_COLUMNS = (*POSITION, *VELOCITY, *STD, "quality")
NEEDED = ("t", *IMU_COLUMNS, *POSITION)


def split_drives(rows: pd.DataFrame, lever_arm_b: Sequence[float]) -> Iterator[CheckedTables]:
    """The checked tables of every ``drive`` in the rows (one drive where there is no such column).

    Columns are those of the data contract; ``vel_*``, ``std_*`` and ``quality`` (default 1, single) may be missing.
    Raises InputError for a missing column and for faulty data.
    """
    if missing := [c for c in NEEDED if c not in rows or rows[c].isna().all()]:
        raise InputError(f"the table lacks {', '.join(missing)}; it needs {', '.join(NEEDED)}")
    name = rows["drive"].fillna("drive") if "drive" in rows else pd.Series("drive", index=rows.index)
    for drive, part in rows.groupby(name, sort=False):
        part = part.sort_values("t", kind="stable")
        imu = part[part["accel_x"].notna()]
        fix = part[part["lat_deg"].notna()]
        if not len(imu) or not len(fix):
            raise InputError(f"drive {drive}: has {len(imu)} IMU samples and {len(fix)} fixes; it needs both")
        gnss = {c: _values(fix, c) for c in ("t", *GNSS_COLUMNS)}
        gnss["quality"] = np.where(np.isnan(gnss["quality"]), 1, gnss["quality"]).astype(np.int64)
        x, y, z = map(float, lever_arm_b)
        row = DriveRow(str(drive), str(drive), (x, y, z))
        yield check_tables(CheckedTables(row, {c: _values(imu, c) for c in ("t", *IMU_COLUMNS)}, gnss, None))


def _values(table: pd.DataFrame, column: str) -> np.ndarray:
    if column not in table:
        return np.full(len(table), np.nan)
    return table[column].to_numpy(dtype=np.float64, na_value=np.nan)


def example_drive() -> pd.DataFrame:
    """What a table of a drive looks like, and works: 10 m/s northwards, 12 s at 50 Hz, a fix a second."""
    t = np.arange(1, 601) / 50.0
    rows = pd.DataFrame({"drive": "example", "t": t} | dict.fromkeys(IMU_COLUMNS, 0.0))
    rows["accel_z"] = -9.806
    fixed = np.isclose(t % 1.0, 0.0) | np.isclose(t % 1.0, 1.0)
    detail = {"lat_deg": 48.0 + 10 * t / 111_200, "lon_deg": 11.0, "height_m": 500.0, "vel_n": 10.0, "vel_e": 0.0}
    detail |= {"vel_d": 0.0, "quality": 4.0} | dict.fromkeys(STD, 0.02)
    for column in GNSS_COLUMNS:
        rows[column] = np.where(fixed, detail[column], np.nan)
    return rows.round(9)
