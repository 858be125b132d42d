"""Spectrum of IMU samples over the distance covered, and how likely it is at another speed.

What a car runs over and what turns with its wheels shakes it with a period in distance. The rear axle runs over the
road that the front axle has just left, so the pitch of a car lacks the spatial frequencies n/L of its wheelbase L
(wheelbase filtering; Gillespie, *Fundamentals of Vehicle Dynamics*, 1992), and a wheel that is out of balance adds a
line at its turns per metre. Over the distance s of a stretch with a window w, a spatial frequency F in cycles per metre
has

    Z(F) = Σ_k w_k (x_k − x_{k−1}) exp(−2πi F s_k)

The power of an axis says where lines and notches are. The two axles shake several axes, pitch by what one meets more
than the other, heave by what both meet, so the phase between two axes depends on F L too, and not on how the road
happens to be. So y(F) has 18 parts of unit variance where nothing is known: of each axis

    (ln |Z|² less a smooth trend in ln F) / (π/√6)

with the variance π²/6 of the logarithm of exponential power, and √2 times cosine and sine of the phase between the axes
in the plane of symmetry of the car (forward, down, pitch), and of those across it (right, roll, yaw). Where s comes
from a speed v̂ of the true v = v̂ e^δ, what car and road show at F is found at F e^δ. With the mean A(F) of earlier
stretches

    ln Λ(δ) = Σ_parts Σ_F [y(F) A(F e^−δ) − ½ A(F e^−δ)²]

against a spectrum without a shape, for as many independent frequencies as the distance resolves. A block of the shape
has Σ Σ ½ A² on average at the true δ. The phases are bounded, so a loud tone counts there no more than a line.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from dlkf.filters.pieces import sum_pieces

FAR, NEAR, STEP, LEAST = 4, 16, 0.016, 0.2  # cycles/m; a line is a near frequency ± a far one
LINES = 2 * FAR * NEAR
WAVES = 2 * LINES  # products of a cosine or sine of each
SLOW_HZ, FAST_HZ = 1.5, 20.0  # between which a line is looked at: above the car's own motion, below the sensor's noise
SLOW_EDGE_HZ, FAST_EDGE_HZ = 0.2, 0.5
NYQUIST = 0.45  # share of the sampling rate up to which it is
COSINES = 4  # in ln F, of the trend
LOWEST, HIGHEST = -3.0, 2.5  # of ln |Z|² less its trend: a knock or a zero says no more
TONES, FIRST_HZ, TONE_HZ = 40, 1.0, 0.5  # frequencies in time: how many, the first, and their distance
SHIFTS, SHIFT = 16, 0.01  # δ to both sides, and its step
REACH = math.ceil((LINES + LEAST / STEP) * math.expm1(SHIFTS * SHIFT))  # lines between F and F e^−δ at most
LOG_STD = math.pi / 6**0.5  # of the logarithm of exponential power
PARTS = 18  # of y: power of six axes, cosine and sine of the phases of six pairs
APART = 1.5  # distance times the least difference of independent frequencies, for a sine as the window


def demodulate(
    x: Float[Tensor, "B M 6"], distance: Float[Tensor, "B M"], begin: Float[Tensor, "B 6 waves"]
) -> Float[Tensor, "B 6 waves"]:
    """``begin`` + Σ_k x_k of the products of cos and sin that :func:`components` makes the spectrum of."""
    return sum_pieces(add_waves, begin, x, distance)


def add_waves(
    begin: Float[Tensor, "B 6 waves"], x: Float[Tensor, "B m 6"], distance: Float[Tensor, "B m"]
) -> Float[Tensor, "B 6 waves"]:
    """:func:`demodulate` of some samples."""
    far, near = _grids(distance.dtype, distance.device)
    far, near = far.unsqueeze(-1) * distance.unsqueeze(1), distance.unsqueeze(-1) * near
    of_far = x.mT.unsqueeze(2) * torch.cat((far.cos(), far.sin()), 1).unsqueeze(1)
    of_near = torch.cat((near.cos(), near.sin()), -1)
    return torch.baddbmm(begin.view(len(x), -1, 2 * NEAR), of_far.flatten(1, 2), of_near).view(begin.shape)


def components(spectrum: Float[Tensor, "B 6 waves"]) -> tuple[Float[Tensor, "B 6 K"], Float[Tensor, "B 6 K"]]:
    """Σ_k x_k cos and Σ_k x_k sin of 2π F s_k for every line, by the sums of angles."""
    far_cos, far_sin = spectrum.unflatten(2, (2, FAR, 2, NEAR)).unbind(2)
    (cos_cos, cos_sin), (sin_cos, sin_sin) = far_cos.unbind(3), far_sin.unbind(3)  # of far, of near
    cosines = _sort_lines(cos_cos + sin_sin, cos_cos - sin_sin)
    return cosines, _sort_lines(cos_sin - sin_cos, cos_sin + sin_cos)


def _sort_lines(below: Float[Tensor, "B 6 far near"], above: Float[Tensor, "B 6 far near"]) -> Float[Tensor, "B 6 K"]:
    """Lines at near − far and near + far, in the order of their frequency."""
    return torch.cat((*reversed(below.unbind(2)), *above.unbind(2)), -1)


def line_weights(speed: Float[Tensor, " B"], dt: float) -> Float[Tensor, "B K"]:
    """1 for the lines that lie between the limits in Hz at a speed [m/s], 0 outside, with soft edges."""
    f = lines(speed) * speed.unsqueeze(-1)
    fast = min(FAST_HZ, NYQUIST / dt)
    return torch.sigmoid((f - SLOW_HZ) / SLOW_EDGE_HZ) * torch.sigmoid((fast - f) / FAST_EDGE_HZ)


def log_power(cosines: Float[Tensor, "B 6 K"], sines: Float[Tensor, "B 6 K"]) -> Float[Tensor, "B 6 K"]:
    """ln |Z(F)|² of every axis and line."""
    return torch.log(cosines.square() + sines.square() + 1e-30)


def remove_trend(power: Float[Tensor, "B 6 K"], weight: Float[Tensor, "B K"]) -> Float[Tensor, "B 6 K"]:
    """ln |Z|² of every axis and line without its trend, by least squares under ``weight``."""
    trends = _trends(power.dtype, power.device)
    weighted = trends * weight.unsqueeze(1)
    normal = weighted @ trends.mT + 1e-6 * torch.eye(COSINES, dtype=power.dtype, device=power.device)
    trend = torch.linalg.solve(normal, weighted @ power.mT).mT @ trends
    return (power - trend).clamp(LOWEST, HIGHEST)


def phases(cosines: Float[Tensor, "B 6 K"], sines: Float[Tensor, "B 6 K"]) -> Float[Tensor, "B 12 K"]:
    """Cosine and sine of the phase between the axes 0 and 2, 0 and 4, 2 and 4, and between 1 and 3, 1 and 5, 3 and 5,
    at every line: first the cosines, those of both triples in turn."""
    size = torch.rsqrt(cosines.square() + sines.square() + 1e-30)
    c, s = ((x * size).unflatten(1, (3, 2)) for x in (cosines, sines))  # axis of a triple, triple
    (ca, cb), (sa, sb) = ((torch.cat((x[:, :1], x[:, :2]), 1), torch.cat((x[:, 1:], x[:, 2:]), 1)) for x in (c, s))
    return torch.cat((ca * cb + sa * sb, ca * sb - sa * cb), 1).flatten(1, 2)


def describe_block(spectrum: Float[Tensor, "B 6 waves"], weight: Float[Tensor, "B K"]) -> Float[Tensor, "B 18 K"]:
    """y of a block."""
    cosines, sines = components(spectrum)
    power = remove_trend(log_power(cosines, sines), weight)
    return torch.cat((power / LOG_STD, 2**0.5 * phases(cosines, sines)), 1)


def tone_shares(speed: Float[Tensor, " B"]) -> Float[Tensor, "B K N"]:
    """Linear interpolation from frequencies in time to the lines at a speed [m/s]."""
    f = lines(speed) * speed.unsqueeze(-1)
    tones = FIRST_HZ + TONE_HZ * torch.arange(TONES, dtype=speed.dtype, device=speed.device)
    return (1 - (f.unsqueeze(-1) - tones).abs() / TONE_HZ).clamp_min(0.0)


def log_likelihood(
    y: Float[Tensor, "B 18 K"],
    mean: Float[Tensor, "B 18 K"],
    weight: Float[Tensor, "B K"],
    distance: Float[Tensor, " B"],
) -> Float[Tensor, "B O"]:
    """ln Λ of every shift δ (:func:`shifts`), from the products of y and A at all lines.

    Between lines A is linear, A(F e^−δ) = (1 − r) A_i + r A_{i+1}.
    """
    first, r = _places(y.dtype, y.device)
    around = pad(mean, (REACH, REACH)).unfold(-1, 2 * REACH + 1, 1)  # A of the lines beside each
    products = ((weight.unsqueeze(1) * y).unsqueeze(-1) * around).sum(1)  # Σ_parts w y(F) A(F′)
    squares, neighbours = mean.square().sum(1), (mean[..., :-1] * mean[..., 1:]).sum(1)
    line, s = torch.arange(LINES, device=y.device), 1 - r
    place = first - line + REACH
    fits = s * products[..., :-1][:, line, place] + r * products[..., 1:][:, line, place]
    sizes = s * (s * squares[:, :-1][:, first] + 2 * (r * neighbours[:, first]))
    sizes = sizes + r * (r * squares[:, 1:][:, first])
    return _independent_share(distance) * (fits - 0.5 * weight.unsqueeze(1) * sizes).sum(-1)


def expected_log_likelihood(
    mean: Float[Tensor, "B 18 K"], weight: Float[Tensor, "B K"], distance: Float[Tensor, " B"]
) -> Float[Tensor, "B 1"]:
    """ln Λ that a block of this shape has on average at the true δ."""
    return _independent_share(distance) * (0.5 * weight.unsqueeze(1) * mean.square()).sum((1, 2)).unsqueeze(-1)


def _independent_share(distance: Float[Tensor, " B"]) -> Float[Tensor, "B 1"]:
    """Share of the lines that are independent over a distance [m]."""
    return (STEP / APART * distance).clamp_max(1.0).unsqueeze(-1)


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
def _grids(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, " far"], Float[Tensor, " near"]]:
    """2π F [rad/m] of the far frequencies and of the near ones."""
    far = STEP * NEAR * (torch.arange(FAR, dtype=dtype, device=device) + 0.5)
    near = LEAST + STEP * (NEAR * (FAR - 0.5) + torch.arange(NEAR, dtype=dtype, device=device))
    return 2 * math.pi * far, 2 * math.pi * near
