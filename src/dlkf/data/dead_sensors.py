"""IMUs of which an axis never changes, or which repeat their last sample, though the car moves."""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.motion import Motion
from dlkf.data.limits import FROZEN_IMU_S, FROZEN_SPEED_M_S, known_speed
from dlkf.data.schema import ACCEL, GYRO, VELOCITY, stack_columns
from dlkf.data.tables import Columns

MOVING, TURNED, SPEED_CHANGE = 3.0, 1.0, 3.0  # m/s; rad and m/s over a drive that an axis at work must show
NOISELESS = 0.2  # of the time in motion that samples repeat


def check_dead_axes(imu: Columns, moved: Motion, where: str, frd: bool = True) -> None:
    """An axis that never changes although the car turns, brakes and accelerates.

    In the sensor's own axes (``frd=False``) the one that gravity lies on is down, and two are level.
    """
    fast = moved.speed > MOVING
    if fast.sum() < 3:
        return
    both = fast[1:] & fast[:-1]
    turns = np.abs(wrap_angle(np.diff(moved.course)))[both].sum() > TURNED
    brakes = np.ptp(moved.speed[fast]) > SPEED_CHANGE
    needs = [("gyro_z", turns, "turns"), ("accel_x", brakes, "brakes"), ("accel_y", turns, "turns")]
    if not frd:
        down = int(np.argmax([abs(float(np.median(imu[c]))) for c in ACCEL]))
        level = [name for k, name in enumerate(ACCEL) if k != down]
        needs = [(GYRO[down], turns, "turns"), *((name, turns and brakes, "turns and brakes") for name in level)]
    for name, shown, what in needs:
        if shown and np.ptp(imu[name]) == 0:
            raise InputError(
                f"{where}: {name} is {imu[name][0]:g} in every row though the car {what}: a dead axis, or no data of it"
            )


def check_frozen(imu: Columns, gnss: Columns, where: str) -> None:
    """No sample that is the same to the bit for ``FROZEN_IMU_S`` while the car moves.

    Samples without noise, of a simulation, repeat for more than ``NOISELESS`` of the time in motion: they may.
    """
    t, speed = imu["t"], known_speed(stack_columns(gnss, VELOCITY))
    changes = np.zeros(len(t) - 1, bool)
    for column in (*GYRO, *ACCEL):
        changes |= np.diff(imu[column]) != 0
    edges = np.concatenate(([0], np.flatnonzero(changes) + 1, [len(t)]))
    begin, end = t[edges[:-1]], t[edges[1:] - 1]
    moves = np.minimum(*(np.interp(x, gnss["t"], speed) for x in (begin, end))) > FROZEN_SPEED_M_S
    frozen, way = moves & (end - begin > FROZEN_IMU_S), np.interp(t, gnss["t"], speed) > FROZEN_SPEED_M_S
    if frozen.any() and (end - begin)[frozen].sum() < NOISELESS * np.diff(t)[way[1:]].sum():
        first, last = begin[frozen][0], end[frozen][0]
        raise InputError(
            f"{where}: the same sample from t = {first:.3f} to {last:.3f} while the car moves: a frozen IMU; leave "
            "these rows out and split the drive there (dlkf.ingest split_gaps=true)"
        )
