"""The start of a run on a drive without truth, from IMU and GNSS alone.

* **First motion.** The first boundary at which the car moves under GNSS: yaw from the course, roll and pitch by
  levelling (:mod:`dlkf.data.alignment`). With ``search_s`` = 0 that is the start.
* **Search.** A bank of headings runs from there until no other is left and the heading is good
  (:mod:`dlkf.running.start.bank`); the filter begins there and then with its state, 1σ and gyroscope bias. So do a
  stream and, with ``from_rest`` = false, a batch run, which are the same to rounding. Doubt is carried on as long as it
  lasts, through an outage too.
* **From rest.** With the whole drive available the heading that has won is carried back to the first fix: a car at rest
  does not turn, and its specific force gives roll and pitch (:mod:`dlkf.running.start.standstill`). The bias that the
  bank has found at its end is that of the start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.data.alignment import (
    ACCEL_BIAS_STD,
    ALIGN,
    SPREAD_STD,
    AlignConfig,
    Aligned,
    Start,
    align_boundaries,
    level_attitude,
    mean_force,
)
from dlkf.data.drive import Batch, Drive
from dlkf.data.segments import whole_drives
from dlkf.data.velocity_fit import JOLT_STD, scale_std
from dlkf.navigation.attitude import vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE, STANDARD_GRAVITY, ned_axes
from dlkf.navigation.error_model import RATE_AVERAGE_S
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import NavState
from dlkf.running.start.bank import (
    COUNT,
    LEAST_BIAS_STD,
    Bank,
    Case,
    EarthFix,
    HeadingVerdict,
    advance_bank,
    begin_bank,
    gyro_bias,
    judge_bank,
    yaw_std,
)
from dlkf.running.start.no_motion import explain_no_motion
from dlkf.running.start.standstill import (
    Gyros,
    carry_attitude_back,
    carry_level,
    carry_std,
    rest_around,
    stationary_epochs,
    stationary_gyros,
)

WORST_HEADING_STD = math.radians(10)  # a start further back would be worth less than the seconds gained
REST_VELOCITY_STD = 0.05  # m/s
STALE_ACCELERATION = 2.0  # m/s², by which the velocity of a late fix may be off
LOOKBACK_S = 12.0  # of samples and fixes that a start without look-ahead reads
FIRST_EPOCHS = 128  # that are aligned at first; four times as many where the car does not move in them
CASES_AT_ONCE = 32  # bounds the memory


def align(drive: Drive, config: AlignConfig = ALIGN, *, earliest: int = 0) -> Start:
    """Position, velocity and attitude at the first boundary ≥ ``earliest`` at which they can be had.

    The tangent origin is the IMU's position there. Reads no reference. Raises InputError naming the drive if it has
    no fix, the car never moves under GNSS, or its heading is ambiguous.
    """
    start = align_each([drive], config, earliest=earliest)[0]
    if isinstance(start, InputError):
        raise start
    return start


def align_each(drives: Sequence[Drive], config: AlignConfig = ALIGN, *, earliest: int = 0) -> list[Start | InputError]:
    """:func:`align` of many drives, their banks of headings in one batch; the error in place of a start."""
    found: list[FirstMotion | InputError] = []
    for drive in drives:
        try:
            found.append(_first_motion(drive, config, earliest))
        except InputError as error:
            found.append(error)
    motions = [x for x in found if isinstance(x, FirstMotion)]
    starts: list[Start | InputError] = []
    for i in range(0, len(motions), CASES_AT_ONCE):
        some = motions[i : i + CASES_AT_ONCE]
        starts += (
            _search(some, config, earliest) if config.search_s > 0 else [_make_start(x, config, earliest) for x in some]
        )
    of_motions = iter(starts)
    return [x if isinstance(x, InputError) else next(of_motions) for x in found]


def align_drives(drives: Sequence[Drive], config: AlignConfig = ALIGN) -> Batch:
    """Complete drives, each from its own :func:`align`, as one padded batch."""
    return whole_drives(drives, [align(drive, config) for drive in drives], dtype=torch.float64)


class Search(NamedTuple):
    """The search of a stream: a bank of one case, epochs since it began, and what it began with."""

    bank: Bank
    epochs: int
    config: AlignConfig
    epoch_s: float

    @staticmethod
    def begin(drive: Drive, config: AlignConfig, row: int) -> Search | None:
        """At boundary ``row`` of a drive that holds one epoch after it; None if the car does not move under GNSS."""
        try:
            motion = _first_motion(drive, config, row)
        except InputError:
            return None
        return None if motion.row != row else Search(begin_bank([motion.case]), 0, config, drive.epoch_s)

    def advance(self, imu: Float[Tensor, "1 M 6"], fix: EarthFix) -> Search:
        """One epoch on."""
        bank = advance_bank(self.bank, imu, fix, self.epoch_s / imu.shape[1])
        return self._replace(bank=bank, epochs=self.epochs + 1)

    @property
    def finite(self) -> bool:
        """Whether its headings can still be weighed."""
        return bool(self.bank.score.amax().isfinite())

    @property
    def doubt(self) -> float:
        """Probability that the car faces another way than the best heading."""
        return judge_bank(self.bank)[0].doubt

    def start(self) -> Start | None:
        """The start at the present boundary (``first`` = 0), once the heading is good."""
        verdict = judge_bank(self.bank)[0]
        ready = verdict.ready(self.epochs * self.epoch_s, self.config)
        return _start_from_bank(self.bank, 0, verdict, 0) if ready else None


@dataclass(frozen=True)
class FirstMotion:
    """A drive at boundary ``row``, its first motion: attitude there with std (3), epochs at rest before, and what the
    gyroscopes then showed."""

    drive: Drive
    aligned: Aligned
    row: int
    C_eb: Float[Tensor, "3 3"]
    std: Float[Tensor, " 3"]
    force_b: Float[Tensor, " 3"]
    rest: Bool[Tensor, " epochs"]
    gyros: Gyros

    @property
    def start(self) -> Start:
        """State at the boundary; the lever arm as the attitude has it."""
        a, row = self.aligned, self.row
        less = a.C_eb[row] - self.C_eb
        r_e = a.r_e[row] + less @ self.drive.lever_arm_b
        v_e = a.v_e[row] + less @ _arm_velocity(self.drive, row)
        start = _start_at(row, r_e, v_e, self.C_eb, torch.cat((a.std[row, :6], self.std)))
        return replace(start, gyro=self.gyro, noise=self.noise)

    @property
    def noise(self) -> Tensor:
        """How many times more than claimed positions and velocities scatter: √w of :mod:`dlkf.filters.fix_noise`."""
        position, velocity = self.aligned.scatter[self.row]
        claimed = self.drive.gnss_std[self.row, 3:5].amax().nan_to_num(nan=1.0)
        return torch.stack((position, scale_std(claimed, velocity, JOLT_STD) / claimed))

    @property
    def gyro(self) -> Tensor | None:
        """Gyroscope bias and its 1σ [rad/s], if known."""
        if not self.gyros.known:
            return None
        return torch.cat((self.gyros.error, self.gyros.error.new_full((3,), max(self.gyros.std, LEAST_BIAS_STD))))

    def with_gyros(self, bias: Float[Tensor, " 6"]) -> FirstMotion:
        """With gyroscopes of this bias and 1σ [rad/s]."""
        error, std = bias.split(3)
        return replace(self, gyros=Gyros(error + self.C_eb[2] * EARTH_RATE, error, float(std.max())))

    @property
    def case(self) -> Case:
        """The drive from here on for the bank of headings."""
        ahead = self.drive.part(self.row, self.drive.epochs)
        level = carry_level(self.drive, self.rest, self.row, self.gyros)
        position, velocity = self.aligned.scatter[self.row].tolist()
        return Case(ahead, replace(self.start, first=0), self.force_b, level, (position, velocity))

    def best_course(self, search_s: float) -> tuple[Tensor, float]:
        """The course where it is best known within so many seconds, carried back: attitude in n, 1σ of its yaw."""
        drive, row, a = self.drive, self.row, self.aligned
        last = min(drive.epochs - 1, row + round(search_s / drive.epoch_s))
        ahead = torch.nonzero(a.ok[row : last + 1]).flatten() + row
        added = carry_std(drive, torch.arange(row, int(ahead[-1])), self.gyros, self.rest)[ahead - row]
        total = torch.hypot(a.std[ahead, 8], added)
        best = int(total.argmin())
        C = carry_attitude_back(drive, a.C_eb[ahead[best]], int(ahead[best]), row, self.gyros, self.rest)
        return _ned_axes_at(a.r_e[row]).mT @ C, float(total[best])

    def with_heading(self, C_nb: Float[Tensor, "3 3"], std: float) -> FirstMotion:
        """With another heading, the tilt left as it is."""
        C_en = _ned_axes_at(self.aligned.r_e[self.row])
        force_n = C_en.mT @ self.C_eb @ self.force_b
        C_eb = C_en @ level_attitude(C_nb, self.force_b, force_n)
        return replace(self, C_eb=C_eb, std=torch.cat((self.std[:2], self.std.new_tensor([std]))))


def _first_motion(drive: Drive, config: AlignConfig, earliest: int) -> FirstMotion:
    if not bool(drive.gnss_valid[:, :3].all(-1).any()):
        raise InputError(f"drive {drive.name}: no GNSS fix inside the IMU's time; a filter cannot start")
    aligned, row = _align_until_motion(drive, config, earliest)
    if row is None:
        raise InputError(f"drive {drive.name}: {explain_no_motion(drive, config)}")
    C_eb, std = aligned.C_eb[row], aligned.std[row, 6:]
    rest = torch.zeros(drive.epochs, dtype=torch.bool)
    if config.search_s > 0 or config.from_rest:
        first = 0 if config.from_rest else max(0, row - round(LOOKBACK_S / drive.epoch_s))
        rest[first:row] = stationary_epochs(drive.part(first, row)) if row > first else rest[first:row]
    gyros = stationary_gyros(drive, rest, C_eb)
    return FirstMotion(drive, aligned, row, C_eb, std, mean_force(drive, row, config), rest, gyros)


def _align_until_motion(drive: Drive, config: AlignConfig, earliest: int) -> tuple[Aligned, int | None]:
    """Alignment at the boundaries up to ``search_s`` after the first motion from ``earliest`` on, and where that is.

    A boundary's alignment reads what is before it. Of a drive that never moves all boundaries, and None.
    """
    ahead, search = FIRST_EPOCHS, round(config.search_s / drive.epoch_s)
    while True:
        end = min(earliest + ahead, drive.epochs)
        aligned = align_boundaries(drive.part(0, end), config)
        moving = torch.nonzero(aligned.ok[earliest:end]).flatten()
        row = earliest + int(moving[0]) if len(moving) else None
        if end == drive.epochs or (row is not None and row + search < end):
            return aligned, row
        ahead *= 4


@torch.inference_mode()
def _search(motions: Sequence[FirstMotion], config: AlignConfig, earliest: int) -> list[Start | InputError]:
    """Starts from a bank of headings that runs until each of the cases is ready or at its drive's end."""
    drives, cases = [m.drive for m in motions], [m.case for m in motions]
    epoch_s, dt = drives[0].epoch_s, 1 / drives[0].rate_hz
    bank, t, starts = begin_bank(cases), 0, {}
    back = BackCarried(bank) if config.from_rest else None
    while True:
        for k, verdict in enumerate(judge_bank(bank)):
            ended = t == cases[k].drive.epochs
            if k in starts or not (ended or verdict.ready(t * epoch_s, config)):
                continue
            if back is not None:
                found = gyro_bias(bank, k * COUNT + verdict.best)
                motion = motions[k].with_gyros(found)
                turned = motion.with_heading(*back.carry_back(motion, k, verdict.best, config))
                starts[k] = replace(_make_start(turned, config, earliest), doubt=verdict.doubt, gyro=found)
            elif ended:
                why = f"ambiguous (the alternatives have probability {verdict.doubt:.2g})"
                if verdict.decided:
                    why = f"known to {math.degrees(verdict.std):.1f}° only"
                starts[k] = InputError(
                    f"drive {drives[k].name}: its heading is {why}; align.from_rest=true takes the most probable"
                )
            else:
                starts[k] = _start_from_bank(bank, k, verdict, motions[k].row + t)
        if len(starts) == len(motions):
            return [starts[k] for k in range(len(motions))]
        now = [min(m.row + t, m.drive.epochs - 1) for m in motions]
        imu = torch.stack([d.imu[k].double() for d, k in zip(drives, now)])
        fix = EarthFix.of(drives, [k + 1 for k in now])
        over = torch.tensor([t >= c.drive.epochs for c in cases])
        bank = advance_bank(bank, imu, fix._replace(valid=fix.valid & ~over[:, None]), dt)
        t += 1
        if back is not None:
            back.keep(bank, t, epoch_s)


class BackCarried:
    """Of every heading of a bank, where on its way it is best known when carried back to the bank's beginning."""

    def __init__(self, bank: Bank) -> None:
        self.std = yaw_std(bank, 0.0)
        self.C_nb = bank.state.C_nb
        self.epoch = torch.zeros(len(self.std), dtype=torch.int64)

    def keep(self, bank: Bank, epoch: int, epoch_s: float) -> None:
        """Look at the bank after so many epochs."""
        std = yaw_std(bank, epoch * epoch_s)
        better = (std < self.std) & bank.weighed.repeat_interleave(COUNT)
        self.std = torch.where(better, std, self.std)
        self.epoch = torch.where(better, epoch, self.epoch)
        self.C_nb = torch.where(better[:, None, None], bank.state.C_nb, self.C_nb)

    def carry_back(self, motion: FirstMotion, case: int, best: int, config: AlignConfig) -> tuple[Tensor, float]:
        """Attitude at the first boundary in the tangent frame there, and 1σ of its yaw.

        The best course or its reverse where that is the better known of the two and agrees with the bank.
        """
        k = case * COUNT + best
        moving = torch.zeros_like(motion.rest)
        C = carry_attitude_back(
            motion.drive, self.C_nb[k], motion.row + int(self.epoch[k]), motion.row, motion.gyros, moving
        )
        std = float(self.std[k])
        course, course_std = motion.best_course(config.search_s)
        for turn in (1.0, -1.0):
            ahead = course @ torch.diag(course.new_tensor([turn, turn, 1.0]))
            apart = abs(float(vector_from_rotation(C @ ahead.mT)[2]))
            if course_std < std and apart < 3 * math.hypot(std, course_std):
                return ahead, course_std
        return C, std


def _start_from_bank(bank: Bank, case: int, verdict: HeadingVerdict, row: int) -> Start:
    """The most probable heading of a case as a start at boundary ``row``."""
    k = case * COUNT + verdict.best
    frame = bank.frame[k : k + 1]
    std = bank.memory.P[k].diagonal()[:9].sqrt()
    std = torch.cat((std[:8], std.new_tensor([verdict.std])))
    r_e, C_en = frame.to_ecef(bank.state.p_n[k : k + 1])[0], frame.C_en[0]
    start = _start_at(row, r_e, C_en @ bank.state.v_n[k], C_en @ bank.state.C_nb[k], std)
    noise = None if bank.noise is None else bank.noise[case]
    return replace(start, doubt=verdict.doubt, gyro=gyro_bias(bank, k), noise=noise)


def _make_start(motion: FirstMotion, config: AlignConfig, earliest: int) -> Start:
    """The start at first motion, or further back where a fix has been and the heading can be carried to."""
    drive, row, rest = motion.drive, motion.row, motion.rest
    if not config.from_rest or row == earliest:
        return motion.start
    beside = torch.nn.functional.pad(rest, (1, 1))
    standing = beside[1:] | beside[:-1]  # boundaries
    known = drive.gnss_valid[:, :3].all(-1) & (standing | drive.gnss_valid[:, 3:5].all(-1))
    back = torch.arange(row - 1, earliest - 1, -1)
    added = carry_std(drive, back, motion.gyros, rest)[1:].flip(0)  # at boundaries earliest … row − 1
    usable = known[earliest:row] & (torch.hypot(added, motion.std[2]) <= WORST_HEADING_STD)
    if not bool(usable.any()):
        return motion.start
    k = int(torch.nonzero(usable)[0]) + earliest
    C_eb = carry_attitude_back(drive, motion.C_eb, row, k, motion.gyros, rest)
    std = torch.hypot(motion.std, added[k - earliest])
    C_en = _ned_axes_at(drive.gnss_r_e[k])
    if bool(standing[k]):
        force_b = drive.imu[rest_around(rest, k)][..., :3].double().mean((0, 1))
        up = force_b.new_tensor([0.0, 0.0, -1.0]) * force_b.norm()
        C_eb = C_en @ level_attitude(C_en.mT @ C_eb, force_b, up)
        std[:2] = math.hypot(ACCEL_BIAS_STD / STANDARD_GRAVITY, SPREAD_STD)
        v_e, v_std = torch.zeros_like(force_b), torch.full_like(force_b, REST_VELOCITY_STD)
    else:
        v_n = C_en.mT @ drive.gnss_v_e[k]
        known_v, lag = drive.gnss_valid[k, 3:], float(drive.gnss_lag[k])
        v_e = C_en @ torch.where(known_v, v_n, 0.0) - C_eb @ _arm_velocity(drive, k)
        v_std = torch.hypot(motion.noise[1] * drive.gnss_std[k, 3:], v_n.new_tensor(STALE_ACCELERATION * lag))
        v_std = torch.where(known_v, v_std, 0.5)
    r_e = drive.gnss_r_e[k] - C_eb @ drive.lever_arm_b + float(drive.gnss_lag[k]) * v_e
    p_std = scale_std(drive.gnss_std[k, :3], motion.noise[0])
    start = _start_at(k, r_e, v_e, C_eb, torch.cat((p_std, v_std, std)))
    return replace(start, gyro=motion.gyro, noise=motion.noise)


def _start_at(row: int, r_e: Tensor, v_e: Tensor, C_eb: Tensor, std: Tensor) -> Start:
    lat, lon, height = geodetic_from_ecef(r_e)
    C_ne = ned_axes(lat, lon).mT
    state = NavState(torch.zeros(3, dtype=torch.float64), C_ne @ v_e, C_ne @ C_eb)
    return Start(row, float(lat), float(lon), float(height), state, std)


def _ned_axes_at(r_e: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    return ned_axes(*geodetic_from_ecef(r_e)[:2])


def _arm_velocity(drive: Drive, row: int) -> Float[Tensor, " 3"]:
    """Velocity of the antenna against the IMU at a boundary, in b: ω × l with the mean rate around it."""
    samples = drive.imu[max(0, row - 1) : row + 1, :, 3:].double().flatten(0, 1)
    middle, tail = (0 if row == 0 else drive.imu.shape[1]), max(1, round(RATE_AVERAGE_S * drive.rate_hz))
    return torch.linalg.cross(samples[max(0, middle - tail) : middle + tail].mean(0), drive.lever_arm_b)
