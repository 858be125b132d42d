"""The gyroscope against the turns of the course: a mirrored axis, another unit, the scale of another range.

The course is that of the velocities; of positions alone it is the direction of the way over some seconds.
"""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.motion import LONGEST_STEP_S, displacements, stretches
from dlkf.data.tables import Columns

LEAST_SLOPE = 0.1  # of gyro_z against the course; one that is at its limit in every turn may have 0.3
SAME_TURNS, OTHER_SCALE = 0.97, 1.4  # correlation of turns; their ratio, beyond which it is no error of a sensor
TURN_S, TURN_M = 4.0, 8.0  # stretches of positions alone that have a direction


def check_turns(imu: Columns, fixes: Columns, where: str) -> None:
    """Integrated gyro_z against the change of course between usable fixes, where the drive turns enough."""
    angle = np.concatenate(([0.0], np.cumsum(imu["gyro_z"][1:] * np.diff(imu["t"]))))
    by_velocities = np.isfinite(fixes["vel_n"]).mean() > 0.2
    turned, gyro = (_turns_of_velocities if by_velocities else _turns_of_positions)(imu["t"], angle, fixes)
    clear = np.abs(turned) > (0.1 if by_velocities else 0.2)
    turned, gyro = turned[clear], gyro[clear]
    if len(turned) < 3 or np.abs(turned).sum() < 1.0 or np.ptp(imu["gyro_z"]) == 0:
        return
    slope = float(turned @ gyro / (turned @ turned))
    alike = abs(float(turned @ gyro)) / float(np.linalg.norm(turned) * np.linalg.norm(gyro))
    if alike < 0.9:
        return
    if slope > 20:
        raise InputError(
            f"{where}: gyro_z is {slope:.0f} times the turn of the course: looks like degrees; use rad/s "
            "(reader.imu.gyro.unit=deg/s)"
        )
    if not LEAST_SLOPE < abs(slope) < 1 / LEAST_SLOPE:
        raise InputError(
            f"{where}: gyro_z is {slope:.3g} times the turn of the course: not in rad/s, or of another axis; "
            "reader.imu.gyro.unit=auto finds its unit"
        )
    if slope < 0:
        mirrored = "" if by_velocities else "; or latitude and longitude are exchanged, or one has the wrong sign"
        raise InputError(
            f"{where}: gyro_z turns against the course (slope {slope:.2f}): z must point down; negate y and z{mirrored}"
        )
    small = np.abs(turned) <= np.median(np.abs(turned))  # right even if sharp ones are beyond its limit
    scales = slope, float(np.median(gyro[small] / turned[small]))
    if alike > SAME_TURNS and not any(1 / OTHER_SCALE < scale < OTHER_SCALE for scale in scales):
        raise InputError(
            f"{where}: gyro_z is {slope:.2f} times the turn of the course: the scale of another range of the sensor? "
            f"multiply gyro by {1 / slope:.3g}, or use its data sheet's scale"
        )


def _turns_of_velocities(t_imu: np.ndarray, angle: np.ndarray, gnss: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Turns [rad] of the course from fix to fix, and of the gyroscope."""
    t, course = gnss["t"], np.arctan2(gnss["vel_e"], gnss["vel_n"])
    speed = np.hypot(gnss["vel_n"], gnss["vel_e"])
    with np.errstate(invalid="ignore"):
        use = (np.diff(t) <= 1.5) & (speed[1:] > 3) & (speed[:-1] > 3)
        use &= (t[1:] <= t_imu[-1]) & (t[:-1] >= t_imu[0])
    return wrap_angle(np.diff(course))[use], np.diff(np.interp(t, t_imu, angle))[use]


def _turns_of_positions(t_imu: np.ndarray, angle: np.ndarray, gnss: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Turns [rad] from the way of one stretch to that of the next, and of the gyroscope's mean angles over them."""
    t = gnss["t"]
    place = np.concatenate(([0.0], np.cumsum(displacements(gnss["lat_deg"], gnss["lon_deg"]))))
    first, last = stretches(t, TURN_S, np.diff(t) > LONGEST_STEP_S)
    end = np.full(len(t), -1)
    end[first] = last
    inside = (end >= 0) & (t >= t_imu[0]) & (t[end] <= t_imu[-1])
    chosen, row = [], 0
    while row < len(t):  # end to end
        chosen += [row] if inside[row] and inside[end[row]] else []
        row = end[row] if inside[row] else row + 1
    a = np.array(chosen, int)
    b, c = end[a], end[end[a]]
    way, after = place[b] - place[a], place[c] - place[b]
    far = np.minimum(np.abs(way), np.abs(after)) > TURN_M
    total = np.concatenate(([0.0], np.cumsum(0.5 * (angle[1:] + angle[:-1]) * np.diff(t_imu))))
    upto = np.interp(t, t_imu, total)
    gyro = (upto[c] - upto[b]) / (t[c] - t[b]) - (upto[b] - upto[a]) / (t[b] - t[a])
    return np.angle(after[far] * way[far].conj()), gyro[far]
