"""One drive written as logs of every format, each by the library of that format where there is one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d

from tests.cars import Tables
from tests.data.logs.arrays import csv, kfgins, kitti, matlab, navego, navego_73, parquet
from tests.data.logs.bags import ros1, ros1_nmea, ros1_ublox, ros2, ros2_ublox
from tests.data.logs.phones import gnss_logger, phyphox, phyphox_android, sensor_logger
from tests.data.logs.receivers import (
    inertial_explorer,
    nmea,
    novatel,
    novatel_x,
    rtklib,
    rtklib_dms,
    rtklib_ecef,
    ubx,
    ubx_meas,
)

WRITERS: tuple[Callable[[Path, Tables], list[str]], ...] = (
    *(csv, parquet, ubx, ubx_meas, nmea, ros1, ros2, ros1_nmea, ros1_ublox, ros2_ublox, navego, navego_73, matlab),
    *(kitti, kfgins, rtklib, rtklib_ecef, rtklib_dms, inertial_explorer, sensor_logger, gnss_logger, phyphox),
    *(phyphox_android, novatel, novatel_x),
)


def metres(a: pd.DataFrame, b: pd.DataFrame) -> np.ndarray:
    """Distance [m] between the positions of two tables."""
    ecef = [np.stack(pymap3d.geodetic2ecef(*(t[c] for c in ("lat_deg", "lon_deg", "height_m"))), -1) for t in (a, b)]
    return np.linalg.norm(ecef[0] - ecef[1], axis=-1)
