"""IMU samples one at a time, brought to the epoch grid as :mod:`dlkf.data.resampling` brings a whole drive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from dlkf.base.errors import InputError
from dlkf.data.limits import FROZEN_IMU_S, FULL_SCALE
from dlkf.data.resampling import SampleGrid, epoch_grid, resample_imu, samples_per_epoch
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.spikes import AHEAD, SpikeScreen
from dlkf.data.validate import LIMITS, Limits
from dlkf.running.bridging import LONGEST_BRIDGE_S, fill_gap

Row = Sequence[float] | np.ndarray
COLUMNS = ("t", *ACCEL, *GYRO)
BEFORE = 3  # stamps kept before the open epoch: an interval is resampled with the one before it
ASTRAY_S = 1.0  # samples out of line that go on for so long are the truth, and the line before was not
AFTER_GAP = 5  # samples after a gap that show that it is one, not a wrong stamp; as many before it fill it
USUAL_S = 10.0  # s, over which the usual sample is a mean


class ClosedEpochs(NamedTuple):
    """Samples (1, M, 6) of an epoch, or of some epochs together where there is a gap."""

    imu: np.ndarray
    epochs: int
    seconds: tuple[float, float, float] | None  # before, in and after the gap; None: no gap


def to_floats(*values: Any) -> tuple[float, ...]:
    """TypeError or ValueError where one is no number, as text with a number in it is not."""
    if any(isinstance(x, (str, bytes)) for x in values):
        raise TypeError
    return tuple(map(float, values))


class ImuStream:
    """Samples in, epochs of uniform samples out, with no more memory than an epoch's.

    ``step_s`` is the usual interval between stamps [s]; None: the median of the samples before the grid began.
    A sample is in line if its stamp lies after the last one, by no more than ``limits`` call a gap; missing
    samples within are bridged as the loader does. Out of line are stamps that run back or leap ahead. Spikes are left
    out (:mod:`dlkf.data.spikes`), ``spikes`` of them so far; while a sample may prove to be one, an epoch that ends
    with it waits for up to two more. A gap of up to ``LONGEST_BRIDGE_S`` is filled (:mod:`dlkf.running.bridging`) once
    ``AFTER_GAP`` samples have come after it, if a filter ``runs`` that can go on; the epochs that it touches are closed
    as one. While the car moves (``moves``), samples that have been the same to the bit for
    ``FROZEN_IMU_S`` are refused as those of a frozen IMU, so that they count as a gap.
    """

    def __init__(
        self,
        rate_hz: float,
        epoch_s: float,
        *,
        step_s: float | None = None,
        limits: Limits = LIMITS,
        keep_s: float = 10.0,
        moves: Callable[[], bool] | None = None,
        runs: Callable[[], bool] | None = None,
    ) -> None:
        self._samples = samples_per_epoch(rate_hz, epoch_s)
        self._rate_hz, self._epoch_s, self._limits, self._keep_s = rate_hz, epoch_s, limits, keep_s
        self._moves, self._runs = moves, runs
        self._given, self._screen, self.spikes = step_s, SpikeScreen(), 0
        self.clear()

    def clear(self) -> None:
        """Drop all samples and the grid."""
        self._rows: deque[tuple[float, ...]] = deque()
        self._screen.clear()
        self._same: tuple[float, ...] = ()  # the last sample without its stamp,
        self._same_since = self._same_last = -math.inf  # and the first and last stamp of its repetitions
        self._astray: tuple[float, float] | None = None  # first and last stamp of a run out of line
        self._after: list[tuple[float, ...]] = []  # its first samples
        self._usual, self._usual_s = np.zeros(6), 0.0  # mean of the last samples, and of how many seconds
        self._gap: tuple[float, float] | None = None  # since the open epoch began: beginning, end
        self._missing_s = 0.0
        self.bridged = ""  # which gap the last sample has shown to be one that is filled
        self._step = self._given
        self._longest = self._longest_step(self._given)
        self.grid: SampleGrid | None = None
        self.epochs = 0  # closed
        self.until = 1  # boundary at which the open epoch ends, or those with a gap together
        self.end = math.inf  # its time [s]

    @property
    def latest(self) -> float:
        """Stamp of the last sample in line [s]; −∞ before the first."""
        return self._rows[-1][0] if self._rows else -math.inf

    @property
    def settled(self) -> float:
        """Stamp of the last sample that can no longer prove to be a spike [s]; −∞ before the first."""
        last = -1 - self._screen.undecided
        return self._rows[last][0] if len(self._rows) >= -last else -math.inf

    @property
    def lost(self) -> bool:
        """Samples out of line have gone on for longer than an accident does: the stream must begin again."""
        return self._astray is not None and self._astray[1] - self._astray[0] >= ASTRAY_S

    def find_refusal(self, t: float, accel: Row, gyro: Row) -> str:
        """Take a sample (s, m/s², rad/s); a reason if it cannot be, else nothing."""
        self.bridged = ""
        try:
            row = to_floats(t, *accel, *gyro)
        except (TypeError, ValueError, OverflowError):
            return "t, accel or gyro holds what is no number"
        if len(row) != 7:
            return f"accel and gyro have {len(row) - 1} values together, must be 3 and 3"
        if not math.isfinite(sum(row)):
            return "t, accel or gyro is not a finite number"
        if max(map(abs, row[1:4])) > FULL_SCALE[0] or max(map(abs, row[4:])) > FULL_SCALE[1]:
            return f"accel or gyro is beyond {FULL_SCALE[0]:g} m/s², {FULL_SCALE[1]:g} rad/s"
        if self._is_frozen(row[0], row[1:]):
            return f"the same sample since t = {self._same_since:.3f} while the car moves: a frozen IMU"
        last = self.latest
        if self._rows and not last < row[0] <= last + self._longest:
            return self._out_of_line(row, last)
        self._astray = None
        self._append(row)
        if self.grid is None and row[0] - self._rows[0][0] > self._keep_s:
            self._rows.popleft()
        return ""

    def _append(self, row: tuple[float, ...]) -> None:
        """A sample in line."""
        step = row[0] - self.latest if self._rows else self._usual_s
        self._usual_s = min(self._usual_s + step, USUAL_S)
        share = step / self._usual_s if self._usual_s > 0 else 1.0
        self._usual += share * (np.array(row[1:]) - self._usual)
        self._rows.append(row)
        if self._screen.add(row[1:]):
            del self._rows[-1 - AHEAD]
            self.spikes += 1

    def begin(self, t_fix: np.ndarray) -> bool:
        """Lay the grid through the times of fixes [s]; False while there is less than an epoch of samples."""
        t = np.array([row[0] for row in self._rows])
        if len(t) < 2:
            return False
        try:
            grid = epoch_grid(t, t_fix, self._rate_hz, self._epoch_s, "stream")
        except InputError:
            return False
        self.grid = SampleGrid(grid.t0, grid.epoch_s, 1, grid.samples)
        self._step = float(np.median(np.diff(t))) if self._given is None else self._given
        self._longest = self._longest_step(self._step)
        self.end = grid.t0 + self._epoch_s
        return True

    def close_epochs(self, ended: bool = False) -> list[ClosedEpochs]:
        """The epochs whose end the stream has reached, each of them once.

        Where the stream has ``ended``, the loader's slack before an epoch's end counts as reached, and the last
        samples are no spikes.
        """
        done, slack, last = [], 0.0, self.latest if ended else self.settled
        if ended:
            slack = 0.5 * min(self.step_s, self._epoch_s / self._samples)
        while last >= self.end - max(slack, 4 * math.ulp(self.end)):
            begin, count, seconds = self.boundary(self.epochs), self.until - self.epochs, None
            if self._gap is not None:
                seconds = (self._gap[0] - begin, self._gap[1] - self._gap[0], self.end - self._gap[1])
            imu = self._resample(SampleGrid(begin, count * self._epoch_s, 1, self._samples))
            done.append(ClosedEpochs(imu, count, seconds))
            self._gap, self._missing_s = None, 0.0
            self.epochs, self.until = self.until, self.until + 1
            self.end = self.boundary(self.until)
            while len(self._rows) > BEFORE and self._rows[BEFORE][0] <= self.boundary(self.epochs):
                self._rows.popleft()
        return done

    def boundary(self, number: int) -> float:
        """Time of a boundary of the grid [s]."""
        assert self.grid is not None
        return self.grid.t0 + number * self._epoch_s

    @property
    def step_s(self) -> float:
        """The usual interval between stamps [s]; that of the grid before one is laid."""
        return self._step or self._epoch_s / self._samples

    def open(self) -> tuple[np.ndarray, float] | None:
        """As many samples (1, M, 6) as an epoch has, from its beginning to :attr:`settled`, and their length [s]."""
        if self.grid is None:
            return None
        begin = self.boundary(self.epochs)
        span = self.settled - begin
        if span <= 4 * math.ulp(begin):
            return None
        return self._resample(SampleGrid(begin, span, 1, self._samples)), span / self._samples

    def _is_frozen(self, t: float, values: tuple[float, ...]) -> bool:
        if values != self._same or not 0 <= t - self._same_last <= self._longest:
            self._same, self._same_since = values, t
        self._same_last = t
        return t - self._same_since > FROZEN_IMU_S and self._moves is not None and self._moves()

    def _resample(self, grid: SampleGrid) -> np.ndarray:
        table = np.array(self._rows)
        return resample_imu(dict(zip(COLUMNS, table.T)), grid, self._step)

    def _longest_step(self, usual: float | None) -> float:
        return max(self._limits.gap_s, self._limits.gap_samples * (usual or 0.0))

    def _out_of_line(self, row: tuple[float, ...], last: float) -> str:
        t, run = row[0], self._astray
        follows = run is not None and run[1] < t <= run[1] + self._longest
        self._astray = (run[0], t) if run is not None and follows else (t, t)
        self._after = [*(self._after if follows else ()), row][:AFTER_GAP]
        if t == last:
            return f"duplicate time stamp t = {t:.6f}"
        if t < last:
            return f"t goes back from {last:.6f} to {t:.6f}"
        if len(self._after) == AFTER_GAP and self._fill(last):
            return ""
        return f"gap of {self._astray[0] - last:.3f} s after t = {last:.6f}"

    def _fill(self, last: float) -> bool:
        """Fill the gap up to the samples that have come after it; False where it is not to be filled."""
        first = self._after[0][0]
        missing = first - self.step_s - last
        if self.grid is None or first <= last or self._missing_s + missing > LONGEST_BRIDGE_S:
            return False
        if self._runs is None or not self._runs():
            return False
        count = max(1, round((first - last) / self.step_s) - 1)
        before = np.array(self._rows)[-AFTER_GAP:, 1:]
        filled = fill_gap(before, np.array(self._after)[:, 1:], self._usual, count)
        stamps = last + (np.arange(count) + 1.0) * ((first - last) / (count + 1))
        self._rows.extend((t, *x) for t, x in zip(stamps.tolist(), filled.tolist()))
        self._screen.clear()
        begin = last if self._gap is None else self._gap[0]
        self._gap, self._missing_s = (begin, first - self.step_s), self._missing_s + missing
        for row in self._after:
            self._append(row)
        assert self.grid is not None
        reached = math.ceil((first - self.step_s - self.grid.t0) / self._epoch_s - 1e-9)
        self.until = max(self.until, reached)
        self.end = self.boundary(self.until)
        self._astray = None
        self.bridged = f"gap of {first - last:.3f} s after t = {last:.6f}"
        return True
