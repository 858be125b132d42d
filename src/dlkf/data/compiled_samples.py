"""A long table of IMU samples on a grid in one pass, compiled: the equations of :mod:`dlkf.data.increments` as a loop,
equal to their array form to the bit.

It is taken where numba is loaded already, or so many drives are to be read that loading it pays (:func:`prepare`).
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from dlkf.navigation import compiled
from dlkf.navigation.compiled import njit

MANY_DRIVES = 8  # whose reading takes longer than numba takes to load


def prepare(drives: int) -> None:
    """Load numba for so many drives, where that pays."""
    if drives >= MANY_DRIVES:
        compiled.load_loops()


def compose(t: np.ndarray, columns: tuple[np.ndarray, ...], at: np.ndarray, usual: float, step: float) -> np.ndarray:
    """Specific force and rate (m, 6), of samples of ``step`` [s] between the limits ``at`` (m + 1,), of six columns
    (n,) of samples that end at ``t``: :func:`dlkf.data.resampling.resample_imu`."""
    out = np.empty((len(at) - 1, 6))
    _compose(t, columns, at, usual, step, int(np.searchsorted(t, at[0], side="right")) + 1, out)
    return out


@njit()
@no_type_check
def second_order(a, b):
    """Of six numbers each: :func:`dlkf.data.increments.second_order`."""
    return (
        a[4] * b[2] - a[5] * b[1] + a[1] * b[5] - a[2] * b[4],
        a[5] * b[0] - a[3] * b[2] + a[2] * b[3] - a[0] * b[5],
        a[3] * b[1] - a[4] * b[0] + a[0] * b[4] - a[1] * b[3],
        a[4] * b[5] - a[5] * b[4],
        a[5] * b[3] - a[3] * b[5],
        a[3] * b[4] - a[4] * b[3],
    )


@njit()
@no_type_check
def six(x, k):
    """Row k of six columns."""
    return x[0][k], x[1][k], x[2][k], x[3][k], x[4][k], x[5][k]


@njit()
@no_type_check
def times(s, a):
    """s a."""
    return s * a[0], s * a[1], s * a[2], s * a[3], s * a[4], s * a[5]


@njit()
@no_type_check
def add(a, b):
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@njit()
@no_type_check
def _knot(t, n, usual, p):
    """Where segment p begins: one interval before the first, those of the samples, one after the last."""
    if 2 <= p <= n + 1:
        return t[p - 2]
    first = t[0] - (t[0] - usual)
    if p < 2:
        return t[0] - (2 - p) * first
    return t[n - 1] + (t[n - 1] - t[n - 2] if n > 1 else first) if p == n + 2 else np.inf


@njit()
@no_type_check
def _integral(t, x, usual, k):
    """Length and integral of the interval that ends at sample k; what is missing has the mean of the two neighbours."""
    now = six(x, k)
    h = t[k] - t[k - 1] if k else t[0] - (t[0] - usual)
    if h <= 1.5 * usual:
        return h, times(h, now)
    return h, add(times(usual, now), times(h - usual, times(0.5, add(now, six(x, k - 1)))))


@njit(nogil=True)
@no_type_check
def _compose(t, x, at, usual, step, p, out):
    """``p``: the segment that holds the beginning, or one after it."""
    n = len(t)
    while p >= 0 and _knot(t, n, usual, p) > at[0]:
        p -= 1
    p -= 1
    following, rate = at[0], (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    h0, before = _integral(t, x, usual, min(max(p - 1, 0), n - 1))
    for j in range(len(out)):
        begin, last = at[j], at[j + 1]
        total, products = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        while True:
            while following <= begin:
                p += 1
                following = _knot(t, n, usual, p + 1)
                if p < 1 or p > n:
                    rate = six(x, 0 if p < 1 else n - 1)
                else:
                    h, now = _integral(t, x, usual, p - 1)
                    turned = now
                    if p > 1 and h <= 1.5 * usual and h0 <= 1.5 * usual:
                        c = h * h / (6 * h0 * (h0 + h))
                        turned = add(now, times(c, second_order(before, now)))
                    rate = turned[0] / h, turned[1] / h, turned[2] / h, turned[3] / h, turned[4] / h, turned[5] / h
                    h0, before = h, now
            segment = times(min(following, last) - begin, rate)
            products = add(products, second_order(total, segment))
            total = add(total, segment)
            if following >= last:
                break
            begin = following
        for i in range(6):
            out[j, i] = (total[i] + 0.5 * products[i]) / step
