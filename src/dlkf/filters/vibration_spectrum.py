"""Spectrum of IMU samples over the distance covered, and how likely it is at another speed.

What a car runs over and what turns with its wheels shakes it with a period in distance. The rear axle runs over the
road that the front axle has just left, so the pitch of a car lacks the spatial frequencies n/L of its wheelbase L
(wheelbase filtering; Gillespie, *Fundamentals of Vehicle Dynamics*, 1992), and a wheel that is out of balance adds a
line at its turns per metre. Over the distance s of a stretch with a window w, a spatial frequency F in cycles per metre
has

    Z(F) = Σ_k w_k (x_k − x_{k−1}) exp(−2πi F s_k),    y(F) = ln |Z(F)|² less a smooth trend in ln F

Where s comes from a speed v̂ of the true v = v̂ e^δ, what car and road show at F is found at F e^δ. With the mean A(F) of
earlier stretches and a variance of y of π²/6, that of the logarithm of exponential power,

    ln Λ(δ) = Σ_axes Σ_F [y(F) A(F e^−δ) − ½ A(F e^−δ)²] / (π²/6)

against a spectrum without a shape, for as many independent frequencies as the distance resolves. A block of the shape
has Σ Σ ½ A² / (π²/6) on average at the true δ.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dlkf.filters.pieces import summed

COARSE, FINE, STEP, LEAST = 16, 8, 0.016, 0.2  # cycles/m
LINES = COARSE * FINE
WAVES = 2 * LINES  # cosines and sines
SLOW_HZ, FAST_HZ = 1.5, 20.0  # between which a line is looked at: above the car's own motion, below the sensor's noise
SLOW_EDGE_HZ, FAST_EDGE_HZ = 0.2, 0.5
NYQUIST = 0.45  # share of the sampling rate up to which it is
COSINES = 4  # in ln F, of the trend
LOWEST, HIGHEST = -3.0, 2.5  # of y: a knock or a zero says no more
TONES, FIRST_HZ, TONE_HZ = 40, 1.0, 0.5  # frequencies in time: how many, the first, and their distance
SHIFTS, SHIFT = 16, 0.01  # δ to both sides, and its step
LOG_VARIANCE = math.pi**2 / 6  # of the logarithm of exponential power
APART = 1.5  # distance times the least difference of independent frequencies, for a sine as the window


def demodulate(
    x: Float[Tensor, "B M 6"], distance: Float[Tensor, "B M"], begin: Float[Tensor, "B 6 waves"]
) -> Float[Tensor, "B 6 waves"]:
    """``begin`` + Σ_k x_k cos and sin of 2π F s_k for every line; waves are (2, K)."""
    return summed(add_waves, begin, x, distance)


def add_waves(
    begin: Float[Tensor, "B 6 waves"], x: Float[Tensor, "B m 6"], distance: Float[Tensor, "B m"]
) -> Float[Tensor, "B 6 waves"]:
    """:func:`demodulate` of some samples; sines and cosines of a coarse grid of lines and of a fine one, multiplied."""
    angle = distance.unsqueeze(-1) * _grids(distance.dtype, distance.device)
    cosines, sines = angle.cos(), angle.sin()
    (ca, cb), (sa, sb) = (_crossed(of) for of in (cosines, sines))
    waves = torch.cat(((ca * cb - sa * sb).flatten(2), (sa * cb + ca * sb).flatten(2)), -1)
    return torch.baddbmm(begin, x.mT, waves)


def _crossed(of: Float[Tensor, "B m grids"]) -> tuple[Float[Tensor, "B m coarse 1"], Float[Tensor, "B m 1 fine"]]:
    coarse, fine = of.split((COARSE, FINE), -1)
    return coarse.unsqueeze(-1), fine.unsqueeze(-2)


def line_weights(speed: Float[Tensor, " B"], dt: float) -> Float[Tensor, "B K"]:
    """1 for the lines that lie between the limits in Hz at a speed [m/s], 0 outside, with soft edges."""
    f = lines(speed) * speed.unsqueeze(-1)
    fast = min(FAST_HZ, NYQUIST / dt)
    return torch.sigmoid((f - SLOW_HZ) / SLOW_EDGE_HZ) * torch.sigmoid((fast - f) / FAST_EDGE_HZ)


def shape(spectrum: Float[Tensor, "B 6 waves"], weight: Float[Tensor, "B K"]) -> Float[Tensor, "B 6 K"]:
    """y of every axis and line, with the trend by least squares under ``weight``."""
    cosines, sines = spectrum.unflatten(2, (2, LINES)).unbind(2)
    power = torch.log(cosines.square() + sines.square() + 1e-30)
    trends = _trends(power.dtype, power.device)
    weighted = trends * weight.unsqueeze(1)
    normal = weighted @ trends.mT + 1e-6 * torch.eye(COSINES, dtype=power.dtype, device=power.device)
    trend = torch.linalg.solve(normal, weighted @ power.mT).mT @ trends
    return (power - trend).clamp(LOWEST, HIGHEST)


def tone_shares(speed: Float[Tensor, " B"]) -> Float[Tensor, "B K N"]:
    """Linear interpolation from frequencies in time to the lines at a speed [m/s]."""
    f = lines(speed) * speed.unsqueeze(-1)
    tones = FIRST_HZ + TONE_HZ * torch.arange(TONES, dtype=speed.dtype, device=speed.device)
    return (1 - (f.unsqueeze(-1) - tones).abs() / TONE_HZ).clamp_min(0.0)


def log_likelihood(
    y: Float[Tensor, "B 6 K"], mean: Float[Tensor, "B 6 K"], weight: Float[Tensor, "B K"], distance: Float[Tensor, " B"]
) -> Float[Tensor, "B O"]:
    """ln Λ of every shift δ (:func:`shifts`)."""
    first, share = _places(y.dtype, y.device)
    near, far = mean[:, :, first], mean[:, :, first + 1]
    moved = near + share * (far - near)  # (B, 6, O, K)
    weight = weight[:, None, None]
    return _independent(distance) * (weight * moved * (y.unsqueeze(2) - 0.5 * moved)).sum((1, 3))


def expected_log_likelihood(
    mean: Float[Tensor, "B 6 K"], weight: Float[Tensor, "B K"], distance: Float[Tensor, " B"]
) -> Float[Tensor, "B 1"]:
    """ln Λ that a block of this shape has on average at the true δ."""
    return _independent(distance) * (0.5 * weight.unsqueeze(1) * mean.square()).sum((1, 2)).unsqueeze(-1)


def _independent(distance: Float[Tensor, " B"]) -> Float[Tensor, "B 1"]:
    """Share of the lines that are independent over a distance [m], over their variance."""
    return (STEP / APART * distance).clamp_max(1.0).unsqueeze(-1) / LOG_VARIANCE


def lines(like: Tensor) -> Float[Tensor, " K"]:
    """F of the lines [cycles/m], of the type of ``like``."""
    return _lines(like.dtype, like.device)


def shifts(like: Tensor) -> Float[Tensor, " O"]:
    """δ, of the type of ``like``."""
    return _shifts(like.dtype, like.device)


@lru_cache
@torch.inference_mode(False)
def _lines(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " K"]:
    return LEAST + STEP * torch.arange(LINES, dtype=dtype, device=device)


@lru_cache
@torch.inference_mode(False)
def _shifts(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " O"]:
    return SHIFT * torch.arange(-SHIFTS, SHIFTS + 1, dtype=dtype, device=device)


@lru_cache
@torch.inference_mode(False)
def _places(dtype: torch.dtype, device: torch.device) -> tuple[Int[Tensor, "O K"], Float[Tensor, "O K"]]:
    """Where F exp(−δ) lies: the line below, and the share of the one above."""
    moved = _lines(dtype, device) * torch.exp(-_shifts(dtype, device)).unsqueeze(-1)
    place = ((moved - LEAST) / STEP).clamp(0, LINES - 1.001)
    first = place.floor().long()
    return first, place - first


@lru_cache
@torch.inference_mode(False)
def _trends(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n K"]:
    log = torch.log(_lines(dtype, device))
    share = (log - log[0]) / (log[-1] - log[0])
    return torch.cos(math.pi * torch.arange(COSINES, dtype=dtype, device=device).unsqueeze(-1) * share)


@lru_cache
@torch.inference_mode(False)
def _grids(dtype: torch.dtype, device: torch.device) -> Float[Tensor, " grids"]:
    """2π F [rad/m] of the coarse grid of lines and of the fine one, which are added."""
    coarse = LEAST + STEP * FINE * torch.arange(COARSE, dtype=dtype, device=device)
    return 2 * math.pi * torch.cat((coarse, STEP * torch.arange(FINE, dtype=dtype, device=device)))
