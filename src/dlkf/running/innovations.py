"""Innovations of a drive and whether the filter's own 1σ fits them, by closed form.

Of update k with m components seen, s_k = Σ (z/σ)² / m: of a filter whose σ is right E s = 1. n updates count as fewer
where they are correlated in time (ρ_j of s at lag j, up to the first that is not positive; Geyer 1992, initial positive
sequence), and components as fewer where they go together or have heavy tails (Satterthwaite 1946):

    n_eff = n / (1 + 2 Σ_j (1 − j/n) ρ_j),     ν = n_eff · min(m, 2 s̄²/var s),     ν s̄ ~ χ²_ν

So r = √s̄ lies within √(χ²_ν(α/2)/ν) … √(χ²_ν(1 − α/2)/ν) in all but α of the cases. Innovations of a filter that is
right are white: of 60,000 such drives of 20 to 300 updates none got the warning, and at α = 2 % 0.6 to 0.8 % were above
the bound (1 % by the equation). In short drives with correlated ones, an AR(1) of 0.95, n_eff is too large: of 10,000
with 30 updates 2 got the warning, with the tails of Student's t₄ 16; with 60 updates none and 2.
Filters of 15 and 21 states get it with the preset of their own IMU as well, and rightly: its scale factors and
misalignments are none of their states.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dlkf.filters.gating import chi2_quantile

Array = NDArray[np.floating]
CHANCE = 1e-4  # α, of both bounds together
TOLERATED = 1.3  # by which a 1σ may be off before it is worth a line: no filter's noise is known better
SETTLE = 10  # updates from the start on that do not count: the heading is still being found
FAULTY = 15.0  # innovations so far above their 1σ are no matter of noise: with the preset of another IMU they reach 8
STRETCH = 20  # successive updates with a fix
FAR = 2.5  # RMS of them over their 1σ, from which on it is worth a line: plus has at most 1.5 on 30 drives
REMEDY = (
    "take plus, which estimates the noise, or tuning=any_car for an unknown car; dlkf tune, or imu=auto in dlkf "
    "navigate, fits the noise; mbkf33 also estimates scale factors and misalignments"
)
OF_NETWORK = "compare it with mbkf21_car tuning=any_car; dlkf doctor checks the data"
OF_DATA = "so far off is a fault of the data, not of the noise: check units, axes, clocks and lever arm (dlkf doctor)"


class Innovation(NamedTuple):
    """GNSS − prediction (T, 6) [m, m/s] in the tangent frame, NaN where no fix was used, and its 1σ as the filter says.

    The 1σ is NaN where the filter has no covariance.
    """

    value: np.ndarray
    std: np.ndarray

    @staticmethod
    def of(value: Tensor, used: Tensor, covariance: Tensor | None) -> Innovation:
        """Of a filter's innovations (…, T, 6), where it ``used`` a fix (…, T), and their covariance, if it has one."""
        value, nan = value.cpu().double(), torch.tensor(torch.nan, dtype=torch.float64)
        seen = used.cpu().unsqueeze(-1) & (value != 0)  # zero: a component without a measurement
        std = nan.expand_as(value)
        if covariance is not None:
            std = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt().cpu().double()
        return Innovation(torch.where(seen, value, nan).numpy(), torch.where(seen, std, nan).numpy())

    @property
    def ratio(self) -> Array:
        """Innovation over its 1σ (T, 6)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.value / self.std

    @property
    def normalised_rms(self) -> float:
        """RMS of innovation over 1σ: 1 for a filter whose 1σ is right."""
        return rms(self.ratio)


class SigmaFit(NamedTuple):
    """RMS of innovations over their 1σ from update :data:`SETTLE` on, within which bounds it lies where the 1σ is
    right, and that of all updates, which tables and summaries have too."""

    ratio: float
    low: float
    high: float
    degrees: float
    of_all: float

    @property
    def too_small(self) -> bool:
        """Whether the filter is too sure: its 1σ is smaller than chance and the tolerated factor explain."""
        return self.ratio > TOLERATED * self.high

    @property
    def reported_ratio(self) -> float:
        """Of all updates, as tables have it; where uncertain first updates hide the fault, of the later ones."""
        return self.of_all if self.of_all > self.high else self.ratio

    def warning(self, name: str, remedy: str = REMEDY) -> str:
        """One line with the remedy."""
        return (
            f"{name} is overconfident: its innovations are {self.reported_ratio:.2g} times their 1σ (RMS; by chance at "
            f"most {self.high:.2g}), so in outages it drifts further than its 1σ says; "
            f"{self.remedy(remedy)}"
        )

    def short_warning(self, name: str) -> str:
        """The line behind that of another filter with the same remedy."""
        return f"{name} is overconfident, too: {self.reported_ratio:.2g} times (by chance at most {self.high:.2g})"

    def remedy(self, of_filter: str) -> str:
        """That of the filter, or of the data where the innovations are too large for any noise."""
        return OF_DATA if self.ratio > FAULTY else of_filter


def rms(ratio: Array) -> float:
    """Root mean square of what is finite, NaN where nothing is."""
    known = np.isfinite(ratio)
    return float(np.sqrt(np.mean(ratio[known] ** 2))) if known.any() else float("nan")


def worst_stretch(ratio: Array) -> tuple[float, int, int]:
    """Largest RMS of innovations over their 1σ (T, 6) in :data:`STRETCH` successive updates with a fix, and the first
    and the last row of them; 0 where there are fewer."""
    squares, _ = _squares(ratio[SETTLE:])
    if len(squares) < STRETCH:
        return 0.0, 0, 0
    rows = SETTLE + np.flatnonzero(np.isfinite(ratio[SETTLE:]).any(-1))
    means = np.convolve(squares, np.ones(STRETCH) / STRETCH, "valid")
    first = int(means.argmax())
    return float(np.sqrt(means[first])), int(rows[first]), int(rows[first + STRETCH - 1])


def fit_sigma(*drives: Array) -> SigmaFit | None:
    """Of innovations over their 1σ (T, 6), an array for each independent drive, NaN where there is none; None where no
    drive has any."""
    parts = [_squares(drive[SETTLE:]) for drive in drives]
    parts = [part for part in parts if len(part[0]) > 1]
    if not parts:
        return None
    squares = np.concatenate([s for s, _ in parts])
    seen = np.concatenate([m for _, m in parts])
    mean = float(np.average(squares, weights=seen))
    variance = float(np.var(squares))
    independent = sum(_independent(s) for s, _ in parts)
    each = min(float(seen.mean()), 2 * mean**2 / variance) if variance > 0 else float(seen.mean())
    degrees = max(independent * each, 1e-3)
    low, high = (float(np.sqrt(chi2_quantile(p, degrees) / degrees)) for p in (CHANCE / 2, 1 - CHANCE / 2))
    return SigmaFit(float(np.sqrt(mean)), low, high, degrees, rms(np.concatenate(drives)))


def _squares(ratio: Array) -> tuple[Array, Array]:
    """s_k of the updates with a fix, and how many components each has."""
    known = np.isfinite(ratio)
    m = known.sum(-1)
    s = np.where(known, ratio, 0.0) ** 2
    return s.sum(-1)[m > 0] / m[m > 0], m[m > 0].astype(float)


def _independent(s: Array) -> float:
    """n_eff of a series."""
    n = len(s)
    around = s - s.mean()
    power = float(around @ around)
    if power <= 0:
        return float(n)
    spectrum = np.abs(np.fft.rfft(around, 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[:n] / power
    end = np.flatnonzero(rho <= 0)
    j = np.arange(1, end[0] if len(end) else n)
    return n / (1 + 2 * float(((1 - j / n) * rho[j]).sum()))
