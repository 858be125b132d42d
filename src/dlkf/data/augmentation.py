"""Augmentation of training pieces: turned frames and fresh IMU biases (paper.md 4.7, 4.9)."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.state import NavState


def turn_frames(batch: Batch, generator: torch.Generator | None = None) -> Batch:
    """Express each piece in a tangent frame turned about down by a random angle ψ: u ← Rz(ψ) u.

    Truth, GNSS and start turn together, and so do the frame's own axes and the Earth's rotation in them, so
    that the piece stays physically exact; its n is then no longer North-East. The stds take the diagonal of
    the turned covariance.
    """
    B = batch.size[0]
    psi = 2 * math.pi * torch.rand(B, generator=generator, dtype=torch.float64)
    zero = torch.zeros_like(psi)
    R64 = rotation_from_rpy(torch.stack((zero, zero, psi), -1))
    R = R64.to(batch.imu)

    def turned(u: Tensor) -> Tensor:
        return torch.einsum("bij,b...j->b...i", R.to(u), u)

    def both(u: Tensor) -> Tensor:
        return torch.cat((turned(u[..., :3]), turned(u[..., 3:])), -1)

    def stds(s: Tensor) -> Tensor:
        parts = [torch.einsum("bij,b...j->b...i", R.to(s) ** 2, x**2) for x in s.split(3, -1)]
        return torch.cat(parts, -1).sqrt()

    def state(x: NavState) -> NavState:
        extra = (1,) * (x.p_n.ndim - 2)
        return NavState(turned(x.p_n), turned(x.v_n), R.to(x.C_nb).reshape(B, *extra, 3, 3) @ x.C_nb)

    frame = replace(
        batch.frame,
        C_en=batch.frame.C_en @ R64.mT,
        axis_n=turned(batch.frame.axis_n),
        earth_rate_n=turned(batch.frame.earth_rate_n),
    )
    # turned, a horizontal component is known only where both are
    horizontal = [
        v[..., :2].all(-1, keepdim=True).expand_as(v[..., :2]) for v in batch.gnss_valid.split(3, -1)
    ]
    valid = torch.cat(
        (horizontal[0], batch.gnss_valid[..., 2:3], horizontal[1], batch.gnss_valid[..., 5:]), -1
    )
    return replace(
        batch,
        frame=frame,
        gnss=torch.where(valid, both(batch.gnss), torch.zeros_like(batch.gnss)),
        gnss_std=stds(batch.gnss_std),
        gnss_valid=valid,
        start=state(batch.start),
        start_std=stds(batch.start_std),
        truth=state(batch.truth),
    )


def inject_bias(
    batch: Batch, accel_mps2: float, gyro_dps: float, generator: torch.Generator | None = None
) -> Batch:
    """Add to each piece's raw IMU a fresh constant drawn from N(0, σ²) per axis, and to its known IMU error.

    σ is ``accel_mps2`` [m/s²] and ``gyro_dps`` [°/s]. Where the true error is unknown it stays NaN.
    """
    sigma = torch.tensor([accel_mps2] * 3 + [math.radians(gyro_dps)] * 3, dtype=torch.float64)
    drawn = sigma * torch.randn(batch.size[0], 6, generator=generator, dtype=torch.float64)
    bias = drawn.to(batch.imu)
    imu = torch.where(batch.present[..., None, None], batch.imu + bias[:, None, None], batch.imu)
    return replace(batch, imu=imu, true_imu_error=batch.true_imu_error + bias[:, None])
