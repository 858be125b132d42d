"""Stamps of a host that gets samples in packets: those of a packet within a moment, then none until the next.

Such stamps say when samples arrived, not when they were taken. Integrated as they stand, the first sample of a packet
would count for the time of all.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

AT_ONCE = 0.25  # of the usual interval: a sample so soon after the one before came with it
MANY = 0.55  # of the samples at once: packets of three or more
AVERAGED = 256  # intervals that the usual one is the mean of


def usual_interval(t: Float[np.ndarray, " n"]) -> float:
    """Mean interval between stamps but for gaps of the log; of packets too, whose most frequent one is a moment."""
    n = min(AVERAGED, len(t) - 1)
    return float(np.median(t[n:] - t[:-n])) / n if n > 0 else 0.0


def follow_at_once(t: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Samples that came with the one before."""
    step = np.diff(t, prepend=-np.inf)
    return (step >= 0) & (step < AT_ONCE * usual_interval(t))


def share_at_once(t: Float[np.ndarray, " n"]) -> float:
    """Share of the samples that came with the one before."""
    return float(follow_at_once(t).mean()) if len(t) else 0.0
