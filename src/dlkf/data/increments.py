"""Coning and sculling compensation: IMU samples as constant rates and forces with the true end of each interval.

The strapdown takes rate and force as constant within a sample. Where they are not, the integrals α = ∫ω dt and
ν = ∫f dt miss what the order of small turns and pushes does. To second order (Savage 1998; Titterton and Weston
ch. 11; Groves 5.5) the constants that give the same end are, with α(t), ν(t) the integrals since the sample's start,

    φ = α + ½ ∫ α(t) × dα            (coning)
    u = ν + ½ ∫ (α(t) × dν + ν(t) × dα)      (sculling, in the axes of the sample's start).

``two_sample`` is this integral inside one interval, rate and force taken as linear through it and the one before;
``merged`` is the sum over the intervals that make up a longer sample. Arrays are (6, n): ν or u [m/s], α or φ [rad].
"""

from __future__ import annotations

import numpy as np


def two_sample(increments: np.ndarray, step: np.ndarray, follows: np.ndarray) -> np.ndarray:
    """Equivalent constant increments of n intervals of ``step`` [s] from their integrals (6, n).

    φ_k = α_k + c α_{k−1} × α_k,  u_k = ν_k + c (α_{k−1} × ν_k + ν_{k−1} × α_k),  c = h_k²/(6 h_{k−1} (h_{k−1} + h_k)),
    which is 1/12 for equal steps h. Where ``follows`` (n,) is False an interval has no neighbour before it and keeps
    its integrals; the first one never has. White noise stays as it is: its share is smaller by the turn in a sample.
    """
    out = increments.copy()
    before, now = increments[:, :-1], increments[:, 1:]
    h0, h1 = step[:-1], step[1:]
    out[:, 1:] += np.where(follows[1:], h1 * h1 / (6 * h0 * (h0 + h1)), 0.0) * second_order(before, now)
    return out


def merge_increments(segments: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Equivalent constant increments of m samples from those of the n segments that they consist of, (6, n) → (6, m).

    Sample j holds the segments from ``first[j]`` (rising, ``first[0]`` = 0) to the next sample's first.
    """
    count = np.diff(first, append=segments.shape[1])
    total, products = segments.take(first, 1), np.zeros((6, len(first)))
    for k in range(1, int(count.max())):  # the k-th segment of every sample that has so many
        segment = segments.take(first + k, 1, mode="clip") * (count > k)
        products += second_order(total, segment)
        total += segment
    return total + 0.5 * products


def second_order(before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """α₀ × ν + ν₀ × α and α₀ × α of (6, n) increments ``before`` (index 0) and ``now``."""
    out = np.empty_like(now)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[k] = before[3 + i] * now[j] - before[3 + j] * now[i] + before[i] * now[3 + j] - before[j] * now[3 + i]
        out[3 + k] = before[3 + i] * now[3 + j] - before[3 + j] * now[3 + i]
    return out
