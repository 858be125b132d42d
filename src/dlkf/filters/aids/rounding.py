"""A measurement that is rounded to whole steps: not a value with noise but an interval that the value lies in.

With the prediction s ~ N(ŝ, S), S = H P Hᵀ, noise of variance τ² before the rounding and the interval [a, b],

    ln Z = ln (Φ(β) − Φ(α)),   α = (a − ŝ) / √(S + τ²),   β = (b − ŝ) / √(S + τ²)
    g = ∂ ln Z / ∂ŝ,   h = −∂² ln Z / ∂ŝ²,   mean ŝ + S g,   variance S − S² h

are the moments of s under that it lies there (Curry 1970, "Estimation and control with quantized measurements"; Duan,
Jilkov & Li, Fusion 2008). A Kalman update with innovation g / h and variance 1/h − S has the same: it says next to
nothing while the prediction lies well inside, and most when the whole number changes.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

WIDE = 4.0  # √(S + τ²) in halves of the interval, above which rounding is noise of (b − a)² / 12
LEAST = 1e-6  # of h (S + τ²): a prediction in the middle, to which the interval says nothing
FAR = 5.0  # 1σ outside of the interval from which on it is as that far


def rounded_measurement(
    z: Float[Tensor, " B"], half: float, S: Float[Tensor, " B"], noise: Float[Tensor, " B"]
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Innovation and variance R that stand for an interval of ``half`` to both sides of a reported value.

    ``z`` is the reported value less the prediction, ``S`` the prediction's variance, ``noise`` τ².
    """
    total = S + noise
    root = total.sqrt()
    near = torch.minimum(torch.maximum(z, -half - FAR * root), half + FAR * root)
    alpha, beta = (near - half) / root, (near + half) / root
    Z = (_phi_below(beta) - _phi_below(alpha)).clamp_min(1e-12)
    low, high = _density(alpha), _density(beta)
    g = (low - high) / (Z * root)
    h = g.square() - (alpha * low - beta * high) / (Z * total)
    h = torch.minimum(torch.maximum(h, LEAST / total), 1 / total)
    wide = root > WIDE * half
    innovation = torch.where(wide, z, g / h + (z - near))
    return innovation, torch.where(wide, noise + half * half / 3, 1 / h - S)


def _phi_below(x: Tensor) -> Tensor:
    """Φ(x) of the standard normal distribution."""
    return 0.5 * (1 + torch.erf(x / math.sqrt(2)))


def _density(x: Tensor) -> Tensor:
    """Its density φ(x)."""
    return torch.exp(-0.5 * x * x) / math.sqrt(2 * math.pi)
