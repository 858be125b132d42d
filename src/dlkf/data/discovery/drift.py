"""Two clocks that run at different rates: the pose once more on a stretched time, until nothing of a slope is left."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dlkf.data.discovery.clock import ImuSums, compute_misfits, find_lag
from dlkf.data.discovery.motion import Floats, Motion
from dlkf.data.discovery.orientation import Pose, find_pose

WORTH_A_LOOK, DOUBTFUL, CERTAIN = 1.5, 2.0, 4.5  # σ; a drift blurs the fit, so the first look's σ is too large
LEAST_S = 0.008  # from the middle of the drive to its ends: less does not matter
LEAST_STEP_S, STEPS = 0.25, 0.9  # of a clock; of the misfit with a drift or one lag, that of a step is less
LAGS = 7  # from that of the one end to that of the other
WORSE = 1.0  # misfit of a turn, or of an acceleration, at a wrong lag; straight roads have none
ROUNDS = 6
FEWEST = 60  # fixes of a drive whose ends are compared
SEARCH_S = 30.0  # as far may the ends be from each other
ROUGH_S = 0.05  # what comparing the ends is good to
CRYSTALS = 30e-6  # 1σ by which two clocks drift apart that keep 35 ppm each: of a drive that shows no drift


class Ends(NamedTuple):
    """The lags of the first and the last third of a drive, and the drift between their middles."""

    first_s: float
    last_s: float
    drift: float


def compare_ends(imu: ImuSums, gnss: Motion) -> Ends | None:
    """The drift by :func:`~dlkf.data.discovery.clock.find_lag` of both ends; None where one of them is not clear."""
    if len(gnss.t) < FEWEST:
        return None
    edges = gnss.t[0] + (gnss.t[-1] - gnss.t[0]) * np.array([1 / 3, 2 / 3])
    seen = []
    for part in (gnss.t <= edges[0], gnss.t >= edges[1]):
        some = replace(gnss, t=gnss.t[part], v=gnss.v[part], climb=gnss.climb[part])
        lag = find_lag(imu.between(some.t[0] - SEARCH_S, some.t[-1] + SEARCH_S), some, SEARCH_S)
        if lag is None or not lag.certain:
            return None
        seen.append((float(some.t.mean()), lag.peak_s))
    (begin, first), (end, last) = seen
    return Ends(first, last, (last - first) / (end - begin))


def find_step(imu: ImuSums, gnss: Motion, ends: Ends) -> tuple[float, float] | None:
    """Between which times a clock steps from the lag of one end to that of the other: where the car turns, brakes and
    accelerates before and after it. None where a drift or one lag explains the motion as well, or the step is small."""
    if abs(ends.last_s - ends.first_s) < LEAST_STEP_S:
        return None
    begin = float(gnss.t[gnss.t <= gnss.t[0] + (gnss.t[-1] - gnss.t[0]) / 3].mean())
    at, drifting = compute_misfits(imu, gnss, lambda t: ends.first_s + ends.drift * (t - begin))
    rivals = [drifting.sum()]
    for lag in np.linspace(ends.first_s, ends.last_s, LAGS):
        rivals.append(compute_misfits(imu, gnss, lambda t, lag=lag: 0 * t + lag)[1].sum())
    before = compute_misfits(imu, gnss, lambda t: 0 * t + ends.first_s)[1]
    after = compute_misfits(imu, gnss, lambda t: 0 * t + ends.last_s)[1]
    until = np.concatenate(([0.0], np.cumsum(before))) + np.concatenate((np.cumsum(after[::-1])[::-1], [0.0]))
    if until.min() > STEPS * min(rivals):
        return None
    near = np.flatnonzero(until < until.min() + WORSE)
    return float(at[max(near[0] - 1, 0)]), float(at[min(near[-1], len(at) - 1)])


def find_drifting_pose(t: Floats, accel: Floats, gyro: Floats, gnss: Motion, lag_s: float) -> Pose | None:
    """:func:`find_pose`, its ``lag_s`` that of the drive's middle; ``drift`` is zero unless it is certain, ``doubt``
    what it may be instead.

    The time of the IMU is then t + lag + drift (t − t̄), with t the time of GNSS and t̄ :func:`middle`.
    """
    first = find_pose(t, accel, gyro, gnss, lag_s)
    if first is None:
        return None
    reach = 0.5 * float(gnss.t[-1] - gnss.t[0])
    starts = []
    if abs(first.drift) > max(WORTH_A_LOOK * first.drift_std, LEAST_S / reach):
        starts.append((first.drift, first.lag_s))
    ends = compare_ends(ImuSums.of(t - lag_s, accel, gyro), gnss)
    if ends is not None and abs(ends.drift) * reach > ROUGH_S:  # so far that the fit may see nothing of it
        starts.append((ends.drift, lag_s + 0.5 * (ends.first_s + ends.last_s)))
    found = [_settle_drift(t, accel, gyro, gnss, drift, lag) for drift, lag in starts]
    best = max((pose for pose in found if pose is not None), key=lambda pose: pose.explained, default=None)
    if best is None or best.explained < first.explained:
        return replace(first, drift=0.0)
    if abs(best.drift) > max(CERTAIN * best.drift_std, LEAST_S / reach):
        return best
    return replace(first, drift=0.0, doubt=best.drift if abs(best.drift) > DOUBTFUL * best.drift_std else 0.0)


def _settle_drift(t: Floats, accel: Floats, gyro: Floats, gnss: Motion, drift: float, lag_s: float) -> Pose | None:
    """The pose on a clock that runs faster by ``drift``, and what is left of that taken off, until it is little."""
    pose = None
    for _ in range(ROUNDS):
        stretched = replace(gnss, t=gnss.t + drift * (gnss.t - middle(gnss)))
        pose = find_pose(t, accel, gyro, stretched, lag_s)
        if pose is None:
            return None
        left, drift, lag_s = pose.drift, drift + pose.drift, pose.lag_s
        if abs(left) < pose.drift_std:
            break
    return None if pose is None else replace(pose, drift=drift)


def ends_std(pose: Pose, reach_s: float) -> float:
    """1σ of the lag ``reach_s`` from the drive's middle, where what is not known of the drift has grown."""
    drift_std = pose.drift_std if pose.drift else float(np.fmin(pose.drift_std, CRYSTALS))
    return float(np.hypot(pose.lag_std, drift_std * reach_s))


def middle(gnss: Motion) -> float:
    """The time about which a drift stretches."""
    return 0.5 * float(gnss.t[0] + gnss.t[-1])
