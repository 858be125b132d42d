"""How an IMU is mounted, as a solution shows it: where the car goes in the IMU's axes."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from dlkf.base.angles import circular_median, wrap_angle

FASTER_THAN_REVERSE = 8.0  # m/s
ASKEW = math.radians(10.0)  # between course and heading; the constraints' mounting angles are expected to be smaller


def describe_mounting(table: pd.DataFrame) -> str:
    """Where a car that moves faster than a reversing one goes in the axes of its IMU, unless that is forward."""
    north, east, yaw = (table[column].to_numpy(float) for column in ("vel_n", "vel_e", "yaw"))
    fast = np.hypot(north, east) > FASTER_THAN_REVERSE
    if not fast.any():
        return ""
    course = wrap_angle(np.arctan2(east, north) - yaw)[fast]
    if np.mean(np.abs(course) > np.pi / 2) > 0.9:
        return "backwards all the way (an IMU mounted the other way round?), "
    turned, off = circular_median(course)
    if abs(turned) < ASKEW or np.mean(np.abs(off) < ASKEW) < 0.9:
        return ""
    side = "right" if turned > 0 else "left"
    return f"{np.degrees(abs(turned)):.0f}° to the {side} of the IMU's x axis (dlkf doctor measures its mounting), "
