"""A filter in a vehicle: fed one IMU sample and one GNSS fix at a time, with bounded latency and memory.

Every epoch is one :func:`dlkf.filters.integration.advance`, the turn of the loop that a batch run consists of, on
samples and fixes that come to the epoch grid as those of a logged drive do. So stream and batch give the same
solution to rounding, whatever the order in which fixes arrive:

* **Epochs** close with the first IMU sample at or after their end; what GNSS has said by then is used.
* **Fixes** that come later, as they do from every receiver, roll the filter back to the epoch they belong to and
  replay it, if that lies within ``history_s``. Of several fixes in an epoch the latest counts.
* **The grid** is laid through the fixes of the first ``SETTLE_S``; a stream does not know those to come. It differs
  from a log's by what those fixes scatter; ``phase_s`` (and ``imu_step_s``, the usual interval between samples)
  give it from outside.
* **Alignment** is the rule of :func:`dlkf.running.start.align`, applied to the epochs as they come. Until the car
  moves under GNSS there are no estimates.
* **Bad packets** (not finite, out of range, time that runs back, twice the same, too late) are refused with a reason
  and counted; nothing is raised. Missing IMU samples are bridged as in a log. A gap longer than ``limits`` allows, or
  a clock that has been set anew, is believed after one second of it: then the filter starts over with an alignment,
  and with the IMU error that it started from. It also starts over if its state is no longer finite.
* **The tangent frame** follows the car: beyond ``anchor_m`` from its origin state and memory go over to a new one
  (:mod:`dlkf.running.reanchoring`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dlkf.data.alignment import ALIGN, AlignConfig, Start
from dlkf.data.drive import Batch, Drive
from dlkf.data.resampling import BLANK, ON_BOUNDARY_S, Fixes, boundary_after, fixes_at, usable_fixes
from dlkf.data.schema import POSITION, STD, VELOCITY
from dlkf.data.segments import REST, whole_drives
from dlkf.data.validate import LIMITS, Limits
from dlkf.errors import InputError
from dlkf.filters.card import warn_unheard
from dlkf.filters.integration import Fix, advance
from dlkf.filters.smoother import Filter, Smoothed
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.running.estimate import Estimate
from dlkf.running.imu_stream import ImuStream, Row
from dlkf.running.reanchoring import FrameChange, can_reanchor, frame_at, reanchored
from dlkf.running.start import align

ANCHOR_M = 50_000.0  # from its origin on, the tangent frame is laid anew
SETTLE_S = 3.0  # fixes over so long lay the grid
MOST_EARLY_FIXES = 1000
NO_FIX = Fixes(
    np.full((1, 3), BLANK["r_e"]), np.full((1, 3), BLANK["v_e"]), np.full((1, 6), BLANK["std"]),
    np.full((1, 6), BLANK["valid"]), np.full(1, BLANK["lag"]), np.full(1, BLANK["quality"]),
)  # fmt: skip


class Status(StrEnum):
    """What became of a sample or a fix."""

    TAKEN = "taken"  # counts at the end of its epoch
    REPLAYED = "replayed"  # its epoch was over: the filter went back and came again
    SUPERSEDED = "superseded"  # a later fix of the same epoch is there already
    REFUSED = "refused"  # see the reason
    RESTARTED = "restarted"  # the stream was lost (see the reason) and begins anew


class Receipt(NamedTuple):
    """Answer to a sample or a fix; ``estimates`` in order of time: of epochs just closed, or replayed."""

    status: Status
    estimates: tuple[Estimate, ...] = ()
    reason: str = ""


class Running(NamedTuple):
    """Everything that a running filter carries from one epoch to the next."""

    memory: Any
    state: NavState
    error: ImuError
    frame: TangentFrame


@dataclass
class Closed:
    """A closed epoch: samples (1, M, 6), and the filter at its start (None: not yet aligned)."""

    number: int
    imu: Tensor
    before: Running | None = None


TAKEN = Receipt(Status.TAKEN)


class StreamingFilter:
    """A filter fed sample by sample and fix by fix.

    ``rate_hz``, ``epoch_s``: the grid that the filter works on, as in training and in ``navigate``.
    ``lever_arm_b`` [m]: IMU → antenna, Forward-Right-Down. ``history_s``: how late a fix may be. ``counts`` tells how
    often each status was returned (samples that are taken do not count), and how often the state was no longer finite
    (``diverged``). For one thread at a time. Raises InputError if the filter cannot work on such a grid, and warns
    (UnheardCar) where it would hear the car through samples that come too seldom for that.
    """

    def __init__(
        self,
        estimator: Filter,
        *,
        rate_hz: float = 50.0,
        epoch_s: float = 1.0,
        lever_arm_b: Sequence[float] = (0.0, 0.0, 0.0),
        align: AlignConfig = ALIGN,
        history_s: float = 10.0,
        phase_s: float | None = None,
        imu_step_s: float | None = None,
        anchor_m: float = ANCHOR_M,
        limits: Limits = LIMITS,
    ) -> None:
        if not 0 <= history_s < math.inf:
            raise InputError(f"history_s is {history_s!r}, must be a finite number ≥ 0")
        if align.search_s > 0 or align.from_rest:
            raise InputError("align.search_s and align.from_rest look ahead, which a stream cannot; leave them out")
        if isinstance(estimator, Smoothed):
            raise InputError("a smoothed filter looks ahead, which a stream cannot; take it without _rts")
        self.estimator, self._align = estimator, align
        self._rate_hz, self._epoch_s, self._anchor_m = rate_hz, epoch_s, anchor_m
        self._phase_s, self._history_s = phase_s, history_s
        self._samples = ImuStream(
            rate_hz, epoch_s, step_s=imu_step_s, limits=limits, keep_s=max(history_s, 2 * SETTLE_S)
        )
        self._lookback = max(1, round(align.window_s / epoch_s)) + 2  # epochs that an alignment reads
        self._rewind = math.ceil(history_s / epoch_s) + 1  # epochs that may be replayed
        parameter = next(estimator.parameters(), None) if isinstance(estimator, torch.nn.Module) else None
        self._device = torch.device("cpu") if parameter is None else parameter.device
        self._lever_arm_b = torch.tensor([lever_arm_b], dtype=torch.float64, device=self._device)
        self.counts: Counter[str] = Counter()
        self._warned = warn_unheard(estimator, min(rate_hz, 1 / imu_step_s) if imu_step_s else rate_hz)
        self._clear()
        with torch.inference_mode():  # a model that does not fit must be told now, not on the road
            samples = round(rate_hz * epoch_s)
            still = Closed(0, torch.tensor(REST, dtype=torch.float64).expand(1, samples, 6))
            estimator.begin(whole_drives([self._drive([still])], [_anywhere()]).to(self._device))

    def _clear(self) -> None:
        self._early: deque[dict[str, np.ndarray]] = deque(maxlen=MOST_EARLY_FIXES)  # before there is a grid
        self._fixes: dict[int, tuple[float, Fixes]] = {}  # time and fix by boundary
        self._closed: list[Closed] = []
        self._running: Running | None = None
        self._first: Batch | None = None  # what the filter began with
        self._latest: Estimate | None = None

    @property
    def aligning(self) -> bool:
        """Whether the filter still waits for the car to move under GNSS; then there are no estimates."""
        return self._running is None

    @property
    def latest(self) -> Estimate | None:
        """The last closed epoch's estimate, late fixes included; None while aligning."""
        return self._latest

    def imu(self, t: float, accel: Row, gyro: Row) -> Receipt:
        """Take a sample: mean specific force [m/s²] and rate [rad/s] over the interval that ends at ``t`` [s].

        The receipt holds the estimates of the epochs that end with it: as a rule none, or one once an epoch, and
        several after a bridged gap, or where the grid has just been laid.
        """
        if reason := self._samples.refused(t, accel, gyro):
            if not self._samples.lost:
                return self._answer(Status.REFUSED, reason)
            self._samples.clear()
            self._clear()
            return self._answer(Status.RESTARTED, reason)
        if self._samples.grid is None:
            self._settle()
        if t < self._samples.end - 1e-6:
            return TAKEN
        return self._close(0.0)

    def finish(self) -> Receipt:
        """Close an epoch that the end of a drive has reached within the loader's slack of half a sample."""
        return self._close(self._samples.slack_s)

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
        unknown stds follow from the ``quality`` (NMEA GGA) as in a log. The receipt of a fix that came after its
        epoch's end holds the estimates of all epochs since, anew.
        """
        velocity_ned = [math.nan] * 3 if velocity_ned is None else velocity_ned
        std = [math.nan] * 6 if std is None else std
        values = (t, lat_deg, lon_deg, height_m, *velocity_ned, *std)
        if len(velocity_ned) != 3 or len(std) != 6:
            return self._answer(Status.REFUSED, "velocity_ned must have 3 values, std 6")
        fix = {name: np.array([float(x)]) for name, x in zip(("t", *POSITION, *VELOCITY, *STD), values)}
        fix["quality"] = np.array([quality])
        if reason := _fault(fix):
            return self._answer(Status.REFUSED, reason)
        if self._samples.grid is not None:
            return self._file(fix)
        self._early.append(fix)
        return self._answer(Status.TAKEN)

    @torch.inference_mode()
    def now(self) -> Estimate | None:
        """The last epoch's state carried to the latest sample; IMU error and 1σ are that epoch's. None: aligning."""
        if self._running is None or self._latest is None:
            return None
        tail = self._samples.open()
        if tail is None:
            return self._latest
        imu, dt = torch.from_numpy(tail[0]).to(self._device), tail[1]
        running = self._running
        window = strapdown(running.state, running.error.corrected(imu), dt, running.frame)
        return replace(self._latest, t=self._samples.latest, frame=running.frame, state=window.end, gnss_used=False)

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
            self._warned = self._warned or warn_unheard(self.estimator, rate_hz)
            for fix in self._early:
                self._file(fix)
            self._early.clear()

    @torch.inference_mode()
    def _close(self, slack_s: float) -> Receipt:
        estimates = []
        for imu in self._samples.closed(slack_s):
            number = self._closed[-1].number + 1 if self._closed else 0
            self._closed.append(Closed(number, torch.from_numpy(imu).to(self._device)))
            estimates += self._run(len(self._closed) - 1)
            if len(self._closed) > self._rewind + self._lookback:
                self._fixes.pop(self._closed.pop(0).number, None)
        return Receipt(Status.TAKEN, tuple(estimates))

    @torch.inference_mode()
    def _file(self, fix: dict[str, np.ndarray]) -> Receipt:
        """Put a fix to its boundary; replay where that is over."""
        grid, done, t = self._samples.grid, self._samples.epochs, float(fix["t"][0])
        assert grid is not None
        row = int(boundary_after(fix["t"], grid)[0])
        if row < 0 or max(row - 1, 0) < done - self._rewind:
            return self._answer(Status.REFUSED, f"fix at t = {t:.3f} is more than {self._history_s:g} s late")
        if row > done + self._rewind:
            return self._answer(Status.REFUSED, f"fix at t = {t:.3f} is ahead of the IMU; both need one clock")
        held = self._fixes.get(row)
        if held is not None and held[0] >= t:
            if held[0] == t:
                return self._answer(Status.REFUSED, f"fix at t = {t:.3f} again")
            return self._answer(Status.SUPERSEDED)
        boundary = np.array([self._samples.boundary(row)])
        self._fixes[row] = (t, fixes_at(fix, np.zeros(1, np.int64), boundary))
        if row > done or not self._closed:
            return self._answer(Status.TAKEN)
        start = max(0, row - 1 - self._closed[0].number)
        self._running = self._closed[start].before
        estimates = [e for k in range(start, len(self._closed)) for e in self._run(k)]
        return self._answer(Status.REPLAYED, estimates=estimates)

    def _run(self, k: int) -> list[Estimate]:
        """The filter over closed epoch ``k`` of those held: align at its start if need be, then one turn."""
        epoch = self._closed[k]
        epoch.before = self._running
        running = self._running or self._aligned(k)
        if running is None:
            return []
        _, held = self._fixes.get(epoch.number + 1, (0.0, NO_FIX))
        fix = self._fix(held, running.frame)
        try:
            memory, step = advance(
                self.estimator, running.memory, running.state, running.error, epoch.imu, fix,
                dt=1 / self._rate_hz, frame=running.frame, lever_arm_b=self._lever_arm_b,
            )  # fmt: skip
            finite = all(bool(x.isfinite().all()) for x in step.posterior)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            finite = False
        if not finite:
            self.counts["diverged"] += 1
            self._running = self._latest = None
            return []
        self._running = self._anchored(Running(memory, step.posterior, step.error, running.frame))
        accepted = step.answer.accepted
        used = bool(fix.used.any()) and (accepted is None or bool(accepted.any()))
        t = self._samples.boundary(epoch.number + 1)
        self._latest = Estimate(t, running.frame, step.posterior, step.complete_error, step.answer.std, used)
        return [self._latest]

    def _fix(self, held: Fixes, frame: TangentFrame) -> Fix:
        """A held fix as the loop takes it."""
        r_e, v_e, std = (torch.from_numpy(x).to(self._device) for x in (held.r_e, held.v_e, held.std))
        used = torch.from_numpy(held.valid).to(self._device)
        value = torch.cat((frame.from_ecef(r_e), frame.rotate_from_ecef(v_e)), -1)
        lag = torch.from_numpy(held.lag).to(self._device) if held.lag[0] > 0 else None
        return Fix(torch.where(used, value, 0.0), torch.nan_to_num(std, nan=1.0), used, lag)

    def _aligned(self, k: int) -> Running | None:
        """The filter at the start of closed epoch ``k``, if it can be aligned there."""
        epochs = self._closed[max(0, k - self._lookback) : k + 1]
        if epochs[-1].number not in self._fixes:
            return None
        drive = self._drive(epochs)
        try:
            start = align(drive, self._align, earliest=len(epochs) - 1)
        except InputError:
            return None
        self._first = whole_drives([drive], [start]).to(self._device)
        memory, imu_error = self.estimator.begin(self._first)
        return Running(memory, self._first.start, ImuError.of(imu_error), self._first.frame)

    def _drive(self, epochs: Sequence[Closed]) -> Drive:
        """Closed epochs as a drive without reference."""
        numbers = range(epochs[0].number, epochs[-1].number + 2)
        fixes = [self._fixes[n][1] if n in self._fixes else NO_FIX for n in numbers]
        found = {name: torch.from_numpy(np.concatenate([getattr(f, name) for f in fixes])) for name in BLANK}
        rows = len(fixes)

        def unknown(*shape: int) -> Tensor:
            return torch.full((rows, *shape), torch.nan, dtype=torch.float64)

        return Drive(
            name="stream", group="stream", dataset="", t0=0.0, epoch_s=self._epoch_s, rate_hz=self._rate_hz,
            imu=torch.cat([e.imu for e in epochs]).cpu(),
            gnss_r_e=found["r_e"], gnss_v_e=found["v_e"], gnss_std=found["std"], gnss_valid=found["valid"],
            gnss_lag=found["lag"], quality=found["quality"],
            ref_r_e=unknown(3), ref_v_e=unknown(3), ref_C_eb=unknown(3, 3),
            ref_valid=torch.zeros(rows, dtype=torch.bool), ref_imu_error=unknown(6),
            lever_arm_b=self._lever_arm_b[0].cpu(),
        )  # fmt: skip

    def _anchored(self, running: Running) -> Running:
        """The filter in a frame whose origin is near the car."""
        away = float(running.state.p_n[0, :2].norm())
        if away <= self._anchor_m or self._first is None or not can_reanchor(running.memory):
            return running
        change = FrameChange(running.frame, frame_at(running.state, running.frame))
        state = change.state(running.state)
        fresh, _ = self.estimator.begin(replace(self._first, frame=change.new, start=state))
        return Running(reanchored(running.memory, change, fresh), state, running.error, change.new)


def _anywhere() -> Start:
    """A start at rest, for a trial."""
    zero = torch.zeros(3, dtype=torch.float64)
    level = torch.eye(3, dtype=torch.float64)
    return Start(0, 0.0, 0.0, 0.0, NavState(zero, zero, level), torch.ones(9, dtype=torch.float64))


def _fault(fix: dict[str, np.ndarray]) -> str:
    """What is wrong with a fix, or nothing."""
    for name, value in fix.items():
        if np.isinf(value[0]) or (name == "t" and np.isnan(value[0])):
            return f"{name} is {value[0]}"
    if not usable_fixes(fix)[0]:
        return f"no fix: quality {fix['quality'][0]}, or a position that is not a number"
    lat, lon = fix["lat_deg"][0], fix["lon_deg"][0]
    if abs(lat) > 90 or abs(lon) > 180:
        return f"lat_deg {lat:.4f}, lon_deg {lon:.4f} lie outside ±90, ±180"
    if any(fix[name][0] < 0 for name in STD):
        return "a std is below 0; NaN if unknown"
    return ""
