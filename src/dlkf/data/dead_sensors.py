"""IMUs of which an axis does not change, or which repeat their last sample, though the car moves; and tables of fixes
that have each of them several times."""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.motion import Motion, displacements, find_motion
from dlkf.data.limits import FROZEN_IMU_S, FROZEN_SPEED_M_S, known_speed
from dlkf.data.schema import ACCEL, GYRO, VELOCITY, stack_columns
from dlkf.data.tables import Columns

MOVING, TURNED, SPEED_CHANGE = 3.0, 1.0, 3.0  # m/s; rad and m/s over a drive that an axis at work must show
WAY_S = 5.0
NEAR_S = 2.0  # from a fix up to which its speed is that of the car, or two intervals of the receiver
NOISELESS = 0.2  # of the time in motion that samples repeat
LEAST_SAME = 10  # samples of an axis that is stuck
SOME_SAME, COARSE = 0.2, 0.01  # of FROZEN_IMU_S; of the time in motion that a coarse axis repeats so long
TIMES_USUAL = 10.0  # the longest repeat of an axis at work
BETWEEN = 20  # changes there are for each time that an axis sticks; of a coarse one fewer
OFTEN, STEP_M = 0.5, 2.0  # share of a moving car's fixes that repeat; m between two that no rounding makes the same
TURNING_BACK = 0.1  # of its changes: of noise every second one, of a smooth signal none


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
    """No sample, and no axis of one, that is the same to the bit for ``FROZEN_IMU_S`` while the car moves.

    Samples without noise, of a simulation, repeat for more than ``NOISELESS`` of the time in motion: they may. So may
    an axis that is coarse, repeating for a tenth of a second and more for ``COARSE`` of it or hardly ever changing, or
    without noise.
    """
    t, fixes = imu["t"], _find_speeds(gnss)
    changes = {name: np.diff(imu[name]) != 0 for name in (*GYRO, *ACCEL)}
    remedy = "leave these rows out and split the drive there (dlkf.ingest split_gaps=true)"
    begin, end = _find_repeats(t, np.logical_or.reduce([*changes.values()]))
    frozen = _moves(fixes, begin, end) & (end - begin > FROZEN_IMU_S)
    if frozen.any():
        way = _moves(fixes, t, t)
        if (end - begin)[frozen].sum() < NOISELESS * np.diff(t)[way[1:]].sum():
            span = f"t = {begin[frozen][0]:.3f} to {end[frozen][0]:.3f}"
            raise InputError(f"{where}: the same sample from {span} while the car moves: a frozen IMU; {remedy}")
    for name, changed in changes.items():
        begin, end = _find_repeats(t, changed)
        if (end - begin > FROZEN_IMU_S).any() and (stuck := _find_stuck(imu[name], t, begin, end, fixes)) is not None:
            first, last = stuck
            value = imu[name][np.searchsorted(t, first)]
            band = ", or small rates are read as 0 (switch such a dead band off)" if name in GYRO and value == 0 else ""
            raise InputError(
                f"{where}: {name} stays at {value:g} from t = {first:.3f} to {last:.3f} "
                f"while the car moves and other axes change: stuck or saturated{band}; {remedy}"
            )


def check_repeated_fixes(gnss: Columns, where: str) -> None:
    """No table in which most fixes of a moving car come again: a logger's that writes the last one at its own rate."""
    t, values = gnss["t"], np.nan_to_num(stack_columns(gnss, ("lat_deg", "lon_deg", "height_m", *VELOCITY)))
    first = np.flatnonzero(np.concatenate(([True], (np.diff(values, axis=0) != 0).any(1))))
    way = np.abs(displacements(gnss["lat_deg"][first], gnss["lon_deg"][first]))
    moves = (way > STEP_M) & (way > MOVING * np.diff(t[first]))
    again = np.diff(first)[moves] > 1
    if len(again) >= 3 and again.mean() > OFTEN:
        k = int(first[:-1][moves][again][0])
        raise InputError(
            f"{where}: {100 * again.mean():.0f} % of the fixes of the moving car come several times (the one at "
            f"t = {t[k]:.3f} again at {t[k + 1]:.3f}): keep the first row of each (dlkf.ingest gnss.rows=changed)"
        )


def _find_speeds(gnss: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Times and speeds [m/s]; of positions alone those of the way in ``WAY_S``, which their noise spoils less."""
    velocities = stack_columns(gnss, VELOCITY)
    if np.isfinite(velocities[:, :2]).any():
        return gnss["t"], known_speed(velocities)
    moved = find_motion(gnss)
    if len(moved.t) < 3:
        return gnss["t"], np.zeros(len(gnss["t"]))
    width = max(1, round(WAY_S / float(np.median(np.diff(moved.t)))))
    return moved.t, np.abs(np.convolve(moved.v, np.full(width, 1 / width), mode="same"))[: len(moved.t)]


def _find_repeats(t: np.ndarray, changed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times of the first and the last sample of each stretch without a change (n − 1,)."""
    edges = np.concatenate(([0], np.flatnonzero(changed) + 1, [len(t)]))
    return t[edges[:-1]], t[edges[1:] - 1]


def _moves(fixes: tuple[np.ndarray, np.ndarray], begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether the car moves at both times, by the fixes' times and speeds; not known, so no, far from any fix."""
    return _moves_at(fixes, begin) & _moves_at(fixes, end)


def _moves_at(fixes: tuple[np.ndarray, np.ndarray], t: np.ndarray) -> np.ndarray:
    """Whether the car moves at a time."""
    times, speeds = fixes
    if len(times) < 2:
        return np.zeros(len(t), bool)
    after = np.searchsorted(times, t).clip(1, len(times) - 1)
    away = np.minimum(np.abs(t - times[after - 1]), np.abs(t - times[after]))
    near = max(NEAR_S, 2 * float(np.median(np.diff(times))))
    return (np.interp(t, times, speeds) > FROZEN_SPEED_M_S) & (away < near)


def _find_stuck(
    x: np.ndarray, t: np.ndarray, begin: np.ndarray, end: np.ndarray, fixes: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float] | None:
    """The first of the repeats of an axis (n,) whose time in motion its other ones, and its noise, do not explain."""
    step = np.diff(t, prepend=t[0])
    way = np.cumsum(np.where(_moves(fixes, t, t), step, 0.0))
    length, usual_step = np.interp(end, t, way) - np.interp(begin, t, way), float(np.median(step))
    long, others = length > FROZEN_IMU_S, length[(length <= FROZEN_IMU_S) & _moves(fixes, begin, end)]
    coarse = float(others[others >= max(SOME_SAME * FROZEN_IMU_S, 2 * usual_step)].sum())
    least = max(FROZEN_IMU_S, LEAST_SAME * usual_step, TIMES_USUAL * float(others.max(initial=0.0)))
    stuck = np.flatnonzero(length > least)
    if not len(stuck) or coarse > COARSE * (way[-1] - length[long].sum()) or len(others) < BETWEEN * long.sum():
        return None
    d = np.diff(x)
    d = d[d != 0]
    noisy = len(d) > 2 and np.mean(d[1:] * d[:-1] < 0) > TURNING_BACK
    return (float(begin[stuck[0]]), float(end[stuck[0]])) if noisy else None
