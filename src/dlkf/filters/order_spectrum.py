"""Spectrum of IMU samples over the distance covered, at the orders of a wheel, and what it says of the speed.

A wheel that is out of balance or not quite round shakes its car once a turn, and at multiples of that (orders; order
tracking, Brandt 2011). Over the distance s of a stretch such a line stands at o κ, with κ the wheel's turns per metre
and o the order, at any speed and through acceleration:

    Z_o(κ) = Σ_k w_k (x_k − x_{k−1}) exp(−2πi o κ s_k),    L_o(κ) = ln |Z_o|² less its mean over neighbouring κ

Where s comes from a speed that is wrong by a factor 1 + e, the lines stand at κ / (1 + e). Against noise alone,
exponential power of mean 1, a line of fading amplitude with mean power 1 + ρ has the likelihood ratio

    ln Λ(κ) = Σ_o [β Σ_axes (ρ/(1 + ρ) |Z_o|²/N − ln(1 + ρ))], each order's part limited

β < 1 because the axes show the same shaking, and limited because an engine's tone that crosses an order is no proof.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

ORDERS = (1, 2, 3)
COARSE, FINE, STEP, LEAST = 7, 8, 0.005, 0.36  # 1/m: passenger cars turn a wheel 0.41 to 0.57 times a metre
LINES = COARSE * FINE
NEIGHBOURS = 16  # lines to both sides, over which the level of the noise is taken
MEAN_LOG = 0.577  # of the logarithm of exponential power of mean 1, negative (Euler's constant)
LARGEST = 8.0  # power over that of the noise above which more says nothing
SHARE = 0.45  # β
LIMIT = 2.0  # of an order's part
NYQUIST = 0.45  # share of the sampling rate up to which an order is seen


def demodulate(x: Float[Tensor, "B M 6"], distance: Float[Tensor, "B M"]) -> Float[Tensor, "B 2 lines 6"]:
    """Σ_k x_k cos and sin of 2π o κ s_k for every order and line, the orders behind each other.

    Sines and cosines are taken of a coarse grid of lines and a fine one, and multiplied; those of the higher orders are
    powers.
    """
    coarse = LEAST + STEP * FINE * torch.arange(COARSE, dtype=x.dtype, device=x.device)
    fine = STEP * torch.arange(FINE, dtype=x.dtype, device=x.device)
    angle = 2 * math.pi * distance.unsqueeze(-1)
    a, b = angle * coarse, angle * fine
    ca, sa, cb, sb = a.cos().unsqueeze(-1), a.sin().unsqueeze(-1), b.cos().unsqueeze(-2), b.sin().unsqueeze(-2)
    c, s = (ca * cb - sa * sb).flatten(2), (sa * cb + ca * sb).flatten(2)
    cosines, sines = [c], [s]
    for _ in ORDERS[1:]:
        cosines.append(cosines[-1] * c - sines[-1] * s)
        sines.append(sines[-1] * c + cosines[-2] * s)
    return torch.stack([torch.bmm(torch.cat(of, -1).mT, x) for of in (cosines, sines)], 1)


def log_levels(spectrum: Float[Tensor, "B 2 lines 6"]) -> Float[Tensor, "B O K 6"]:
    """ln of the power of every order, line and axis over its neighbours'."""
    power = torch.log(spectrum.square().sum(1) + 1e-30).unflatten(1, (len(ORDERS), LINES))
    total = power.cumsum(2)
    last = total[:, :, -1:].expand(-1, -1, NEIGHBOURS, -1)
    above = torch.cat((total[:, :, NEIGHBOURS:], last), 2)
    below = torch.cat((torch.zeros_like(total[:, :, : NEIGHBOURS + 1]), total[:, :, : -NEIGHBOURS - 1]), 2)
    return power - (above - below) / _neighbours(power.dtype, power.device)


def log_likelihood(levels: Float[Tensor, "B O K 6"], excess: Float[Tensor, "B O 6"]) -> Float[Tensor, "B K"]:
    """ln Λ of every line, if the lines of this car stand out by ``excess`` (mean log level; 0: not at all)."""
    rho = torch.exp(excess.clamp(0, 3)) - 1
    power = torch.exp(levels - MEAN_LOG).clamp_max(LARGEST)
    of_order = SHARE * (power * (rho / (1 + rho)).unsqueeze(2) - torch.log1p(rho).unsqueeze(2)).sum(-1)
    return of_order.clamp(-LIMIT, LIMIT).sum(1)


def log_lines(like: Tensor) -> Float[Tensor, " K"]:
    """ln κ of the lines, of the type of ``like``."""
    return _log_lines(like.dtype, like.device)


@lru_cache
@torch.inference_mode(False)
def _log_lines(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " K"]:
    return torch.log(LEAST + STEP * torch.arange(LINES, dtype=dtype, device=device))


@lru_cache
@torch.inference_mode(False)
def _neighbours(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "K 1"]:
    """How many lines are near to each, itself among them."""
    k = torch.arange(LINES, device=device)
    return ((k[:, None] - k).abs() <= NEIGHBOURS).sum(1, keepdim=True).to(dtype)
