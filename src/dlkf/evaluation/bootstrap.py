"""Paired bootstrap: how sure is it that one filter is better than another on the same pieces?

Both filters are resampled with the same weights, so that a piece that is hard for both does not widen the
interval (Efron & Tibshirani, *An Introduction to the Bootstrap*, ch. 13, percentile interval). Pieces or
outages of one recording are not independent: give their recordings as ``groups`` and these are drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dlkf.evaluation.metrics import Array

STATISTICS = ("rms", "mean", "median")
MIN_GROUPS = 8  # with fewer recordings than this, pieces are drawn one by one
_CELLS = 4_000_000  # weights held at a time


@dataclass(frozen=True)
class Comparison:
    """``a`` against ``b``: ratio and difference of a statistic over the same units, with their intervals."""

    statistic: str
    a: float
    b: float
    ratio: float
    ratio_low: float
    ratio_high: float
    difference: float
    difference_low: float
    difference_high: float
    units: int
    groups: int
    confidence: float

    def as_dict(self) -> dict[str, float | int | str]:
        """Plain values."""
        return asdict(self)


def weighted(values: Array, weights: Array, statistic: str) -> Array:
    """RMS, mean or median of ``values`` (U,) under each row of non-negative ``weights`` (R, U): (R,)."""
    total = weights.sum(-1)
    if statistic == "rms":
        return np.sqrt(_dot(weights, values**2) / total)
    if statistic == "mean":
        return _dot(weights, values) / total
    if statistic == "median":
        order = np.argsort(values)
        running = np.cumsum(weights[:, order], -1)
        half = 0.5 * total[:, None]
        low = np.argmax(running >= half - 1e-9, -1)
        high = np.argmax(running > half + 1e-9, -1)
        ranked = values[order]
        return 0.5 * (ranked[low] + ranked[high])
    raise ValueError(f"statistic {statistic!r} is none of {STATISTICS}")


def _dot(weights: Array, values: Array) -> Array:
    finite = np.isfinite(values)
    total = weights @ np.where(finite, values, 0.0)
    return np.where((weights[:, ~finite] > 0).any(-1), np.inf, total)


def resampled_weights(
    groups: NDArray[np.int64], resamples: int, generator: np.random.Generator
) -> Iterator[Array]:
    """Bootstrap weights (R, U) in blocks: draws of each unit's group; ``groups`` (U,) from 0 up."""
    G = int(groups.max()) + 1
    block = max(1, _CELLS // max(len(groups), 1))
    for start in range(0, resamples, block):
        rows = min(block, resamples - start)
        yield generator.multinomial(G, np.full(G, 1 / G), size=rows)[:, groups].astype(float)


def _intervals(values: Sequence[Array], confidence: float) -> list[tuple[float, float]]:
    q = [50 * (1 - confidence), 50 * (1 + confidence)]
    out = []
    for x in values:
        known = x[~np.isnan(x)]
        method = "linear" if np.isfinite(known).all() else "nearest"
        low, high = np.percentile(known, q, method=method) if known.size else (np.nan, np.nan)
        out.append((float(low), float(high)))
    return out


def compare(
    a: Array,
    b: Array,
    *,
    statistic: str = "rms",
    groups: Sequence[str] | None = None,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Comparison:
    """Ratio a/b and difference a − b of a statistic over paired units (U,), with percentile intervals.

    Units where either value is NaN (no truth) are left out of both. With fewer than two units the interval
    is NaN.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    keep = ~(np.isnan(a) | np.isnan(b))
    a, b = a[keep], b[keep]
    unit_groups = np.arange(len(a))
    if groups is not None and len(a):
        unit_groups = np.unique(np.asarray(groups, dtype=str)[keep], return_inverse=True)[1]
        if unit_groups.max() + 1 < MIN_GROUPS:
            unit_groups = np.arange(len(a))
    drawn = int(unit_groups.max()) + 1 if len(a) else 0
    one = np.ones((1, len(a)))
    sa, sb = ((float(weighted(x, one, statistic)[0]) if len(a) else np.nan) for x in (a, b))
    ratios, differences = [np.empty(0)], [np.empty(0)]
    with np.errstate(invalid="ignore", divide="ignore"):
        if drawn > 1:
            for w in resampled_weights(unit_groups, resamples, np.random.default_rng(seed)):
                ra, rb = weighted(a, w, statistic), weighted(b, w, statistic)
                ratios.append(ra / rb)
                differences.append(ra - rb)
        ratio, difference = float(np.divide(sa, sb)), float(np.subtract(sa, sb))
    (rl, rh), (dl, dh) = _intervals((np.concatenate(ratios), np.concatenate(differences)), confidence)
    return Comparison(statistic, sa, sb, ratio, rl, rh, difference, dl, dh, len(a), drawn, confidence)


def rms_band(
    x: Array,
    *,
    groups: Sequence[str] | None = None,
    resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[Array, Array, Array]:
    """RMS over units at each column of (U, K), and the bounds of its bootstrap interval; each (K,).

    NaN where a column has no value. The bounds are NaN where it has one only, or one that is not finite.
    """
    valid = ~np.isnan(x)
    n = valid.sum(0)
    square = np.where(valid, x, 0.0) ** 2
    rms = np.where(n > 0, np.sqrt(square.sum(0) / np.maximum(n, 1)), np.nan)
    low, high = np.full((2, len(rms)), np.nan)
    sure = (n > 1) & np.isfinite(rms)
    if not sure.any():
        return rms, low, high
    index = np.arange(len(x))
    if groups is not None:
        by_group = np.unique(np.asarray(groups, dtype=str), return_inverse=True)[1]
        index = by_group if by_group.max() + 1 >= MIN_GROUPS else index
    square, counted, draws = square[:, sure], valid[:, sure].astype(float), []
    with np.errstate(invalid="ignore"):
        for w in resampled_weights(index, resamples, np.random.default_rng(seed)):
            draws.append(np.sqrt((w @ square) / (w @ counted)))
    bounds = np.nanpercentile(np.concatenate(draws), [50 * (1 - confidence), 50 * (1 + confidence)], axis=0)
    low[sure], high[sure] = bounds
    return rms, low, high
