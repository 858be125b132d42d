"""When the drive is, and its IMU as a text table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from dlkf.data.readers.units import GPS_EPOCH_UNIX

WEEK, TOW = 2350, 345_600.0
GPS = WEEK * 604_800 + int(TOW)
UNIX = GPS + GPS_EPOCH_UNIX - 18
G, DEG = 9.80665, np.pi / 180
AXES = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")


def nanoseconds(t: pd.Series, base: int) -> np.ndarray:
    return base * 10**9 + np.round(t.to_numpy() * 1e9).astype(np.int64)


def imu_table(folder: Path, imu: pd.DataFrame, t: np.ndarray | pd.Series) -> None:
    imu.assign(t=t).to_csv(folder / "imu.csv", index=False, float_format="%.12g")
