"""Latitude, longitude and height of ECEF positions."""

from __future__ import annotations

import pymap3d
import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.compiled import is_recorded
from dlkf.navigation.earth import ECCENTRICITY_SQ, SEMI_MAJOR, SEMI_MINOR


def geodetic_from_ecef(
    r_e: Float[Tensor, "*b 3"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Latitude, longitude [rad] and ellipsoidal height [m], float64 (You 2000, by pymap3d); NaN stays."""
    if is_recorded():
        return _bowring(r_e)
    flat = r_e.detach().cpu().double().reshape(-1, 3)
    known = flat.isfinite().all(-1)
    out = torch.full_like(flat, torch.nan)
    if bool(known.any()):
        llh = pymap3d.ecef2geodetic(*flat[known].numpy().T, deg=False)
        out[known] = torch.stack([torch.as_tensor(x, dtype=torch.float64).reshape(-1) for x in llh], -1)
    lat, lon, height = out.reshape(r_e.shape).unbind(-1)
    return lat, lon, height


def _bowring(r_e: Float[Tensor, "*b 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """The same in tensor operations for an exported filter: Bowring 1976, twice, which is exact to rounding."""
    x, y, z = r_e.unbind(-1)
    level = torch.hypot(x, y)
    sine, cosine = SEMI_MAJOR * z, SEMI_MINOR * level  # of the reduced latitude, times its size
    lat = torch.zeros_like(z)
    for _ in range(2):
        reduced = torch.atan2(sine, cosine)
        north = z + ECCENTRICITY_SQ / (1 - ECCENTRICITY_SQ) * SEMI_MINOR * torch.sin(reduced) ** 3
        lat = torch.atan2(north, level - ECCENTRICITY_SQ * SEMI_MAJOR * torch.cos(reduced) ** 3)
        sine, cosine = SEMI_MINOR * torch.sin(lat), SEMI_MAJOR * torch.cos(lat)
    bend = SEMI_MAJOR * torch.sqrt(1 - ECCENTRICITY_SQ * torch.sin(lat) ** 2)
    return lat, torch.atan2(y, x), level * torch.cos(lat) + z * torch.sin(lat) - bend
