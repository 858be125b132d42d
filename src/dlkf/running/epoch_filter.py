"""A filter over the closed epochs of a stream: start, filter step, loss and restart, tangent frame, replay."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.data.alignment import AlignConfig, Start
from dlkf.data.drive import Batch, Drive
from dlkf.data.resampling import BLANK, FixRows
from dlkf.data.segments import REST, whole_drives
from dlkf.data.velocity_fit import READ_S
from dlkf.filters.aids.attach import aid_columns, unmeasured_value
from dlkf.filters.integration import Estimator, Fix, advance
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.running.bridging import Stretch, bridge, bridge_std
from dlkf.running.loss import LossWatch, far_off, is_impossible
from dlkf.running.measurement_buffer import MeasurementBuffer
from dlkf.running.reanchoring import FrameChange, can_reanchor, frame_at, reanchor
from dlkf.running.references import blank_reference
from dlkf.running.solution import Estimate
from dlkf.running.start import LOOKBACK_S, EarthFix, Search, align

MOST_LOSSES = 1000  # whose times are kept


class Running(NamedTuple):
    """Everything that a running filter carries from one epoch to the next."""

    memory: Any
    state: NavState
    error: ImuError
    frame: TangentFrame
    watch: LossWatch = LossWatch()


@dataclass
class Closed:
    """A closed epoch: samples (1, M, 6), and the filter, or the search for a heading, at its start.

    ``ended``: that the filter was ``lost`` or had ``diverged`` at its end.
    """

    number: int
    imu: Tensor
    before: Running | Search | None = None
    ended: str | None = None


class EpochFilter:
    """The filter, the epochs that late measurements may still change, and its state at the end of each.

    ``rewind``: how many epochs may be replayed; ``boundary(number)`` is the time of a boundary of the grid [s].
    ``counts`` gets ``diverged`` and ``lost``; ``lost_at`` [s] are the times of the latter. InputError, at once, where
    the estimator does not work on such a grid.
    """

    def __init__(
        self,
        estimator: Estimator,
        buffer: MeasurementBuffer,
        boundary: Callable[[int], float],
        *,
        rate_hz: float,
        epoch_s: float,
        lever_arm_b: Sequence[float],
        align: AlignConfig,
        rewind: int,
        anchor_m: float,
        counts: Counter[str],
    ) -> None:
        self._estimator, self._buffer, self._boundary, self._align = estimator, buffer, boundary, align
        self._rate_hz, self._epoch_s, self._anchor_m, self._rewind = rate_hz, epoch_s, anchor_m, rewind
        self._said, self.counts = aid_columns(estimator), counts
        back_s = max(LOOKBACK_S, align.window_s + READ_S)
        self._lookback = math.ceil(back_s / epoch_s) + 2  # epochs that an alignment reads
        module: object = estimator
        parameter = next(module.parameters(), None) if isinstance(module, torch.nn.Module) else None
        self.device = torch.device("cpu") if parameter is None else parameter.device
        self._lever_arm_b = torch.tensor([lever_arm_b], dtype=torch.float64, device=self.device)
        self.lost_at: deque[float] = deque(maxlen=MOST_LOSSES)  # s
        self.clear()
        with torch.inference_mode():  # a model that does not fit is refused now, not on the road
            samples = round(rate_hz * epoch_s)
            still = Closed(0, torch.tensor(REST, dtype=torch.float64).expand(1, samples, 6))
            estimator.begin(whole_drives([self._drive([still])], [_trial_start()]).to(self.device))

    def clear(self) -> None:
        """Start over, without any epoch."""
        self.closed: list[Closed] = []
        self._number = 0  # of the next epoch
        self.running: Running | Search | None = None
        self._first: Batch | None = None  # what the filter began with
        self.latest: Estimate | None = None  # of the last closed epoch
        self.start_doubt = 1.0  # that was left at the start

    def close(self, imu: np.ndarray) -> list[Estimate]:
        """One more epoch, of samples (1, M, 6)."""
        self.closed.append(Closed(self._number, torch.from_numpy(imu).to(self.device)))
        self._number += 1
        estimates = self._run(len(self.closed) - 1)
        if len(self.closed) > self._rewind + self._lookback:
            self._buffer.drop(self.closed.pop(0).number)
        return estimates

    def bridge(self, imu: np.ndarray, epochs: int, seconds: tuple[float, float, float]) -> list[Estimate]:
        """Some epochs of which the samples (1, M, 6) together fill a gap of the IMU, without a measurement.

        ``seconds``: how long it takes before, in and after the gap. Nothing before it can be replayed any more.
        """
        for epoch in self.closed:
            self._buffer.drop(epoch.number)
        for number in range(self._number, self._number + epochs):
            self._buffer.drop(number)
        self.closed, self._number = [], self._number + epochs
        running, latest = self.running, self.latest
        if not isinstance(running, Running) or latest is None or self._first is None:  # a late fix has ended it
            self.running = self.latest = None
            return []
        samples, dt = torch.from_numpy(imu).to(self.device), epochs * self._epoch_s / imu.shape[1]
        end = strapdown(running.state, running.error.correct(samples), dt, running.frame).end
        times = torch.tensor([seconds], dtype=end.p_n.dtype, device=self.device)
        stretch = Stretch(running.state, end, times, running.frame)
        fresh, _ = self._estimator.begin(replace(self._first, frame=running.frame, start=end))
        memory = bridge(running.memory, stretch, fresh)
        std = latest.std if latest.std is None else bridge_std(latest.std, running.memory, memory)
        self.running = running._replace(memory=memory, state=end)
        t, frame = self._boundary(self._number), running.frame
        of_nothing = {name: unmeasured_value(name) for name in latest.aids or {}}
        aids = {n: x if of_nothing[n] is None else of_nothing[n] for n, x in (latest.aids or {}).items()}
        self.latest = replace(latest, t=t, frame=frame, state=end, std=std, gnss_used=False, aids=aids or None)
        return [self.latest]

    def replay(self, boundary: int) -> list[Estimate]:
        """The filter again from the epoch on that ends at a boundary."""
        start = max(0, boundary - 1 - self.closed[0].number)
        self.running = self.closed[start].before
        return [e for k in range(start, len(self.closed)) for e in self._run(k)]

    def _aid_rows(self, number: int) -> dict[str, Tensor] | None:
        """Rows of further sensors in the epoch before a boundary."""
        if not self._buffer.tables:
            return None
        rows = self._buffer.aid_rows(number, self._boundary(number))
        return {name: torch.from_numpy(row).to(self.device) for name, row in rows.items()}

    def _run(self, k: int) -> list[Estimate]:
        """The filter over closed epoch ``k`` of those held: align at its start if need be, then one turn."""
        epoch = self.closed[k]
        self._take_back(epoch)
        epoch.before = self.running
        running = self.running or self._find_start(k)
        if isinstance(running, Search):
            self.running = self._advance_search(running, epoch)
            return []
        if running is None:
            return []
        held = self._buffer.fix(epoch.number + 1)
        fix = self._fix(held, running.frame)._replace(aids=self._aid_rows(epoch.number + 1))
        try:
            memory, step = advance(
                self._estimator, running.memory, running.state, running.error, epoch.imu, fix,
                dt=1 / self._rate_hz, frame=running.frame, lever_arm_b=self._lever_arm_b,
            )  # fmt: skip
            finite = all(bool(x.isfinite().all()) for x in step.posterior)
        except torch.linalg.LinAlgError:  # pyright: ignore[reportPrivateImportUsage]
            finite = False
        if not finite:
            return self._end(epoch, "diverged")
        watch = running.watch
        if bool(fix.used[:, :3].any()):
            share = float(far_off(step.innovation, fix.std))
            off = step.innovation[0, :3].tolist()
            watch = watch.update(epoch.number * self._epoch_s, share, held.r_e[0].tolist(), off)
        nowhere = is_impossible(step.posterior.v_n, step.posterior.p_n, running.frame.height.to(step.posterior.p_n))
        if watch.is_lost(epoch.number * self._epoch_s) or bool(nowhere):
            self.lost_at.append(self._boundary(epoch.number + 1))
            return self._end(epoch, "lost")
        self.running = self._move_anchor(Running(memory, step.posterior, step.error, running.frame, watch))
        accepted = step.answer.accepted
        used = bool(fix.used.any()) and (accepted is None or bool(accepted.any()))
        t = self._boundary(epoch.number + 1)
        said = None if step.answer.aids is None else dict(zip(self._said, step.answer.aids[0].tolist()))
        self.latest = Estimate(t, running.frame, step.posterior, step.complete_error, step.answer.std, used, said)
        return [self.latest]

    def _end(self, epoch: Closed, ended: str) -> list[Estimate]:
        """No filter after an epoch."""
        self.counts[ended] += 1
        epoch.ended = ended
        self.running = self.latest = None
        return []

    def _take_back(self, epoch: Closed) -> None:
        """An epoch that is run again counts once."""
        if epoch.ended is None:
            return
        self.counts[epoch.ended] -= 1
        if epoch.ended == "lost" and (at := self._boundary(epoch.number + 1)) in self.lost_at:
            self.lost_at.remove(at)
        epoch.ended = None

    def _fix(self, held: FixRows, frame: TangentFrame) -> Fix:
        """A held fix as the loop takes it."""
        r_e, v_e, std = (torch.from_numpy(x).to(self.device) for x in (held.r_e, held.v_e, held.std))
        used = torch.from_numpy(held.valid).to(self.device)
        value = torch.cat((frame.from_ecef(r_e), frame.rotate_from_ecef(v_e)), -1)
        lag = torch.from_numpy(held.lag).to(self.device) if held.lag[0] > 0 else None
        return Fix(torch.where(used, value, 0.0), torch.nan_to_num(std, nan=1.0), used, lag)

    def _find_start(self, k: int) -> Running | Search | None:
        """The filter at the start of closed epoch ``k``, or the search for its heading, if the car moves there."""
        epochs = self.closed[max(0, k - self._lookback) : k + 1]
        if not self._buffer.has_fix(epochs[-1].number):
            return None
        drive, row = self._drive(epochs), len(epochs) - 1
        if self._align.search_s > 0:
            search = Search.begin(drive, self._align, row)
            start = None if search is None else search.start()
            if start is None:
                return search
        else:
            try:
                start = align(drive, self._align, earliest=row)
            except InputError:
                return None
        return self._begin_filter(replace(start, first=0), drive.part(row, row + 1))

    def _advance_search(self, search: Search, epoch: Closed) -> Running | Search | None:
        """After one more epoch: the search, or the filter that begins at its end; nothing if the search has failed."""
        held = self._buffer.fix(epoch.number + 1)
        fix = EarthFix(*(torch.from_numpy(getattr(held, n)) for n in ("r_e", "v_e", "std", "valid", "lag")))
        search = search.advance(epoch.imu.cpu(), fix)
        if not search.finite:
            self._end(epoch, "diverged")
            return None
        start = search.start()
        return search if start is None else self._begin_filter(start, self._drive([epoch]))

    def _begin_filter(self, start: Start, drive: Drive) -> Running:
        """The filter at a start."""
        self._first = whole_drives([drive], [start]).to(self.device)
        self.start_doubt = start.doubt
        memory, imu_error = self._estimator.begin(self._first)
        return Running(memory, self._first.start, ImuError.of(imu_error), self._first.frame)

    def _drive(self, epochs: Sequence[Closed]) -> Drive:
        """Closed epochs as a drive without reference."""
        numbers = range(epochs[0].number, epochs[-1].number + 2)
        fixes = [self._buffer.fix(n) for n in numbers]
        found = {name: torch.from_numpy(np.concatenate([getattr(f, name) for f in fixes])) for name in BLANK}
        return Drive(
            name="stream", group="stream", dataset="", t0=0.0, epoch_s=self._epoch_s, rate_hz=self._rate_hz,
            imu=torch.cat([e.imu for e in epochs]).cpu(),
            gnss_r_e=found["r_e"], gnss_v_e=found["v_e"], gnss_std=found["std"], gnss_valid=found["valid"],
            gnss_lag=found["lag"], quality=found["quality"], **blank_reference(len(fixes)),
            lever_arm_b=self._lever_arm_b[0].cpu(),
        )  # fmt: skip

    def _move_anchor(self, running: Running) -> Running:
        """The filter in a frame whose origin is near the car."""
        away = float(running.state.p_n[0, :2].norm())
        if away <= self._anchor_m or self._first is None or not can_reanchor(running.memory):
            return running
        change = FrameChange(running.frame, frame_at(running.state, running.frame))
        state = change.state(running.state)
        fresh, _ = self._estimator.begin(replace(self._first, frame=change.new, start=state))
        return running._replace(memory=reanchor(running.memory, change, fresh), state=state, frame=change.new)


def _trial_start() -> Start:
    """A start at rest, for a trial."""
    zero = torch.zeros(3, dtype=torch.float64)
    level = torch.eye(3, dtype=torch.float64)
    return Start(0, 0.0, 0.0, 0.0, NavState(zero, zero, level), torch.ones(9, dtype=torch.float64))
