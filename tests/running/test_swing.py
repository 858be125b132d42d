"""The lever arm's swing ω × l at a start, in a car that rocks in yaw: it is that of the fix's own time."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dlkf.data.alignment import AlignConfig, align_boundaries
from dlkf.data.drive import Drive
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.running.start import align

ROCKING = 0.3  # rad/s at every boundary, and once a second: 2.7° to either side between them, none on them
ARM = torch.tensor([2.0, -0.5, -1.5], dtype=torch.float64)
# The mean over 0.1 or 0.2 s misses 6 or 24 % of 0.3 rad/s · 2 m, 0.04 or 0.15 m/s; one over 0.4 s 77 %, 0.46 m/s
WORST = 0.2  # m/s


@pytest.fixture(scope="module")
def drive(town) -> Drive:
    """The exact car, rocking, with an antenna on a lever arm."""
    still = load_dataset(town, dtype=torch.float64)[0]
    N, M = still.imu.shape[:2]
    share = torch.arange(M + 1, dtype=torch.float64) / M
    angle = ROCKING / (2 * math.pi) * torch.sin(2 * math.pi * share)  # of the body to the right, since the boundary
    turned = torch.zeros(M, 3, dtype=torch.float64)
    turned[:, 2] = -(angle[1:] + angle[:-1]) / 2
    imu = still.imu.clone()
    imu[..., :3] = (rotation_from_rpy(turned) @ imu[..., :3, None]).squeeze(-1)
    imu[..., 5] += angle.diff() * still.rate_hz
    rate = torch.cat((still.imu[:1, 0, 3:], still.imu[:, -1, 3:]))
    rate[:, 2] += ROCKING
    swing = torch.linalg.cross(rate, ARM.expand(N + 1, 3))
    return replace(
        still,
        imu=imu,
        gnss_r_e=still.gnss_r_e + still.ref_C_eb @ ARM,
        gnss_v_e=still.gnss_v_e + (still.ref_C_eb @ swing.unsqueeze(-1)).squeeze(-1),
        lever_arm_b=ARM,
    )


def test_at_every_boundary(drive: Drive) -> None:
    aligned = align_boundaries(drive)
    assert int(aligned.ok.sum()) > 50
    assert (aligned.v_e - drive.ref_v_e)[aligned.ok].norm(dim=-1).max() < WORST


def test_where_the_heading_was_carried_back_to_the_first_fix(drive: Drive) -> None:
    start = align(drive, AlignConfig(from_rest=True))
    assert start.first == 0
    C_en = ned_axes(*geodetic_from_ecef(drive.ref_r_e[0])[:2])
    assert (C_en @ start.state.v_n - drive.ref_v_e[0]).norm() < WORST
