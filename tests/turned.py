"""Segments in turned tangent frames: what a filter estimates turns with them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.state import NavState


def turn_frames(batch: Batch, generator: torch.Generator | None = None) -> Batch:
    """Express each segment in a tangent frame turned about down by a random angle ψ: u ← Rz(ψ) u.

    Truth, GNSS, a measured heading and start turn together, and so do the frame's own axes and the Earth's rotation in
    them, so that the segment stays physically exact; its n is then no longer North-East, and a heading is the angle
    from its first axis. The stds take the diagonal of the turned covariance.
    """
    B = batch.size[0]
    psi = 2 * math.pi * torch.rand(B, generator=generator, dtype=torch.float64)
    zero = torch.zeros_like(psi)
    R64 = rotation_from_rpy(torch.stack((zero, zero, psi), -1))
    R = R64.to(batch.imu)

    def turn(u: Tensor) -> Tensor:
        return torch.einsum("bij,b...j->b...i", R.to(u), u)

    def turn_both(u: Tensor) -> Tensor:
        return torch.cat((turn(u[..., :3]), turn(u[..., 3:])), -1)

    def turn_stds(s: Tensor) -> Tensor:
        parts = [torch.einsum("bij,b...j->b...i", R.to(s) ** 2, x**2) for x in s.split(3, -1)]
        return torch.cat(parts, -1).sqrt()

    def turn_state(x: NavState) -> NavState:
        extra = (1,) * (x.p_n.ndim - 2)
        return NavState(turn(x.p_n), turn(x.v_n), R.to(x.C_nb).reshape(B, *extra, 3, 3) @ x.C_nb)

    frame = replace(
        batch.frame,
        C_en=batch.frame.C_en @ R64.mT,
        axis_n=turn(batch.frame.axis_n),
        earth_rate_n=turn(batch.frame.earth_rate_n),
    )
    # turned, a horizontal component is known only where both are
    horizontal = [v[..., :2].all(-1, keepdim=True).expand_as(v[..., :2]) for v in batch.gnss_valid.split(3, -1)]
    valid = torch.cat((horizontal[0], batch.gnss_valid[..., 2:3], horizontal[1], batch.gnss_valid[..., 5:]), -1)
    aids = dict(batch.aids)
    if (said := aids.get("heading")) is not None:
        measured = said[..., -1] > 0
        heading = torch.where(measured, said[..., 0] + psi.to(said)[:, None], said[..., 0])
        aids["heading"] = torch.cat((heading.unsqueeze(-1), said[..., 1:]), -1)
    return replace(
        batch,
        frame=frame,
        aids=aids,
        gnss=torch.where(valid, turn_both(batch.gnss), torch.zeros_like(batch.gnss)),
        gnss_std=turn_stds(batch.gnss_std),
        gnss_valid=valid,
        start=turn_state(batch.start),
        start_std=turn_stds(batch.start_std),
        truth=turn_state(batch.truth),
    )
