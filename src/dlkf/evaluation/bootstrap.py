"""Paired bootstrap: confidence intervals of one filter against another on the same segments.

Both filters are resampled with the same weights, so that a segment that is hard for both does not widen the interval
(Efron & Tibshirani, *An Introduction to the Bootstrap*, ch. 13). Segments or outages of one recording are not
independent: give their recordings as ``groups``, and these are drawn. Few of them make a percentile interval too
narrow, so its levels are those of Student's t with as many degrees of freedom (the expanded percentile interval:
Hesterberg, *What Teachers Should Know About the Bootstrap*, 2015, section 5.3), and with fewer than
:data:`MIN_GROUPS` there is none. On log-normal errors of clustered segments it covers 90 to 95 % where it says 95 %
(tests/evaluation/test_bootstrap.py); the plain percentile interval covered 83 to 92 %, BCa 80 to 89 %.

That is so where both filters' errors are about as skewed. The RMS of few, very skewed errors is as a rule too small,
and so is its ratio to that of a filter with less skew: a filter with an RMS of six times its median against one with
twice covered 76 % in 41 recordings of seven segments, the truth above the interval in nearly all other cases. The
interval of the geometric mean's ratio covered 93 to 96 % throughout.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from dlkf.evaluation.metrics import LEAST_LOG, Array, rms_over_segments

STATISTICS = ("rms", "mean", "median", "geomean")
MIN_GROUPS = 8  # with fewer recordings, or independent segments, than this there is no interval
CONFIDENCE = 0.95  # of every interval
_CELLS = 4_000_000  # weights held at a time


@dataclass(frozen=True)
class Comparison:
    """``a`` against ``b``: ratio of a statistic over the same units, with its interval.

    The bounds are NaN where ``groups``, the number of recordings (of units where none were given), is too small.
    """

    statistic: str
    a: float
    b: float
    ratio: float
    ratio_low: float
    ratio_high: float
    units: int
    groups: int
    confidence: float


def weighted_means(values: Array, weights: Array, statistic: str) -> Array:
    """A statistic of ``values`` (U,) under each row of non-negative ``weights`` (R, U): (R,).

    The geometric mean counts every unit's ratio alike, where RMS is decided by the few largest.
    """
    total = weights.sum(-1)
    if statistic == "rms":
        return np.sqrt(_dot(weights, values**2) / total)
    if statistic == "mean":
        return _dot(weights, values) / total
    if statistic == "geomean":
        with np.errstate(divide="ignore"):
            return np.exp(_dot(weights, np.maximum(np.log(values), LEAST_LOG)) / total)
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


def draw_weights(groups: NDArray[np.int64], resamples: int, generator: np.random.Generator) -> Iterator[Array]:
    """Bootstrap weights (R, U) in blocks: draws of each unit's group; ``groups`` (U,) from 0 up."""
    G = int(groups.max()) + 1
    block = max(1, _CELLS // max(len(groups), 1))
    for start in range(0, resamples, block):
        rows = min(block, resamples - start)
        yield generator.multinomial(G, np.full(G, 1 / G), size=rows)[:, groups].astype(float)


def levels(groups: int) -> tuple[float, float]:
    """Percentiles of the resamples that bound the interval: Φ(√(G/(G−1)) t) with t of G − 1 degrees of freedom."""
    t = stdtrit(groups - 1, 0.5 * (1 + CONFIDENCE)) * np.sqrt(groups / (groups - 1))
    return 100 * float(ndtr(-t)), 100 * float(ndtr(t))


def _interval(values: Array, groups: int) -> tuple[float, float]:
    known = values[~np.isnan(values)]
    if not known.size:
        return np.nan, np.nan
    method = "linear" if np.isfinite(known).all() else "nearest"
    low, high = np.percentile(known, levels(groups), method=method)
    return float(low), float(high)


def compare(
    a: Array,
    b: Array,
    *,
    statistic: str = "rms",
    groups: Sequence[str] | NDArray[np.str_] | None = None,
    resamples: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Ratio a/b of a statistic over paired units (U,), with its interval.

    Units where either value is NaN (no truth) are left out of both. With fewer than :data:`MIN_GROUPS` recordings
    (units where no ``groups`` are given) the bounds are NaN.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    keep = ~(np.isnan(a) | np.isnan(b))
    a, b = a[keep], b[keep]
    drawn = np.arange(len(a)) if groups is None else _number(np.asarray(groups, dtype=str)[keep])
    G = int(drawn.max()) + 1 if len(a) else 0
    one = np.ones((1, len(a)))
    sa, sb = ((float(weighted_means(x, one, statistic)[0]) if len(a) else np.nan) for x in (a, b))
    ratios = [np.empty(0)]
    with np.errstate(invalid="ignore", divide="ignore"):
        if G >= MIN_GROUPS:
            for w in draw_weights(drawn, resamples, np.random.default_rng(seed)):
                ratios.append(weighted_means(a, w, statistic) / weighted_means(b, w, statistic))
        ratio = float(np.divide(sa, sb))
    low, high = _interval(np.concatenate(ratios), G)
    return Comparison(statistic, sa, sb, ratio, low, high, len(a), G, CONFIDENCE)


def _number(groups: NDArray[np.str_]) -> NDArray[np.int64]:
    return np.unique(groups, return_inverse=True)[1] if len(groups) else np.empty(0, np.int64)


def rms_band(
    x: Array, *, groups: Sequence[str] | NDArray[np.str_] | None = None, resamples: int = 500, seed: int = 0
) -> tuple[Array, Array, Array]:
    """RMS over units at each column of (U, K), and the bounds of its bootstrap interval; each (K,).

    NaN where a column has no value. The bounds are NaN too where one is not finite, or where fewer than
    :data:`MIN_GROUPS` recordings (rows where no ``groups`` are given) have one.
    """
    valid, rms = ~np.isnan(x), rms_over_segments(x)
    square = np.where(valid, x, 0.0) ** 2
    low, high = np.full((2, len(rms)), np.nan)
    drawn = np.arange(len(x)) if groups is None else _number(np.asarray(groups, dtype=str))
    counted = np.array([len(np.unique(drawn[valid[:, k]])) for k in range(len(rms))])  # groups with a value
    sure = np.flatnonzero((counted >= MIN_GROUPS) & np.isfinite(rms))
    if not len(sure):
        return rms, low, high
    draws = []
    with np.errstate(invalid="ignore"):
        for w in draw_weights(drawn, resamples, np.random.default_rng(seed)):
            draws.append(np.sqrt((w @ square[:, sure]) / (w @ valid[:, sure].astype(float))))
    every = np.concatenate(draws)
    for k, column in enumerate(sure):
        low[column], high[column] = _interval(every[:, k], int(counted[column]))
    return rms, low, high
