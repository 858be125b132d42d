"""Truth, samples and fixes as the columns of the data contract, for drives that are written or loaded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, IMU_ERROR, POSITION, STD, VELOCITY
from dlkf.data.tables import Columns
from dlkf.simulation.motion.vehicle import Truth

Array = NDArray[np.floating]


def imu_columns(t: Array, samples: Array) -> Columns:
    """Specific force and rate (N, 6) that end at the times ``t`` [s]."""
    return {"t": t, **dict(zip((*ACCEL, *GYRO), samples.T))}


def fix_columns(
    t: Array, lat: Array, lon: Array, height: Array, v_n: Array, std: Array, quality: NDArray[np.int64]
) -> Columns:
    """Fixes at ``t``: latitude, longitude [rad], height [m], velocity (N, 3), 1σ of position and velocity (N, 6)."""
    place = dict(zip(POSITION, (np.degrees(lat), np.degrees(lon), height)))
    return {"t": t, **place, **dict(zip(VELOCITY, v_n.T)), **dict(zip(STD, std.T)), "quality": quality}


def reference_columns(truth: Truth, error: Array) -> Columns:
    """Reference at the times of the truth, with the true IMU error (N, 6) there; yaw within ±π."""
    yaw = np.arctan2(np.sin(truth.rpy[:, 2]), np.cos(truth.rpy[:, 2]))
    return {
        "t": truth.t,
        **dict(zip(POSITION, (np.degrees(truth.lat), np.degrees(truth.lon), truth.height))),
        **dict(zip(VELOCITY, truth.v_n.T)),
        **dict(zip(ATTITUDE, (truth.rpy[:, 0], truth.rpy[:, 1], yaw))),
        "valid": np.ones(len(truth.t), dtype=bool),
        **dict(zip(IMU_ERROR, error.T)),
    }
