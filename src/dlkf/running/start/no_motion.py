"""Why a drive shows no first motion, so that no filter can start."""

from __future__ import annotations

import math

import torch

from dlkf.data.alignment import AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.velocity_fit import MOTION_SIGMAS, NEEDED

SLOWEST_FIXES_S, SLOWEST_START_S, SLACK_S = 2.5, 10.0, 0.05  # between fixes, with intervals of a second, any; jitter
HIDDEN = 0.9  # share of the velocities of a moving car that are within ``MOTION_SIGMAS`` of none


def explain_no_motion(drive: Drive, config: AlignConfig) -> str:
    """What is wrong and how to mend it: fixes too far apart, velocities with too large a 1σ, or a car that is slow."""
    apart = torch.nonzero(drive.gnss_valid[:, :3].all(-1)).flatten().diff().double() * drive.epoch_s
    if len(apart) and (gap := float(apart.median())) > SLOWEST_FIXES_S * max(drive.epoch_s, 1.0):
        mend = f"set epoch_s={math.ceil(gap - SLACK_S)}" if gap <= SLOWEST_START_S else "leave the drive out"
        return f"fixes are {gap:g} s apart, a start needs {NEEDED}; {mend}"
    speed, std = drive.gnss_v_e.norm(dim=-1), drive.gnss_std[:, 3:5].amax(-1)
    fast = drive.gnss_valid[:, 3:].all(-1) & (speed > config.min_speed)
    if bool(fast.any()) and bool((speed < MOTION_SIGMAS * std)[fast].double().mean() > HIDDEN):
        return (
            f"velocities with a 1σ of {float(std[fast].median()):.3g} m/s do not show the course, so yaw is unknown; "
            "std_vel_* must be in m/s"
        )
    return (
        f"never moves faster than {config.min_speed:g} m/s for {config.window_s:g} s with GNSS, so yaw is unknown; "
        "lower align.min_speed or leave the drive out"
    )
