"""Isolated spikes of an IMU: single samples that an interface or a sensor has spoiled.

In one axis or more a sample k jumps away from the one before and back to the one after, by

    s = min(|x_k − x_(k−1)|, |x_(k+1) − x_k|) > max(FLOOR, RATIO q),

with q the third quartile of the absolute differences of the ``BEFORE`` samples before it. What is to either side is
steady: |x_(k+1) − x_(k−1)|, |x_(k−1) − x_(k−2)| and |x_(k+2) − x_(k+1)| are at most ``SHARE`` of s. And each of the two
sensors either jumps so itself or stays steady, its two differences within ``STEADY`` q (or that share of its floor). A
knock on the car is neither: a body rings on, and turns. A spike is left out, and the gap bridged as any other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import Columns

FLOOR = (5.0, 0.1)  # m/s², rad/s: a smaller jump does little harm
RATIO, SHARE, STEADY = 8.0, 0.15, 4.0
STEADY_FLOOR = 0.2  # of FLOOR
BEFORE = 50  # differences that show what is usual
QUARTILE = 3 * BEFORE // 4  # place of the third quartile among them, from 0
AHEAD = 2  # samples after one that decide on it
ROWS = BEFORE + 2 + AHEAD  # that a decision takes, the sample itself among them

_FLOORS = np.repeat(FLOOR, 3)
_EACH = tuple(_FLOORS.tolist())


def find_spikes(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Rows, in order, of six columns (n,) of specific force [m/s²] and rate [rad/s] that are spikes."""
    found = [_find_jumps(x, floor) for x, floor in zip(columns, _FLOORS)]
    at = np.unique(np.concatenate(found))
    at = at[(at > BEFORE) & (at < len(columns[0]) - AHEAD)]
    if not len(at):
        return at
    around = at[:, None] + np.arange(-BEFORE - 1, AHEAD + 1)
    return at[_is_spike(np.stack([x[around] for x in columns], -1))]


def remove_spikes(imu: Columns) -> tuple[Columns, int]:
    """A table of samples without its spikes, and how many there were."""
    spikes = find_spikes([imu[c] for c in (*ACCEL, *GYRO)])
    if not len(spikes):
        return imu, 0
    return {name: np.delete(x, spikes) for name, x in imu.items()}, len(spikes)


class SpikeScreen:
    """The same, one sample at a time: that of two samples before can be judged.

    ``undecided`` is how many of the last samples may yet prove to be spikes.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all samples."""
        self._rows: deque[Sequence[float]] = deque(maxlen=ROWS)
        self._apart = (False, False, False)  # which of the last three jump away from a steady one
        self.undecided = 0

    def add(self, row: Sequence[float]) -> bool:
        """Take a sample, six numbers; whether the one two before it was a spike."""
        rows = self._rows
        new = len(rows) > 1 and _is_far(row, rows[-1]) and _jumps(row, rows[-1], rows[-2])
        rows.append(row)
        _, older, old = self._apart
        self._apart = (older, old, new)
        self.undecided = 0
        if not (new or old or older):
            return False
        if new and self._may_be_spike(0):
            self.undecided = 1
        if old and self._may_be_spike(1):
            self.undecided = 2
        return older and len(rows) == ROWS and bool(_is_spike(np.array(rows)[None])[0])

    def _may_be_spike(self, back: int) -> bool:
        """Whether the last sample, or the one ``back`` before it, is a spike if what follows is as steady as can be."""
        rows, ahead = [*self._rows], AHEAD - back
        rows = [*rows[ahead - ROWS :], *([rows[-2 + back]] * ahead)]
        return len(rows) == ROWS and bool(_is_spike(np.array(rows)[None])[0])


def _is_far(a: Sequence[float], b: Sequence[float]) -> bool:
    f, w = FLOOR
    return (
        abs(a[0] - b[0]) > f or abs(a[1] - b[1]) > f or abs(a[2] - b[2]) > f
        or abs(a[3] - b[3]) > w or abs(a[4] - b[4]) > w or abs(a[5] - b[5]) > w
    )  # fmt: skip


def _jumps(x: Sequence[float], before: Sequence[float], earlier: Sequence[float]) -> bool:
    """Whether in some axis a sample is far from the one before, which is near the one before that."""
    return any(
        abs(a - b) > floor and abs(b - c) <= SHARE * abs(a - b) for a, b, c, floor in zip(x, before, earlier, _EACH)
    )


def _find_jumps(x: np.ndarray, floor: float) -> np.ndarray:
    """Places that jump away from both neighbours by more than ``floor``, with steady ones to either side."""
    d = np.diff(x)
    if not len(d) or max(d.max(), -d.min()) <= floor:
        return np.zeros(0, np.int64)
    far = np.abs(d) > floor
    at = np.flatnonzero(far[:-1] & far[1:])
    at = at[(at > 0) & (at < len(d) - 2)]
    up, down, size = d[at], d[at + 1], np.abs(d[np.stack((at - 1, at + 2))])
    least = np.minimum(np.abs(up), np.abs(down))
    return 1 + at[(up * down < 0) & (np.maximum(np.abs(up + down), size.max(0)) <= SHARE * least)]


def _is_spike(x: np.ndarray) -> np.ndarray:
    """Whether the third last sample of each of m stretches (m, ROWS, 6) is a spike (m,)."""
    d = np.diff(x, axis=1)
    usual = np.partition(np.abs(d[:, :BEFORE]), QUARTILE, axis=1)[:, QUARTILE]
    up, down, size = d[:, BEFORE], d[:, BEFORE + 1], np.abs(d)
    least = np.minimum(size[:, BEFORE], size[:, BEFORE + 1])
    beside = np.maximum(np.abs(up + down), np.maximum(size[:, BEFORE - 1], size[:, BEFORE + 2]))
    jumps = (least > np.maximum(_FLOORS, RATIO * usual)) & (up * down < 0) & (beside <= SHARE * least)
    most = np.maximum(size[:, BEFORE], size[:, BEFORE + 1])
    steady = most <= np.maximum(STEADY_FLOOR * _FLOORS, STEADY * usual)
    either, both = np.logical_or.reduce, np.logical_and.reduce
    of_sensor = either(jumps.reshape(-1, 2, 3), axis=-1)
    fits = of_sensor | both(steady.reshape(-1, 2, 3), axis=-1)
    return either(of_sensor, axis=-1) & both(fits, axis=-1)
