"""A filter in a vehicle: fed one IMU sample and one GNSS fix at a time, with bounded latency and memory.

Every epoch is one :func:`dlkf.filters.integration.advance`, the filter step of a batch run, on
samples and fixes that come to the epoch grid as those of a logged drive do. So stream and batch give the same
solution to rounding, for any order in which fixes arrive:

* **Epochs** close with the first IMU sample at or after their end; the fixes that have come by then are used.
* **Fixes** that come later, as they do from every receiver, roll the filter back to the epoch they belong to and
  replay it, if that lies within ``history_s``. Of several fixes in an epoch the latest counts.
* **The grid** is aligned with the fixes of the first ``SETTLE_S``. A log uses all its fixes, so the two grids differ by
  the scatter of these first ones; ``phase_s`` and ``imu_step_s`` (the nominal sample interval) set the grid explicitly.
* **The start** is the rule of :func:`dlkf.running.start.align` without look-ahead, applied to the epochs as they
  come. Until the car moves under GNSS, and while it is in doubt which way it faces (``doubt``), there are no estimates.
* **Bad packets** (not finite, out of range, time that runs back, twice the same, too late) are refused with a reason
  and counted; nothing is raised. Missing IMU samples are bridged as in a log. Over a gap longer than
  ``limits`` allows, up to ``LONGEST_BRIDGE_S``, a running filter is carried with a larger covariance, and without a
  measurement at the end of the epochs that it touches (:mod:`dlkf.running.bridging`). A longer one, or a clock that
  has been set again, is accepted after one second of it: then the filter starts over with an alignment,
  and with the IMU error that it started from. It also starts over if its state is no longer finite, is that of no
  car, or stays far from fixes that agree with each other (:mod:`dlkf.running.loss`).
* **Spikes** of the IMU are left out as in a log; an epoch whose last sample may be one closes up to two samples later
  (:mod:`dlkf.data.spikes`).
* **A frozen IMU**, which repeats the same sample while the car moves, is refused after half a second; what follows is
  a gap.
* **Physical limits**: samples beyond full scale and fixes that no car can have reached since the last good one are
  refused and counted before any filter sees them (:mod:`dlkf.data.limits`), whatever the order of arrival
  (:mod:`dlkf.running.fix_history`).
* **The tangent frame** follows the car: beyond ``anchor_m`` from its origin state and memory go over to a new one
  (:mod:`dlkf.running.reanchoring`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import torch

from dlkf.base.errors import InputError
from dlkf.base.settings import is_number
from dlkf.data.aids import LARGEST_VALUE, pressure_height
from dlkf.data.alignment import SEARCH, AlignConfig
from dlkf.data.limits import FROZEN_SPEED_M_S
from dlkf.data.resampling import ON_BOUNDARY_S, find_boundary, make_fixes
from dlkf.data.validate import LIMITS, Limits
from dlkf.data.velocity_fit import NEEDED
from dlkf.filters.aids.attach import find_tables
from dlkf.filters.card import warn_slow_drives
from dlkf.filters.smoother import Filter, SmoothedSolution
from dlkf.navigation.strapdown import strapdown
from dlkf.running.bridging import can_bridge
from dlkf.running.epoch_filter import EpochFilter, Running
from dlkf.running.fix_history import HELD, FixHistory
from dlkf.running.imu_stream import ImuStream, Row
from dlkf.running.measurement_buffer import MeasurementBuffer, as_number, check_fix
from dlkf.running.solution import Estimate
from dlkf.running.start import Search

ANCHOR_M = 50_000.0  # from its origin, beyond which the tangent frame moves
SETTLE_S = 3.0  # fixes over so long lay the grid
MOST_EARLY_SAMPLES = 10_000  # of further sensors
FIXES_OVER = f"fixes over {SETTLE_S:.0f} seconds"
MOTION = f"the car to move under GNSS, with {NEEDED}"
FIRST_OF_FIXES, FIRST_OF_AIDS = 0, 1  # boundaries at which they can count


class Status(StrEnum):
    """What became of a sample or a fix."""

    TAKEN = "taken"  # counts at the end of its epoch
    REPLAYED = "replayed"  # its epoch was over: the filter was rewound and replayed
    SUPERSEDED = "superseded"  # a later fix of the same epoch is there already
    REFUSED = "refused"  # see the reason
    RESTARTED = "restarted"  # the stream was lost (see the reason) and restarts
    BRIDGED = "bridged"  # the sample, after a gap (see the reason) over which the filter is carried


class Receipt(NamedTuple):
    """Answer to a sample or a fix; ``estimates`` in order of time: of epochs just closed, or replayed."""

    status: Status
    estimates: tuple[Estimate, ...] = ()
    reason: str = ""


TAKEN = Receipt(Status.TAKEN)


class StreamingFilter:
    """A filter fed sample by sample and fix by fix.

    ``rate_hz``, ``epoch_s``: the grid that the filter works on, as in training and in ``navigate``.
    ``lever_arm_b`` [m]: IMU → antenna, Forward-Right-Down. ``history_s``: how late a fix may be. ``counts`` has how
    often each status was returned (samples that are taken do not count; a fix that came before the start counts again
    when it gets its interval), how many samples proved to be spikes
    (``spikes``), how often the state was no longer finite (``diverged``), and how often the filter was lost (``lost``,
    at the times ``lost_at``). For one thread at a time.
    Raises InputError if the filter cannot run on this grid. Warns (LowSampleRateWarning) if the sample rate is too low
    for its full accuracy.
    """

    def __init__(
        self,
        estimator: Filter,
        *,
        rate_hz: float = 50.0,
        epoch_s: float = 1.0,
        lever_arm_b: Sequence[float] = (0.0, 0.0, 0.0),
        align: AlignConfig = SEARCH,
        history_s: float = 10.0,
        phase_s: float | None = None,
        imu_step_s: float | None = None,
        anchor_m: float = ANCHOR_M,
        limits: Limits = LIMITS,
    ) -> None:
        if not is_number(history_s) or history_s < 0:
            raise InputError(f"history_s is {history_s!r}, must be a finite number ≥ 0")
        for name, value in (("imu_step_s", imu_step_s), ("anchor_m", anchor_m)):
            if value is not None and (not is_number(value) or value <= 0):
                raise InputError(f"{name} is {value!r}, must be a finite number above 0")
        if phase_s is not None and not is_number(phase_s):
            raise InputError(f"phase_s is {phase_s!r}, must be a finite number")
        for name, value, kind in (("align", align, AlignConfig), ("limits", limits, Limits)):
            if not isinstance(value, kind):
                raise InputError(f"{name} is {value!r}, must be a {kind.__module__}.{kind.__name__}")
        if align.from_rest:
            raise InputError("align.from_rest looks ahead, which a stream cannot; leave it out")
        if isinstance(estimator, SmoothedSolution):
            raise InputError("a smoothed filter looks ahead, which a stream cannot; take it without _rts")
        self.estimator, self._rate_hz = estimator, rate_hz
        self._phase_s, self._history_s = phase_s, history_s
        self._samples = ImuStream(
            rate_hz, epoch_s, step_s=imu_step_s, limits=limits, keep_s=max(history_s, 2 * SETTLE_S), moves=self._moves,
            runs=self._runs,
        )  # fmt: skip
        self._rewind = math.ceil(history_s / epoch_s) + 1  # epochs that may be replayed
        self.counts: Counter[str] = Counter()
        self._buffer = MeasurementBuffer(find_tables(estimator))
        self._epochs = EpochFilter(
            estimator, self._buffer, self._samples.boundary, rate_hz=rate_hz, epoch_s=epoch_s, lever_arm_b=lever_arm_b,
            align=align, rewind=self._rewind, anchor_m=anchor_m, counts=self.counts,
        )  # fmt: skip
        self._warned = warn_slow_drives(estimator, min(rate_hz, 1 / imu_step_s) if imu_step_s else rate_hz)
        self._fixes = FixHistory()
        self._clear()

    def _clear(self) -> None:
        self._early: deque[dict[str, np.ndarray]] = deque(maxlen=HELD)  # before there is a grid
        self._early_aids: deque[tuple[str, float, float, float]] = deque(maxlen=MOST_EARLY_SAMPLES)
        self._fixes.clear()
        self._buffer.clear()
        self._epochs.clear()

    @property
    def aligning(self) -> bool:
        """Whether the filter still waits for the car to move under GNSS and for a heading; then there are no
        estimates."""
        return not isinstance(self._epochs.running, Running)

    @property
    def waits_for(self) -> str:
        """What is missing for estimates, "nothing" where there are some."""
        if self.latest is not None:
            return "nothing"
        if not math.isfinite(self._samples.latest):
            return "samples of the IMU"
        if self._epochs.running is not None:
            return "motion that determines the heading"
        return FIXES_OVER if self._samples.grid is None else MOTION

    @property
    def doubt(self) -> float:
        """Probability that the most likely heading is wrong: 1 before the car moves; once the filter runs, its value
        when it started."""
        if isinstance(self._epochs.running, Search):
            return self._epochs.running.doubt
        return 1.0 if self.aligning else self._epochs.start_doubt

    @property
    def lost_at(self) -> deque[float]:
        """Times [s] at which the filter was lost."""
        return self._epochs.lost_at

    @property
    def latest(self) -> Estimate | None:
        """The last closed epoch's estimate, late fixes included; None while aligning."""
        return self._epochs.latest

    def imu(self, t: float, accel: Row, gyro: Row) -> Receipt:
        """Take a sample: mean specific force [m/s²] and rate [rad/s] over the interval that ends at ``t`` [s].

        The receipt holds the estimates of the epochs that end with it: as a rule none, or one once an epoch, and
        several after a bridged gap, or where the grid has just been laid.
        """
        if reason := self._samples.find_refusal(t, accel, gyro):
            if not self._samples.lost:
                return self._answer(Status.REFUSED, reason)
            self._samples.clear()
            self._clear()
            return self._answer(Status.RESTARTED, reason)
        if self._samples.grid is None:
            self._settle()
        if self._samples.spikes != self.counts["spikes"]:
            self.counts["spikes"] = self._samples.spikes
        closed = TAKEN if float(t) < self._samples.end - 1e-6 else self._close(ended=False)
        if not self._samples.bridged:
            return closed
        return self._answer(Status.BRIDGED, self._samples.bridged, closed.estimates)

    def finish(self) -> Receipt:
        """Close an epoch that the end of a drive has reached within the loader's slack of half a sample."""
        return self._close(ended=True)

    def gnss(
        self,
        t: float,
        lat_deg: float,
        lon_deg: float,
        height_m: float,
        velocity_ned: Row | None = None,
        std: Row | None = None,
        quality: int = 1,
    ) -> Receipt:
        """Take a fix of the antenna, instantaneous at ``t`` [s, clock of the samples].

        ``velocity_ned`` [m/s] and ``std`` (6: position n, e, d [m], velocity [m/s]) are None or NaN where unknown;
        unknown stds (0 too) follow from the ``quality`` (NMEA GGA) as in a log. The receipt of a fix that came after
        its epoch's end holds the recomputed estimates of all epochs since; a fix that is refused does so too where
        later fixes, screened again, count otherwise than before.
        """
        fix = check_fix(t, (lat_deg, lon_deg, height_m), velocity_ned, std, quality)
        if isinstance(fix, str):
            return self._answer(Status.REFUSED, fix)
        if self._samples.grid is not None:
            return self._file(fix)
        self._early.append(fix)
        return self._answer(Status.TAKEN)

    def speed(self, t: float, speed: float, std: float = math.nan) -> Receipt:
        """Take a wheel speed [m/s], forward positive or never negative, at ``t`` [s, clock of the samples]."""
        return self.aid("speed", t, speed, std)

    def heading(self, t: float, heading: float, std: float = math.nan) -> Receipt:
        """Take the car's heading [rad], from North over East, of a dual-antenna receiver at ``t`` [s]."""
        return self.aid("heading", t, heading, std)

    def baro(
        self, t: float, height_m: float = math.nan, std: float = math.nan, *, pressure: float = math.nan
    ) -> Receipt:
        """Take a barometric height [m], or a ``pressure`` [Pa], at ``t`` [s]."""
        height = as_number(height_m)
        if not math.isfinite(height):
            height = float(pressure_height(np.asarray(as_number(pressure))))
        return self.aid("baro", t, height, std)

    def aid(self, name: str, t: float, value: float, std: float = math.nan) -> Receipt:
        """Take a sample of the sensor ``name`` of the filter, in the unit of its table.

        It may come late, as a fix may. Refused are a sensor that the filter does not take, and values that are not
        finite or beyond :data:`dlkf.data.aids.LARGEST_VALUE`.
        """
        if name not in self._buffer.tables:
            known = ", ".join(self._buffer.tables) or "none"
            return self._answer(Status.REFUSED, f"this filter takes no {name} (it takes {known})")
        sample = (name, as_number(t), as_number(value), as_number(std))
        if not (math.isfinite(sample[1]) and math.isfinite(sample[2])):
            return self._answer(Status.REFUSED, f"{name}: t or value is not a finite number")
        if abs(sample[2]) > LARGEST_VALUE:
            return self._answer(Status.REFUSED, f"{name}: a value beyond {LARGEST_VALUE:g}")
        if sample[3] < 0:
            return self._answer(Status.REFUSED, f"{name}: std is below 0; NaN if unknown")
        if self._samples.grid is not None:
            return self._file_aid(*sample)
        self._early_aids.append(sample)
        return TAKEN

    @torch.inference_mode()
    def now(self) -> Estimate | None:
        """The last epoch's state carried to the latest sample that can be no spike; IMU error and 1σ are that epoch's.
        None: aligning."""
        running, latest, tail = self._epochs.running, self._epochs.latest, self._samples.open()
        if not isinstance(running, Running) or latest is None or tail is None:
            return latest
        imu, dt = torch.from_numpy(tail[0]).to(self._epochs.device), tail[1]
        window = strapdown(running.state, running.error.correct(imu), dt, running.frame)
        return replace(latest, t=self._samples.settled, frame=running.frame, state=window.end, gnss_used=False)

    def _runs(self) -> bool:
        """Whether there is a filter that can go on after a gap of the IMU."""
        running = self._epochs.running
        return isinstance(running, Running) and self.latest is not None and can_bridge(running.memory)

    def _moves(self) -> bool:
        """Whether the car moved at the end of the last epoch, as far as the filter knows."""
        latest = self._epochs.latest
        return latest is not None and float(latest.state.v_n.norm()) > FROZEN_SPEED_M_S

    def _answer(self, status: Status, reason: str = "", estimates: Sequence[Estimate] = ()) -> Receipt:
        self.counts[status] += 1
        return Receipt(status, tuple(estimates), reason)

    def _settle(self) -> None:
        """Lay the grid, once there are fixes enough to lay it through."""
        if self._phase_s is not None:
            through = np.array([self._phase_s])
        else:
            now = self._samples.latest
            t = np.array([fix["t"][0] for fix in self._early])
            through = np.sort(t[np.abs(t - now) <= self._history_s + SETTLE_S])
            if len(through) < 2 or np.ptp(through) < SETTLE_S - ON_BOUNDARY_S:
                return
        if self._samples.begin(through):
            rate_hz = min(self._rate_hz, 1 / self._samples.step_s)
            self._warned = self._warned or warn_slow_drives(self.estimator, rate_hz)
            for fix in self._early:  # what lies before the first interval is of no use, which is no fault of it
                if self._find_boundary(float(fix["t"][0])) >= FIRST_OF_FIXES:
                    self._file(fix)
            self._early.clear()
            for sample in self._early_aids:
                if self._find_boundary(sample[1]) >= FIRST_OF_AIDS:
                    self._file_aid(*sample)
            self._early_aids.clear()

    @torch.inference_mode()
    def _close(self, ended: bool) -> Receipt:
        estimates: list[Estimate] = []
        for imu, epochs, seconds in self._samples.close_epochs(ended):
            estimates += self._epochs.close(imu) if seconds is None else self._epochs.bridge(imu, epochs, seconds)
        return Receipt(Status.TAKEN, tuple(estimates))

    def _file(self, fix: dict[str, np.ndarray]) -> Receipt:
        """Put a fix to its boundary; replay where that is over."""
        t = float(fix["t"][0])
        row = self._find_boundary(t)
        if reason := self._timing_fault("fix", t, row, FIRST_OF_FIXES):
            return self._answer(Status.REFUSED, reason)
        screened, changed = self._fixes.add(t, row, fix, oldest=self._samples.epochs - self._rewind)
        if screened is None:
            return self._answer(Status.REFUSED, f"duplicate fix at t = {t:.3f}")
        for boundary in changed:
            self._put_fix(boundary)
        estimates = self._replay(min(changed)) if changed else None
        if not screened.used:
            return self._answer(Status.REFUSED, screened.reason, estimates or ())
        if self._buffer.fix_time(row) > t:
            return self._answer(Status.SUPERSEDED, estimates=estimates or ())
        return self._receipt(estimates)

    def _put_fix(self, row: int) -> None:
        """The fix of a boundary into the buffer, or none."""
        fix, boundary = self._fixes.at(row), np.array([self._samples.boundary(row)])
        self._buffer.put_fix(row, fix and (fix.t, make_fixes(fix.table, np.zeros(1, np.int64), boundary)))

    def _file_aid(self, name: str, t: float, value: float, std: float) -> Receipt:
        """Put a sample of a further sensor to the others of its interval; replay where that is over."""
        row = self._find_boundary(t)
        if reason := self._timing_fault(name, t, row, FIRST_OF_AIDS):
            return self._answer(Status.REFUSED, reason)
        if not self._buffer.put_aid(row, name, t, value, std):
            return self._answer(Status.REFUSED, f"duplicate {name} at t = {t:.3f}")
        estimates = self._replay(row)
        return TAKEN if estimates is None else self._receipt(estimates)

    def _find_boundary(self, t: float) -> int:
        assert self._samples.grid is not None
        return int(find_boundary(np.array([t]), self._samples.grid)[0])

    def _timing_fault(self, what: str, t: float, row: int, least: int) -> str:
        """Why a measurement cannot count at boundary ``row``, or nothing; the first that can is ``least``."""
        if row < least or max(row - 1, 0) < self._samples.epochs - self._rewind:
            return f"{what} at t = {t:.3f} is more than {self._history_s:g} s late"
        if row >= self._samples.until + self._rewind:
            return f"{what} at t = {t:.3f} is ahead of the IMU; both need one clock"
        return ""

    @torch.inference_mode()
    def _replay(self, row: int) -> list[Estimate] | None:
        """The estimates of all epochs since boundary ``row``, recomputed; None where that is still to come."""
        if row > self._samples.epochs or not self._epochs.closed:
            return None
        return self._epochs.replay(row)

    def _receipt(self, replayed: list[Estimate] | None) -> Receipt:
        return self._answer(Status.TAKEN) if replayed is None else self._answer(Status.REPLAYED, estimates=replayed)
