"""Rates of wheels that count on: ticks, turns, metres since some beginning."""

from __future__ import annotations

import numpy as np
import pandas as pd

BRIDGED, BRIDGED_S = 2.5, 0.5  # usual steps, or seconds: counts further apart say nothing of a moment
AROUND = 7  # rows whose middle rate is what one is expected to have
FAR = 10.0  # what the rate usually changes by from row to row (99 of 100): a counter jumps by more
ALIKE = 0.25  # of what is expected, so much may a step differ from it at a jump
SEVERAL = 3  # jumps of one size: a period that is no round number


def count_rates(t: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """What a counter (n,) gains a second between its rows (n − 1,).

    NaN where a count is unknown, rows are missing, or the counter was set to another value. It begins again at a power
    of two or ten that its range fills, or at a number on which several jumps agree.
    """
    step, dt = np.diff(counts), np.diff(t)
    good = np.isfinite(step) & (dt > 0)
    if not good.any():
        return np.full(len(step), np.nan)
    usual = float(np.median(dt[good]))
    good &= dt <= max(BRIDGED * usual, BRIDGED_S)
    reach = float(np.ptp(counts[np.isfinite(counts)]))
    far = good & (np.abs(step) > reach / 2)
    near = good & ~far
    rates = pd.Series(np.where(near, step / np.where(good, dt, 1.0), np.nan))
    around = rates.rolling(AROUND, center=True, min_periods=1).median().interpolate(limit_direction="both")
    expected = around.to_numpy() * dt
    off, size = step - expected, np.abs(expected)
    changes = np.abs(rates.diff().dropna().to_numpy()) * usual
    slack = FAR * float(np.quantile(changes, 0.99)) if len(changes) else 0.0
    if far.any():
        most = np.maximum(slack, ALIKE * size)
        period = _find_period(np.abs(off[far]), most[far], reach, float(np.abs(step[near]).max(initial=1.0)))
        step = np.where(far, step - np.sign(off) * period, step)
        good &= ~far | (np.abs(step - expected) <= most)
    good &= far | (np.abs(off) <= np.maximum(slack, size))
    return np.where(good, step / np.where(good, dt, 1.0), np.nan)


def _find_period(sizes: np.ndarray, slack: np.ndarray, reach: float, longest: float) -> float:
    """After how many counts a counter begins again, by the sizes of its jumps; NaN where they are none of a period."""
    rounds = np.concatenate((2.0 ** np.arange(1, 54), 10.0 ** np.arange(1, 16)))
    rounds = rounds[(rounds > reach) & (rounds <= reach + 2 * longest + 1)]
    fits = [float(one) for one in rounds if (np.abs(sizes - one) <= slack).mean() > 0.5]
    if fits:
        return min(fits, key=lambda one: float(np.median(np.abs(sizes - one))))
    middle = float(np.median(sizes))
    agree = len(sizes) >= SEVERAL and (np.abs(sizes - middle) <= slack).mean() > 0.5
    return float(np.round(middle)) if agree and middle > reach else float("nan")
