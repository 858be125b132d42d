"""Segments of drives as batches: where they may be cut, cutting by one gather, starts with drawn errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dlkf.base.errors import InputError, list_some
from dlkf.base.settings import Ranged
from dlkf.data.alignment import Start
from dlkf.data.draws import draw_per_segment
from dlkf.data.drive import Batch, Drive
from dlkf.data.stack import DriveStack, stack_drives
from dlkf.navigation.earth import TangentFrame, tangent_frame
from dlkf.navigation.state import NavState

UNKNOWN_GYRO = (0.0, 0.0, 0.0, math.inf, math.inf, math.inf)  # bias and 1σ where a start shows none
REST = (0.0, 0.0, -9.8, 0.0, 0.0, 0.0)  # IMU in the padding after a segment's end


class Segment(NamedTuple):
    """``epochs`` epochs of drive number ``drive`` from boundary ``first`` on."""

    drive: int
    first: int
    epochs: int


@dataclass(frozen=True)
class StartLaw(Ranged, where="start", least=0):
    """1σ of the initial error that every filter gets, truth ⊖ start ~ N(0, Σ₀) (paper.md 4.5).

    All zero starts from the exact truth.
    """

    position_m: float = 1.0
    velocity_mps: float = 0.1
    roll_pitch_deg: float = 1.0
    yaw_deg: float = 2.0

    @property
    def std(self) -> Float[Tensor, " 9"]:
        """1σ of position, velocity, attitude in n; float64."""
        tilt, yaw = math.radians(self.roll_pitch_deg), math.radians(self.yaw_deg)
        values = [self.position_m] * 3 + [self.velocity_mps] * 3 + [tilt, tilt, yaw]
        return torch.tensor(values, dtype=torch.float64)


def count_epochs(length_s: float, epoch_s: float) -> int:
    """Whole epochs in a length; InputError if there is none."""
    epochs = round(length_s / epoch_s)
    if epochs < 1:
        raise InputError(f"length of {length_s:g} s is shorter than an epoch of {epoch_s:g} s; give a longer one")
    return epochs


def possible_starts(
    drives: Sequence[Drive], epochs: int, *, attitude: bool = False, span: Int[Tensor, " rows"] | None = None
) -> Bool[Tensor, " rows"]:
    """Boundaries of the stack from which ``epochs`` epochs can be cut.

    The reference must be valid at the start and at all boundaries after it, and a whole start state known, from the
    reference or, unless ``attitude`` asks for true attitude, from IMU and GNSS. With ``span`` (a label per boundary,
    that of the epoch it begins; −1 belongs to none) a segment must stay inside one span.
    """
    stack = stack_drives(drives)
    truth = stack.start_from_truth
    valid = truth if attitude else stack.rows["ref_valid"]
    start = truth
    if not attitude and bool((valid & ~truth).any()):
        start = truth | (valid & stack.aligned.ok)
    bad = torch.cat((torch.zeros(1, dtype=torch.int64), (~valid).long().cumsum(0)))
    rows = len(valid)
    ends = torch.repeat_interleave(stack.first_row + stack.epochs, stack.epochs + 1)
    row = torch.arange(rows)
    last = row + epochs
    inside = last <= ends
    last = last.clamp(max=rows - 1)
    ok = inside & start & (bad[last + 1] == bad[row + 1])
    if span is not None:
        ok &= (span >= 0) & (span == span[(last - 1).clamp_min(0)])
    return ok


def make_segments(stack: DriveStack, rows: Int[Tensor, " p"], epochs: int) -> list[Segment]:
    """Segments that start at rows of the stack."""
    drive = torch.searchsorted(stack.first_row, rows, right=True) - 1
    first = rows - stack.first_row[drive]
    return [Segment(d, f, epochs) for d, f in zip(drive.tolist(), first.tolist())]


def cut_segments(
    drives: Sequence[Drive],
    length_s: float,
    stride_s: float | None = None,
    *,
    attitude: bool = False,
    span: Int[Tensor, " rows"] | None = None,
) -> list[Segment]:
    """Segments of ``length_s`` every ``stride_s`` (default: end to end), only where the reference is valid.

    Where it is not, cutting goes on with the first boundary from which it can. Options as in
    :func:`possible_starts`.
    """
    stack = stack_drives(drives)
    epochs = count_epochs(length_s, stack.epoch_s)
    stride = epochs if stride_s is None else count_epochs(stride_s, stack.epoch_s)
    allowed = possible_starts(stack, epochs, attitude=attitude, span=span)
    candidates = torch.nonzero(allowed).flatten()
    drive = torch.searchsorted(stack.first_row, candidates, right=True) - 1
    chosen, free, now = [], -1, -1
    for row, d in zip(candidates.tolist(), drive.tolist()):
        if d != now:
            now, free = d, row
        if row >= free:
            chosen.append(row)
            free = row + stride
    return make_segments(stack, torch.tensor(chosen, dtype=torch.int64), epochs)


def find_unused_drives(drives: Sequence[Drive], segments: Sequence[Segment]) -> list[str]:
    """Names of the drives of which none of the segments is cut."""
    used = {segment.drive for segment in segments}
    return [drive.name for k, drive in enumerate(drives) if k not in used]


def describe_unused_drives(names: Sequence[str], of: int, segment: str, mend: str) -> str:
    """``3 of 10 drives, too short or not valid long enough for a segment of 120 s: a, b, c; …``: four names at most."""
    short = f"too short or not valid long enough for a {segment}"
    return f"{len(names)} of {of} drives, {short}: {list_some(names, 4)}; {mend}"


def make_batch(
    drives: Sequence[Drive],
    segments: Sequence[Segment],
    *,
    dtype: torch.dtype = torch.float32,
    start: StartLaw = StartLaw(),
    seed: int | None = None,
    generator: torch.Generator | None = None,
) -> Batch:
    """Cut segments out of drives; the tangent frame of each lies at its true (else GNSS) start.

    start = truth ⊞ (−δ), δ ~ N(0, Σ₀) of the law. With a ``seed`` it is drawn for each segment by itself
    (:mod:`dlkf.data.draws`), as a test needs it, else for the batch from ``generator``. Where the reference has no
    attitude, attitude and its std come from IMU and GNSS instead (the law's are then not added), and so does
    everything where there is no reference at all. Segments of different lengths are padded (``present``).
    Pass a :class:`DriveStack` where many batches are cut from the same drives.
    """
    stack = stack_drives(drives)
    drive, first, epochs = torch.tensor(segments, dtype=torch.int64).reshape(-1, 3).T
    if not len(drive):
        raise InputError("no segments: the drives are shorter than the length asked for, or never valid")
    row = stack.first_row[drive] + first
    origin = stack.origin[row]
    frame = tangent_frame(*origin.unbind(-1), dtype=dtype)
    truth = _state(frame, *(stack.rows[name][row] for name in ("ref_r_e", "ref_v_e", "ref_C_eb")))
    std = start.std.expand(len(drive), 9)
    if seed is None:
        noise = torch.randn(len(drive), 9, generator=generator, dtype=torch.float64)
    else:
        t_start = stack.t0[drive] + first * stack.epoch_s
        names = [stack[d].name for d in drive.tolist()]
        noise = draw_per_segment(
            lambda g: torch.randn(9, generator=g, dtype=torch.float64), seed, "start", names, t_start
        )
    dx = std * noise
    from_truth = stack.start_from_truth[row]
    if not bool(from_truth.all()):
        truth, std, dx = _fill_alignment(stack, row, frame, truth, std, dx)
    return _assemble(stack, drive, first, epochs, frame, truth.correct(-dx), std, dtype)


def whole_drives(drives: Sequence[Drive], starts: Sequence[Start], *, dtype: torch.dtype = torch.float64) -> Batch:
    """Complete drives from the given starts on, as one batch padded to the longest."""
    stack = stack_drives(drives)
    if len(starts) != len(stack):
        raise InputError(f"{len(stack)} drives but {len(starts)} starts; give one start per drive")
    first = torch.tensor([s.first for s in starts])
    llh = torch.tensor([(s.lat, s.lon, s.height) for s in starts], dtype=torch.float64)
    frame = tangent_frame(*llh.unbind(-1), dtype=dtype)
    state = NavState(*(torch.stack(x) for x in zip(*(s.state for s in starts))))
    std = torch.stack([s.std for s in starts])
    batch = _assemble(stack, torch.arange(len(stack)), first, stack.epochs - first, frame, state, std, dtype)
    if any(s.gyro is not None for s in starts):
        gyro = torch.stack([std.new_tensor(UNKNOWN_GYRO) if s.gyro is None else s.gyro for s in starts])
        batch = replace(batch, start_gyro=gyro.to(dtype))
    if any(s.noise is not None for s in starts):
        noise = torch.stack([std.new_ones(2) if s.noise is None else s.noise for s in starts])
        batch = replace(batch, start_noise=noise.to(dtype))
    return batch


def _fill_alignment(
    stack: DriveStack, row: Tensor, frame: TangentFrame, truth: NavState, std: Tensor, dx: Tensor
) -> tuple[NavState, Tensor, Tensor]:
    """Fill in what the reference lacks of the start from IMU and GNSS; no drawn error there."""
    a = stack.aligned
    guess = _state(frame, a.r_e[row], a.v_e[row], a.C_eb[row])
    no_reference = ~stack.rows["ref_valid"][row]
    no_attitude = ~stack.start_from_truth[row]
    if bool((no_attitude & ~a.ok[row]).any()):
        k = int(torch.nonzero(no_attitude & ~a.ok[row])[0])
        drive = int(torch.searchsorted(stack.first_row, row[k], right=True)) - 1
        t = stack[drive].t0 + float(row[k] - stack.first_row[drive]) * stack.epoch_s
        raise InputError(
            f"drive {stack[drive].name}: no start state at t = {t:.1f}: neither the reference nor GNSS in "
            "motion gives an attitude; start where the car moves"
        )
    replaced = torch.cat((no_reference[:, None].expand(-1, 6), no_attitude[:, None].expand(-1, 3)), -1)
    std = torch.where(replaced, a.std[row], std)
    dx = torch.where(replaced, torch.zeros_like(dx), dx)
    p = torch.where(no_reference[:, None], guess.p_n, truth.p_n)
    v = torch.where(no_reference[:, None], guess.v_n, truth.v_n)
    return NavState(p, v, torch.where(no_attitude[:, None, None], guess.C_nb, truth.C_nb)), std, dx


def _state(frame: TangentFrame, r_e: Tensor, v_e: Tensor, C_eb: Tensor) -> NavState:
    """ECEF states (B, …, 3) in the tangent frames; float64."""
    C_ne = frame.C_en.mT.reshape(-1, *(1,) * (r_e.ndim - 2), 3, 3)
    return NavState(frame.from_ecef(r_e), frame.rotate_from_ecef(v_e), C_ne @ C_eb)


def _assemble(
    stack: DriveStack,
    drive: Tensor,
    first: Tensor,
    epochs: Tensor,
    frame: TangentFrame,
    start: NavState,
    start_std: Tensor,
    dtype: torch.dtype,
) -> Batch:
    if bool((first < 0).any() | (epochs < 1).any() | (first + epochs > stack.epochs[drive]).any()):
        raise InputError("a segment reaches beyond its drive; cut it with cut_segments")
    T = int(epochs.max())
    step = torch.arange(T)
    present = step < epochs[:, None]
    step = torch.minimum(step, epochs[:, None] - 1)
    epoch = stack.first_epoch[drive, None] + first[:, None] + step
    row = stack.first_row[drive, None] + first[:, None] + step + 1
    imu = stack.imu.index_select(0, epoch.flatten()).reshape(*epoch.shape, *stack.imu.shape[1:]).to(dtype)
    if not bool(present.all()):
        imu[~present] = torch.tensor(REST, dtype=dtype)
    at = {name: values[row] for name, values in stack.rows.items()}
    aids = {name: (values[row] * present[..., None]).to(dtype) for name, values in stack.aids.items()}
    valid = at["gnss_valid"] & present[..., None]
    gnss = torch.cat((frame.from_ecef(at["gnss_r_e"]), frame.rotate_from_ecef(at["gnss_v_e"])), -1)
    truth = _state(frame, at["ref_r_e"], at["ref_v_e"], at["ref_C_eb"])
    truth_valid = at["ref_valid"] & present
    return Batch(
        imu=imu,
        dt=1.0 / stack.rate_hz,
        frame=frame,
        gnss=torch.where(valid, gnss, torch.zeros_like(gnss)).to(dtype),
        gnss_std=torch.nan_to_num(at["gnss_std"], nan=1.0).to(dtype),
        gnss_valid=valid,
        gnss_lag=(at["gnss_lag"] * present).to(dtype),
        available=present,
        lever_arm_b=stack.lever_arm_b[drive].to(dtype),
        start=NavState(*(x.to(dtype) for x in start)),
        start_std=start_std.to(dtype),
        truth=NavState(*(x.to(dtype) for x in truth)),
        truth_valid=truth_valid,
        attitude_valid=truth_valid & at["ref_C_eb"].isfinite().flatten(2).all(-1),
        true_imu_error=at["ref_imu_error"].to(dtype),
        present=present,
        drive=tuple(stack[d].name for d in drive.tolist()),
        t_start=stack.t0[drive] + first * stack.epoch_s,
        aids=aids,
    )
