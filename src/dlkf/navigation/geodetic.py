"""Latitude, longitude and height of ECEF positions."""

from __future__ import annotations

import pymap3d
import torch
from jaxtyping import Float
from torch import Tensor


def geodetic_from_ecef(
    r_e: Float[Tensor, "*b 3"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Latitude, longitude [rad] and ellipsoidal height [m], float64 (You 2000, by pymap3d); NaN stays."""
    flat = r_e.detach().cpu().double().reshape(-1, 3)
    known = flat.isfinite().all(-1)
    out = torch.full_like(flat, torch.nan)
    if bool(known.any()):
        llh = pymap3d.ecef2geodetic(*flat[known].numpy().T, deg=False)
        out[known] = torch.stack([torch.as_tensor(x, dtype=torch.float64).reshape(-1) for x in llh], -1)
    lat, lon, height = out.reshape(r_e.shape).unbind(-1)
    return lat, lon, height
