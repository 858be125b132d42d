"""What a vehicle sends, as a list of calls, and both streams over it: the Python one and the core in C."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from dlkf.data.aid_tables import STANDARD
from dlkf.data.aids import aid_values
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.validate import CheckedTables
from dlkf.onboard.c_source import COLUMNS
from dlkf.onboard.core import Status as C
from dlkf.running.solution import COLUMNS as SOLUTION
from dlkf.running.streaming import Receipt, Status, StreamingFilter
from tests.onboard.core import Core

EARTH = 6.37e6  # m per radian
METRES = {"lat_deg": np.radians(EARTH), "lon_deg": np.radians(EARTH)}
SAME = [COLUMNS.index(c) for c in SOLUTION]  # of a row of the core; behind COLUMNS stands what is said of sensors
SCALE = np.array([METRES.get(c, 1.0) for c in SOLUTION])
SAID = {  # the reasons of the Python stream in words of the core
    "0°/0°": "implausible_fix", "lies outside": "implausible_fix", "any car": "implausible_fix",
    "1σ beyond": "implausible_fix", "frozen rec": "implausible_fix",
    "frozen IMU": "frozen", "jump": "implausible_fix",
    "finite": "not_finite", " is inf": "not_finite", " is nan": "not_finite", "beyond": "implausible",
    "duplicate": "double", "goes back": "back", "gap": "gap", "no fix": "no_fix", "outside": "outside",
    "std": "outside", "late": "late", "ahead": "ahead", "takes no": "no_sensor",
}  # fmt: skip


class Call(NamedTuple):
    """One call: ``imu`` (t, accel, gyro), ``gnss`` (t, lat, lon, height, velocity, std, quality), or a further sensor's
    (t, value, std) by its name."""

    kind: str
    arguments: tuple


Calls = list[Call]


def calls(tables: CheckedTables, arrival: Callable[[float], float] = lambda t: t, aid_late_s: float = 0.0) -> Calls:
    """The calls of a drive in order of arrival, a fix before a sample of the same time; sensors ``aid_late_s`` late."""
    imu = np.stack([tables.imu[c] for c in ("t", *ACCEL, *GYRO)], -1).tolist()
    gnss = np.stack([tables.gnss[c] for c in ("t", *POSITION, *VELOCITY, *STD)], -1).tolist()
    timed: list[tuple[float, int, Call]] = [(x[0], 1, Call("imu", (x[0], x[1:4], x[4:]))) for x in imu]
    for x, quality in zip(gnss, tables.gnss["quality"].tolist()):
        timed.append((arrival(x[0]), 0, Call("gnss", (*x[:4], x[4:7], x[7:], int(quality)))))
    for name, columns in tables.aids.items():
        value = aid_values(STANDARD[name], columns)
        std = columns.get("std", np.full(len(value), np.nan))
        for x in zip(columns["t"].tolist(), value.tolist(), std.tolist()):
            if np.isfinite(x[1]):
                timed.append((x[0] + aid_late_s, 0, Call(name, x)))
    return [call for *_, call in sorted(timed, key=lambda x: x[:2])]


def of(receipt: Receipt) -> str:
    """A receipt of the Python stream in a word of the core's."""
    if receipt.status is not Status.REFUSED:
        return str(receipt.status)
    return next(word for said, word in SAID.items() if said in receipt.reason)


@dataclass
class Answers:
    """What a stream made of the calls: rows by call, words by call, the state now and then."""

    words: list[str] = field(default_factory=list)
    rows: list[tuple[int, np.ndarray]] = field(default_factory=list)  # call, solution columns
    now: list[tuple[int, np.ndarray]] = field(default_factory=list)
    aids: list[np.ndarray] = field(default_factory=list)  # what is said of further sensors, row by row

    @property
    def counts(self) -> Counter[str]:
        """How often each word was said."""
        return Counter(self.words)

    @property
    def solution(self) -> np.ndarray:
        """The last word on every time."""
        last = {row[0]: row for _, row in self.rows}
        return np.array([last[t] for t in sorted(last)]).reshape(-1, len(SOLUTION))


def through_python(stream: StreamingFilter, sent: Calls, look: int = 997, out: Answers | None = None) -> Answers:
    """The Python stream; its state is looked at every ``look`` calls. It goes on after those answered in ``out``."""
    out = out or Answers()
    for k, call in enumerate(sent[len(out.words) :], len(out.words)):
        receipt = getattr(stream, call.kind)(*call.arguments)
        out.words.append(of(receipt))
        out.rows += [(k, _row(e)) for e in receipt.estimates]
        out.aids += [np.array(list((e.aids or {}).values())) for e in receipt.estimates]
        if k % look == 0 and (now := stream.now()) is not None:
            out.now.append((k, _row(now)))
    return out


def through_core(core: Core, sent: Iterable[Call], look: int = 997) -> Answers:
    """The core."""
    out = Answers()
    for k, call in enumerate(sent):
        receipt = getattr(core, call.kind)(*call.arguments)
        out.words.append(C(receipt.status).name.lower())
        out.rows += [(k, row[SAME]) for row in receipt.rows]
        out.aids += [row[len(COLUMNS) :] for row in receipt.rows]
        if k % look == 0 and (now := core.now()) is not None:
            out.now.append((k, now[SAME]))
    return out


class Trunk:
    """A drive through the Python stream, kept every ``STEP`` calls: drives that begin as it does branch off there."""

    STEP = 500

    def __init__(self, stream: StreamingFilter, drive: Calls) -> None:
        self.drive, self.filter, self.kept = drive, stream.estimator, [(stream, Answers())]
        for end in range(self.STEP, len(drive), self.STEP):
            stream, out = self._copy(-1)
            self.kept.append((stream, through_python(stream, drive[:end], out=out)))

    def _copy(self, place: int) -> tuple[StreamingFilter, Answers]:
        return deepcopy(self.kept[place], {id(self.filter): self.filter})

    def branch(self, sent: Calls) -> tuple[StreamingFilter, Answers]:
        """The stream after ``sent``, and its answers; calls of the drive are the same objects in both."""
        both = enumerate(zip(sent, self.drive))
        same = next((k for k, (a, b) in both if a is not b), min(len(sent), len(self.drive)))
        stream, out = self._copy(min(same // self.STEP, len(self.kept) - 1))
        return stream, through_python(stream, sent, out=out)


def _row(estimate: Any) -> np.ndarray:
    row = estimate.row
    return np.array([row[c] for c in SOLUTION])


def apart(a: list[tuple[int, np.ndarray]], b: list[tuple[int, np.ndarray]]) -> float:
    """Largest difference of two lists of rows in any column; angles of position in metres; inf for other rows."""
    if [k for k, _ in a] != [k for k, _ in b]:
        return np.inf
    if not a:
        return 0.0
    x, y = (np.array([row for _, row in rows]) for rows in (a, b))
    difference = np.abs(x - y) * SCALE
    yaw = SOLUTION.index("yaw")
    difference[:, yaw] = np.minimum(difference[:, yaw], 2 * np.pi - difference[:, yaw])
    return float(np.nan_to_num(difference, nan=np.inf if (np.isnan(x) != np.isnan(y)).any() else 0.0).max())
