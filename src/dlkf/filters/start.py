"""The start of a run on a drive without truth: first boundary at which IMU and GNSS give a whole state."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dlkf.data.alignment import ALIGN, AlignConfig, Start, align_boundaries
from dlkf.data.drive import Batch, Drive
from dlkf.data.geodetic import geodetic_from_ecef
from dlkf.data.segments import whole_drives
from dlkf.errors import InputError
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.state import NavState


def align(drive: Drive, config: AlignConfig = ALIGN, *, earliest: int = 0) -> Start:
    """Position, velocity and attitude at the first boundary ≥ ``earliest`` where the car moves under GNSS.

    Yaw from the course, roll and pitch by levelling (:mod:`dlkf.data.alignment`); the tangent origin is the
    IMU's position there. Reads no reference. Raises InputError naming the drive if there is no such boundary.
    """
    if not bool(drive.gnss_valid[:, :3].all(-1).any()):
        raise InputError(f"drive {drive.name}: no GNSS fix inside the IMU's time; a filter cannot start")
    aligned = align_boundaries(drive, config)
    candidates = torch.nonzero(aligned.ok[earliest : drive.epochs]).flatten()
    if not len(candidates):
        raise InputError(
            f"drive {drive.name}: never moves faster than {config.min_speed:g} m/s for {config.window_s:g} s "
            "with GNSS, so yaw is unknown; lower align.min_speed or leave the drive out"
        )
    k = int(candidates[0]) + earliest
    lat, lon, height = geodetic_from_ecef(aligned.r_e[k])
    C_ne = ned_axes(lat, lon).mT
    state = NavState(torch.zeros(3, dtype=torch.float64), C_ne @ aligned.v_e[k], C_ne @ aligned.C_eb[k])
    return Start(k, float(lat), float(lon), float(height), state, aligned.std[k])


def aligned_drives(
    drives: Sequence[Drive], config: AlignConfig = ALIGN, *, dtype: torch.dtype = torch.float64
) -> Batch:
    """Complete drives, each from its own :func:`align`, as one padded batch."""
    return whole_drives(drives, [align(drive, config) for drive in drives], dtype=dtype)
