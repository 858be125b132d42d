"""The start of a run on a drive without truth, from IMU and GNSS alone.

The rule with the default config, which is all that a stream can do: the first boundary at which the car moves under
GNSS, yaw from the course, roll and pitch by levelling (:mod:`dlkf.data.alignment`).

With a drive at hand one can look ahead and back. ``search_s`` > 0 takes the course where it is best known within that
time, and has it checked by a bank of headings, for a car may reverse and a receiver's velocity be bad
(:mod:`dlkf.running.heading_bank`). ``from_rest`` carries the heading back to the first fix: a standing car does not
turn, and its specific force gives roll and pitch (:mod:`dlkf.running.standstill`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.data.alignment import (
    ACCEL_BIAS_STD,
    ALIGN,
    SPREAD_STD,
    AlignConfig,
    Aligned,
    Start,
    align_boundaries,
    levelled,
    mean_force,
)
from dlkf.data.drive import Batch, Drive
from dlkf.data.segments import whole_drives
from dlkf.errors import InputError
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import NavState
from dlkf.running.heading_bank import Case, Heading, likeliest
from dlkf.running.standstill import Gyros, at_rest, carried_back, carry_std, gyros_at_rest, rest_around

WORST_HEADING_STD = math.radians(10)  # a start further back would be worth less than the seconds gained
REST_VELOCITY_STD = 0.05  # m/s
STALE_ACCELERATION = 2.0  # m/s², by which the velocity of a late fix may be off


def align(drive: Drive, config: AlignConfig = ALIGN, *, earliest: int = 0) -> Start:
    """Position, velocity and attitude at the first boundary ≥ ``earliest`` at which they can be had.

    The tangent origin is the IMU's position there. Reads no reference. Raises InputError naming the drive if it has
    no fix, or the car never moves under GNSS, for then nothing tells its heading.
    """
    start = align_each([drive], config, earliest=earliest)[0]
    if isinstance(start, InputError):
        raise start
    return start


def align_each(drives: Sequence[Drive], config: AlignConfig = ALIGN, *, earliest: int = 0) -> list[Start | InputError]:
    """:func:`align` of many drives, their banks of headings in one batch; the error in place of a start."""
    found: list[Motion | InputError] = []
    for drive in drives:
        try:
            found.append(_first_motion(drive, config, earliest))
        except InputError as error:
            found.append(error)
    if config.search_s > 0 and (motions := [x for x in found if isinstance(x, Motion)]):
        headings = iter(likeliest([x.case for x in motions], config.search_s))
        found = [x.checked(next(headings)) if isinstance(x, Motion) else x for x in found]
    return [_started(x, config, earliest) if isinstance(x, Motion) else x for x in found]


def aligned_drives(drives: Sequence[Drive], config: AlignConfig = ALIGN) -> Batch:
    """Complete drives, each from its own :func:`align`, as one padded batch."""
    return whole_drives(drives, [align(drive, config) for drive in drives], dtype=torch.float64)


@dataclass(frozen=True)
class Motion:
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
        v_e = a.v_e[row] + less @ _swing(self.drive, row)
        return _start_at(row, r_e, v_e, self.C_eb, torch.cat((a.std[row, :6], self.std)))

    @property
    def case(self) -> Case:
        """The drive from here on for the bank of headings."""
        ahead = self.drive.part(self.row, self.drive.epochs)
        return Case(ahead, replace(self.start, first=0), self.force_b, self.gyros.error)

    def checked(self, heading: Heading) -> Motion:
        """With the heading that the bank found."""
        C_en = _ned_axes_at(self.aligned.r_e[self.row])
        std = torch.cat((self.std[:2], self.std.new_tensor([heading.std])))
        return replace(self, C_eb=C_en @ heading.C_nb, std=std)


def _first_motion(drive: Drive, config: AlignConfig, earliest: int) -> Motion:
    if not bool(drive.gnss_valid[:, :3].all(-1).any()):
        raise InputError(f"drive {drive.name}: no GNSS fix inside the IMU's time; a filter cannot start")
    aligned = align_boundaries(drive, config)
    candidates = torch.nonzero(aligned.ok[earliest : drive.epochs]).flatten() + earliest
    if not len(candidates):
        raise InputError(
            f"drive {drive.name}: never moves faster than {config.min_speed:g} m/s for {config.window_s:g} s "
            "with GNSS, so yaw is unknown; lower align.min_speed or leave the drive out"
        )
    row = int(candidates[0])
    C_eb, std = aligned.C_eb[row], aligned.std[row, 6:]
    looks_around = config.search_s > 0 or config.from_rest
    rest = at_rest(drive) if looks_around else torch.zeros(drive.epochs, dtype=torch.bool)
    rest[row:] = False
    gyros = gyros_at_rest(drive, rest, C_eb)
    force_b = mean_force(drive, row, config)
    if config.search_s > 0:
        ahead = candidates[candidates <= row + round(config.search_s / drive.epoch_s)]
        added = carry_std(drive, torch.arange(row, int(ahead[-1])), gyros, rest)[ahead - row]
        total = torch.hypot(aligned.std[ahead, 8], added)
        best = int(total.argmin())
        C_then = carried_back(drive, aligned.C_eb[ahead[best]], int(ahead[best]), row, gyros, rest)
        C_en = _ned_axes_at(aligned.r_e[row])
        C_eb = C_en @ levelled(C_en.mT @ C_then, force_b, C_en.mT @ C_eb @ force_b)
        std = torch.cat((std[:2], total[best : best + 1]))
    return Motion(drive, aligned, row, C_eb, std, force_b, rest, gyros)


def _started(motion: Motion, config: AlignConfig, earliest: int) -> Start:
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
    C_eb = carried_back(drive, motion.C_eb, row, k, motion.gyros, rest)
    std = torch.hypot(motion.std, added[k - earliest])
    C_en = _ned_axes_at(drive.gnss_r_e[k])
    if bool(standing[k]):
        force_b = drive.imu[rest_around(rest, k)][..., :3].double().mean((0, 1))
        up = force_b.new_tensor([0.0, 0.0, -1.0]) * force_b.norm()
        C_eb = C_en @ levelled(C_en.mT @ C_eb, force_b, up)
        std[:2] = math.hypot(ACCEL_BIAS_STD / 9.8, SPREAD_STD)
        v_e, v_std = torch.zeros_like(force_b), torch.full_like(force_b, REST_VELOCITY_STD)
    else:
        v_n = C_en.mT @ drive.gnss_v_e[k]
        known_v, lag = drive.gnss_valid[k, 3:], float(drive.gnss_lag[k])
        v_e = C_en @ torch.where(known_v, v_n, 0.0) - C_eb @ _swing(drive, k)
        v_std = torch.where(known_v, torch.hypot(drive.gnss_std[k, 3:], v_n.new_tensor(STALE_ACCELERATION * lag)), 0.5)
    r_e = drive.gnss_r_e[k] - C_eb @ drive.lever_arm_b + float(drive.gnss_lag[k]) * v_e
    return _start_at(k, r_e, v_e, C_eb, torch.cat((drive.gnss_std[k, :3], v_std, std)))


def _start_at(row: int, r_e: Tensor, v_e: Tensor, C_eb: Tensor, std: Tensor) -> Start:
    lat, lon, height = geodetic_from_ecef(r_e)
    C_ne = ned_axes(lat, lon).mT
    state = NavState(torch.zeros(3, dtype=torch.float64), C_ne @ v_e, C_ne @ C_eb)
    return Start(row, float(lat), float(lon), float(height), state, std)


def _ned_axes_at(r_e: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    return ned_axes(*geodetic_from_ecef(r_e)[:2])


def _swing(drive: Drive, row: int) -> Float[Tensor, " 3"]:
    """Velocity of the antenna against the IMU at a boundary, in b: ω × l with the mean rate over 0.2 s there."""
    samples = drive.imu[max(0, row - 1) : row + 1, :, 3:].double().flatten(0, 1)
    middle, tail = (0 if row == 0 else drive.imu.shape[1]), max(1, round(0.1 * drive.rate_hz))
    return torch.linalg.cross(samples[max(0, middle - tail) : middle + tail].mean(0), drive.lever_arm_b)
