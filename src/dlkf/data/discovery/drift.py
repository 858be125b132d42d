"""Two clocks that run at different rates: the pose once more on a stretched time, until nothing of a slope is left."""

from __future__ import annotations

from dataclasses import replace

from dlkf.data.discovery.motion import Floats, Motion
from dlkf.data.discovery.orientation import Pose, find_pose

WORTH_A_LOOK, CERTAIN = 1.5, 4.5  # σ; a lag that drifts blurs the fit, so the first look finds its σ too large
LEAST_S = 0.008  # from the middle of the drive to its ends: less does not matter
ROUNDS = 3


def find_drifting_pose(t: Floats, accel: Floats, gyro: Floats, gnss: Motion, lag_s: float) -> Pose | None:
    """:func:`find_pose`, its ``lag_s`` that of the drive's middle; ``drift`` is zero unless it is certain.

    The time of the IMU is then t + lag + drift (t − t̄), with t the time of GNSS and t̄ :func:`middle`.
    """
    first = find_pose(t, accel, gyro, gnss, lag_s)
    if first is None:
        return None
    reach = 0.5 * float(gnss.t[-1] - gnss.t[0])
    if not abs(first.drift) > max(WORTH_A_LOOK * first.drift_std, LEAST_S / reach):
        return replace(first, drift=0.0)
    drift, pose = first.drift, first
    for _ in range(ROUNDS):
        again = find_pose(t, accel, gyro, stretched(gnss, drift), pose.lag_s)
        if again is None:
            return replace(first, drift=0.0)
        pose, drift = again, drift + again.drift
        if abs(again.drift) < again.drift_std:
            break
    certain = abs(drift) > max(CERTAIN * pose.drift_std, LEAST_S / reach)
    if not certain or pose.explained < first.explained:
        return replace(first, drift=0.0)
    return replace(pose, drift=drift)


def middle(gnss: Motion) -> float:
    """The time about which a drift stretches."""
    return 0.5 * float(gnss.t[0] + gnss.t[-1])


def stretched(gnss: Motion, drift: float) -> Motion:
    """On a clock that runs faster by ``drift``; velocities stay."""
    return replace(gnss, t=gnss.t + drift * (gnss.t - middle(gnss)))
