"""Spectrum of IMU samples over the distance covered, at the orders of a wheel, and what it says of the speed.

A wheel that is out of balance or not quite round shakes its car once a turn, and at multiples of that (orders; order
tracking, Brandt 2011). Over the distance s of a stretch such a line stands at o κ, with κ the wheel's turns per metre
and o the order, at any speed and through acceleration:

    Z_o(κ) = Σ_k w_k (x_k − x_{k−1}) exp(−2πi o κ s_k),    L_o(κ) = ln |Z_o|² less its mean over neighbouring κ

Where s comes from a speed that is wrong by a factor 1 + e, the lines stand at κ / (1 + e). Against noise alone,
exponential power of mean 1, a line of fading amplitude with mean power 1 + ρ has the likelihood ratio

    ln Λ(κ) = Σ_o [β Σ_axes (ρ/(1 + ρ) |Z_o|²/N − ln(1 + ρ))], each order's part limited

β < 1 because the axes show the same shaking, and limited because an engine's tone that crosses an order is no proof.

A wheel also keeps its phase: Z of a second, on the distance since some earlier time, has the phase that it had then.
With a template h, the mean of Z over the seconds before, the likelihood ratio against noise is

    ln Λ_h(κ) = Σ_o [β Σ_axes (2 Re Z h* − |h|²)/N], each order's part limited

Fixes show the distance, so such lines stand out long before their power does.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.pieces import summed

ORDERS = (1, 2, 3)
COARSE, FINE, STEP, LEAST = 7, 8, 0.005, 0.36  # 1/m: passenger cars turn a wheel 0.41 to 0.57 times a metre
LINES = COARSE * FINE
WAVES = 2 * len(ORDERS) * LINES  # cosines and sines
NEIGHBOURS = 16  # lines to both sides, over which the level of the noise is taken
MEAN_LOG = 0.577  # of the logarithm of exponential power of mean 1, negative (Euler's constant)
LARGEST = 8.0  # power over that of the noise above which more says nothing
SHARE, PHASE_SHARE = 0.45, 0.8  # β of power, and where the phase counts
LIMIT = 2.0  # of an order's part
LARGEST_AMPLITUDE = 2.0  # over that of the noise: a knock is no line
NYQUIST = 0.45  # share of the sampling rate up to which an order is seen


def demodulate(
    x: Float[Tensor, "B M 6"], distance: Float[Tensor, "B M"], begin: Float[Tensor, "B 6 waves"]
) -> Float[Tensor, "B 6 waves"]:
    """``begin`` + Σ_k x_k cos and sin of 2π o κ s_k for every order and line; waves are (2, O, K)."""
    return summed(add_waves, begin, x, distance)


def add_waves(
    begin: Float[Tensor, "B 6 waves"], x: Float[Tensor, "B m 6"], distance: Float[Tensor, "B m"]
) -> Float[Tensor, "B 6 waves"]:
    """:func:`demodulate` of some samples.

    Sines and cosines are taken of a coarse grid of lines and a fine one, and multiplied; those of the higher orders are
    powers.
    """
    return torch.baddbmm(begin, x.mT, _waves(distance))


def _waves(distance: Float[Tensor, "B m"]) -> Float[Tensor, "B m waves"]:
    """cos and sin of 2π o κ s."""
    angle = distance.unsqueeze(-1) * _grids(distance.dtype, distance.device)
    cosines, sines = angle.cos(), angle.sin()
    (ca, cb), (sa, sb) = (_crossed(of) for of in (cosines, sines))
    c, s = (ca * cb - sa * sb).flatten(2), (sa * cb + ca * sb).flatten(2)
    powers = [(c, s)]
    for _ in ORDERS[1:]:
        u, v = powers[-1]
        powers.append((u * c - v * s, v * c + u * s))
    return torch.cat([*(u for u, _ in powers), *(v for _, v in powers)], -1)


def rotated(spectrum: Float[Tensor, "B 6 waves"], distance: Float[Tensor, " B"]) -> Float[Tensor, "B 6 waves"]:
    """The spectrum with the distance counted from so many metres further on: Z exp(2πi o κ s), with Z = C − i S."""
    cosines, sines = _split(_waves(distance.unsqueeze(1)))
    C, S = _split(spectrum)
    return torch.cat((C * cosines + S * sines, S * cosines - C * sines), 2).flatten(2)


def _crossed(of: Float[Tensor, "B m grids"]) -> tuple[Float[Tensor, "B m coarse 1"], Float[Tensor, "B m 1 fine"]]:
    coarse, fine = of.split((COARSE, FINE), -1)
    return coarse.unsqueeze(-1), fine.unsqueeze(-2)


def log_levels(spectrum: Float[Tensor, "B 6 waves"]) -> Float[Tensor, "B 6 O K"]:
    """ln of the power of every axis, order and line over its neighbours'."""
    return _log_levels(_power(spectrum))


def relative(spectrum: Float[Tensor, "B 6 waves"]) -> Float[Tensor, "B 6 waves"]:
    """The spectrum in units of the noise's amplitude, which its neighbours show, limited."""
    power = _power(spectrum)
    amplitude = torch.exp(0.5 * (_log_levels(power) - MEAN_LOG)).clamp_max(LARGEST_AMPLITUDE)
    scale = (amplitude * power.rsqrt()).flatten(2)
    return spectrum * torch.cat((scale, scale), -1)


def _log_levels(power: Float[Tensor, "B 6 O K"]) -> Float[Tensor, "B 6 O K"]:
    """ln of a power over its neighbours'."""
    power = torch.log(power)
    return power - _over_neighbours(power)


def _split(waves: Float[Tensor, "B n waves"]) -> tuple[Tensor, Tensor]:
    """Cosines and sines (B, n, O K)."""
    cosines, sines = waves.unflatten(2, (2, -1)).unbind(2)
    return cosines, sines


def _power(spectrum: Float[Tensor, "B 6 waves"]) -> Float[Tensor, "B 6 O K"]:
    cosines, sines = _split(spectrum)
    return (cosines.square() + sines.square() + 1e-30).unflatten(2, (len(ORDERS), LINES))


def _over_neighbours(power: Float[Tensor, "B 6 O K"]) -> Float[Tensor, "B 6 O K"]:
    """Its mean over the neighbouring lines."""
    total = power.cumsum(-1)
    last = total[..., -1:].expand(-1, -1, -1, NEIGHBOURS)
    above = torch.cat((total[..., NEIGHBOURS:], last), -1)
    below = torch.cat((torch.zeros_like(total[..., : NEIGHBOURS + 1]), total[..., : -NEIGHBOURS - 1]), -1)
    return (above - below) / _neighbours(power.dtype, power.device)


def log_likelihood(levels: Float[Tensor, "B 6 O K"], excess: Float[Tensor, "B 6 O k"]) -> Float[Tensor, "B K"]:
    """ln Λ of every line, if the lines of this car stand out by ``excess`` (mean log level; 0: not at all), one for all
    lines or each its own."""
    rho = torch.exp(excess.clamp(0, 3)) - 1
    power = torch.exp(levels - MEAN_LOG).clamp_max(LARGEST)
    of_order = SHARE * (power * (rho / (1 + rho)) - torch.log1p(rho)).sum(1)
    return of_order.clamp(-LIMIT, LIMIT).sum(1)


def log_likelihood_of_phase(
    spectrum: Float[Tensor, "B 6 waves"], template: Float[Tensor, "B 6 waves"], seen: Float[Tensor, "B O"]
) -> Float[Tensor, "B K"]:
    """ln Λ_h of every line, of the orders that are ``seen``; both as :func:`relative` gives them, on one distance."""
    cosines, sines = _split((2 * spectrum - template) * template)
    of_order = PHASE_SHARE * (cosines + sines).sum(1).unflatten(1, (len(ORDERS), LINES))
    return (of_order * seen.unsqueeze(-1)).clamp(-LIMIT, LIMIT).sum(1)


def log_lines(like: Tensor) -> Float[Tensor, " K"]:
    """ln κ of the lines, of the type of ``like``."""
    return _log_lines(like.dtype, like.device)


@lru_cache
@torch.inference_mode(False)
def _log_lines(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " K"]:
    return torch.log(LEAST + STEP * torch.arange(LINES, dtype=dtype, device=device))


@lru_cache
@torch.inference_mode(False)
def _neighbours(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " K"]:
    """How many lines are near to each, itself among them."""
    k = torch.arange(LINES, device=device)
    return ((k[:, None] - k).abs() <= NEIGHBOURS).sum(1).to(dtype)


@lru_cache
@torch.inference_mode(False)
def _grids(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " grids"]:
    """2π κ [rad/m] of the coarse grid of lines and of the fine one, which are added."""
    coarse = LEAST + STEP * FINE * torch.arange(COARSE, dtype=dtype, device=device)
    return 2 * math.pi * torch.cat((coarse, STEP * torch.arange(FINE, dtype=dtype, device=device)))
