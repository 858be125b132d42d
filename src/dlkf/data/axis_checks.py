"""Axes that are dead, mirrored or exchanged, and heights that do not go with the vertical velocity.

As in :mod:`dlkf.data.plausibility` each check compares with other data of the drive.
"""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.clock import ImuSums, Lag, find_lag
from dlkf.data.discovery.motion import Motion, stretches
from dlkf.data.tables import Columns

MOVING, TURNED, SPEED_CHANGE = 3.0, 1.0, 3.0  # m/s; rad and m/s over a drive that an axis at work must show
YAW_AGREES, FORCE_DISAGREES, FORCE_AGREES = 0.85, 0.6, 0.85  # correlations with GNSS
CHUNK_S = 10.0  # way, height and course are compared over such stretches: metres of GNSS noise do not matter
LEAST_CLIMB_M, ALIKE = 1.0, 0.9  # RMS of the climb; correlation
FEET = (2.5, 4.2)  # of the climb by heights to that by velocities


def check_dead_axes(imu: Columns, moved: Motion, where: str) -> None:
    """An axis that never changes although the car turns, brakes and accelerates."""
    fast = moved.speed > MOVING
    if fast.sum() < 3:
        return
    both = fast[1:] & fast[:-1]
    turns = np.abs(wrap_angle(np.diff(moved.course)))[both].sum() > TURNED
    brakes = np.ptp(moved.speed[fast]) > SPEED_CHANGE
    for name, shown, what in (("gyro_z", turns, "turns"), ("accel_x", brakes, "brakes"), ("accel_y", turns, "turns")):
        if shown and np.ptp(imu[name]) == 0:
            raise InputError(
                f"{where}: {name} is {imu[name][0]:g} in every row though the car {what}: a dead axis, or no data of it"
            )


def check_handedness(
    t: np.ndarray, accel: np.ndarray, gyro: np.ndarray, gnss: Motion, best: Lag | None, within_s: float, where: str
) -> None:
    """Turns agree with GNSS, accelerations only when an axis is turned round: the axes are left-handed."""
    if best is None or best.yaw < YAW_AGREES or best.force > FORCE_DISAGREES or abs(best.lag_s) > within_s:
        return
    mirrored = find_lag(ImuSums.of(t, accel * np.array([1.0, -1.0, 1.0]), gyro), gnss, within_s)
    if mirrored is None or mirrored.force < FORCE_AGREES:
        return
    quarter = round(float(mirrored.angle) / (np.pi / 2)) % 4
    remedy, key = {
        0: ("negate accel_y", "reader.imu.accel.mirror=y"),
        2: ("negate accel_x", "reader.imu.accel.mirror=x"),
    }.get(quarter, ("exchange accel_x and accel_y", "reader.imu.accel.columns"))
    raise InputError(
        f"{where}: turns agree with GNSS, accelerations only in left-handed axes ({mirrored.force:.2f} instead of "
        f"{best.force:.2f}): {remedy}, and look at the gyroscope's axes too ({key})"
    )


def check_climb(gnss: Columns, where: str) -> None:
    """Heights against the integral of the downward velocity over stretches of ten seconds."""
    t, height, down = gnss["t"], gnss["height_m"], gnss["vel_d"]
    known = np.isfinite(height) & np.isfinite(down)
    t, height, down = t[known], height[known], down[known]
    if len(t) < 20:
        return
    step = np.diff(t)
    fallen = np.concatenate(([0.0], np.cumsum(step * (down[1:] + down[:-1]) / 2)))
    first, last = stretches(t, CHUNK_S, step > 2.0)
    climbed, rose = height[last] - height[first], fallen[first] - fallen[last]
    if len(rose) < 10 or np.sqrt(np.mean(rose**2)) < LEAST_CLIMB_M:
        return
    slope = float(climbed @ rose / (rose @ rose))
    alike = abs(float(climbed @ rose)) / max(float(np.linalg.norm(climbed) * np.linalg.norm(rose)), 1e-12)
    if alike < ALIKE:
        return
    if slope < -0.5:
        raise InputError(f"{where}: vel_d grows where the height does: it counts upwards; negate vel_d")
    if FEET[0] < slope < FEET[1]:
        raise InputError(
            f"{where}: heights change {slope:.2f} times as much as the vertical velocity says: look like feet; "
            "reader.gnss.position.height_unit=ft, or multiply height_m by 0.3048"
        )
