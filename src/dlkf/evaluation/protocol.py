"""How drives become scenes: segments from the truth, or whole drives from their own alignment, with outages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from dlkf.base.errors import InputError
from dlkf.data.alignment import ALIGN, AlignConfig, Start
from dlkf.data.drive import Batch, Drive
from dlkf.data.masks import withhold_fixes
from dlkf.data.segments import (
    Segment,
    StartLaw,
    cut_segments,
    describe_unused_drives,
    find_unused_drives,
    make_batch,
    whole_drives,
)
from dlkf.data.stack import DriveStack, stack_drives
from dlkf.evaluation.outages import OutagePlan, bounds
from dlkf.evaluation.run import Scene
from dlkf.running.batched import CHUNK_SAMPLES, pack
from dlkf.running.start import align_each

if TYPE_CHECKING:
    from dlkf.data.datamodule import DriveDataModule

Item = TypeVar("Item")
MODES = ("auto", "segments", "drives")
LONG_S, STEP_S = 600, 30  # of long segments: the longest, and what they are shortened by
REFUSED = "rejected as implausible"  # of the rules: samples and fixes of drives


@dataclass(frozen=True)
class Protocol:
    """The rules of a comparison, the same for every filter (paper.md 4.5, 4.8).

    ``segments``: ``length_s`` every ``stride_s`` wherever the truth is valid, from the truth plus an error
    drawn from ``start``. ``drives``: whole drives from their own alignment (``align``), the outage repeated every
    ``every_s`` (default twice its length) in one run per offset (default 0 and its length: covers the drive).
    ``auto``: segments where the truth has attitude and is long enough, else drives.
    """

    mode: str = "auto"
    length_s: float = 120.0
    stride_s: float = 60.0
    start: StartLaw = field(default_factory=StartLaw)
    align: AlignConfig = ALIGN
    outage: OutagePlan | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise InputError(f"mode={self.mode} is none of {', '.join(MODES)}")
        for name in ("length_s", "stride_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}={getattr(self, name)} must be above 0 s")


class NoSegment(InputError):
    """Every drive is too short for a segment."""


class Scenes:
    """The scenes of a protocol over some drives; iterating cuts them again, a bounded part at a time.

    The same protocol gives the same scenes for all filters: each segment has its own draws of start error
    and outage. ``segments`` are those to use, else they are cut by the protocol; ``limit`` keeps so many, spread evenly
    over all. ``mode`` is the one chosen, ``outage`` the plan in whole epochs, ``runs`` the number of segments over all
    scenes, ``skipped`` the drives that cannot be used and why, ``short`` those of which no segment could be cut
    although segments are scored. InputError where nothing can be scored or no outage fits into the segments.
    """

    def __init__(
        self,
        drives: Sequence[Drive],
        protocol: Protocol,
        *,
        segments: Sequence[Segment] | None = None,
        limit: int | None = None,
    ) -> None:
        stack = stack_drives(drives)
        plan = protocol.outage and protocol.outage.in_whole_epochs(stack.epoch_s)
        self.short: tuple[str, ...] = ()
        self.refused = {drive.name: str(drive.refused) for drive in drives if any(drive.refused)}
        if segments is None and protocol.mode != "drives":
            attitude = protocol.mode == "auto"
            segments = cut_segments(stack, protocol.length_s, protocol.stride_s, attitude=attitude)
            self.short = tuple(find_unused_drives(stack, segments)) if segments else ()
        segments = spread_evenly(segments or (), limit)
        self.side: str | None = None
        self.mode = "segments" if protocol.mode == "segments" or segments else "drives"
        self.skipped: dict[str, str] = {}
        self._batches: list[tuple[Sequence[Drive], list[Any]]]  # segments or starts
        if self.mode == "segments":
            if not segments:
                raise NoSegment(
                    f"no segment of {protocol.length_s:g} s lies within valid truth; give a shorter length_s, "
                    "or mode=drives"
                )
            self._batches = [(stack, part) for part in _parts(segments, [p.epochs for p in segments], stack)]
            self.outage = plan and drives_that_fit(plan, protocol.length_s)
        else:
            starts = self._align(stack, protocol.align)
            starts = {d: starts[d] for d in spread_evenly(list(starts), limit)}
            order = sorted(starts, key=lambda d: -stack[d].epochs)  # like lengths together: little padding
            parts = _parts(order, [stack[d].epochs for d in order], stack)
            self._batches = [([stack[d] for d in part], [starts[d] for d in part]) for part in parts]
            self.outage = plan and repeat_outages(plan)
        self.protocol = protocol
        offsets = len(self.outage.offsets_s or ()) if self.outage else 1
        self.runs = offsets * sum(len(part) for _, part in self._batches)

    def __iter__(self) -> Iterator[Scene]:
        seed = self.protocol.seed
        for drives, part in self._batches:
            if self.mode == "segments":
                batch = make_batch(drives, part, dtype=torch.float64, start=self.protocol.start, seed=seed)
            else:
                batch = whole_drives(drives, part)
            if self.outage is None:
                yield batch, torch.zeros(batch.size[:2], dtype=torch.bool)
                continue
            for mask in self.outage.masks(batch, seed):
                yield batch, mask

    @classmethod
    def of_split(
        cls, data: DriveDataModule, side: str, outage: OutagePlan | None, seed: int, limit: int | None = None
    ) -> Scenes:
        """The scenes of the segments on one side of a split (``train``, ``val``, ``test``), of at most ``limit``."""
        segments, stride = data.segments(side), data.eval_stride_s or data.eval_length_s
        protocol = Protocol("segments", data.eval_length_s, stride, data.start, outage=outage, seed=seed)
        scenes = cls(data.stack, protocol, segments=segments, limit=limit)
        scenes.side = side
        return scenes

    @classmethod
    def of_long_segments(cls, data: DriveDataModule, side: str, seed: int) -> Scenes:
        """Segments of up to ten minutes without an outage, as long as four fifths of a side's time allow."""
        covered, scenes = len(data.segments(side)) * data.eval_length_s, cls.of_split(data, side, None, seed)
        for length in range(LONG_S, int(data.eval_length_s), -STEP_S):
            segments = cut_segments(data.stack, length, span=data.spans[side])
            if len(segments) * length >= 0.8 * covered:
                return cls(data.stack, Protocol("segments", length, length, data.start, seed=seed), segments=segments)
        return scenes

    def withhold(self) -> list[Batch]:
        """All batches with the outages applied."""
        return [withhold_fixes(batch, mask) for batch, mask in self]

    def describe(self) -> dict[str, Any]:
        """The rules as plain values, for files."""
        p = self.protocol
        common: dict[str, Any] = {"mode": self.mode, "runs": self.runs, "seed": p.seed}
        if self.side is not None:
            common["split"] = self.side
        if self.mode == "segments":
            common |= {"length_s": p.length_s, "stride_s": p.stride_s, "start": asdict(p.start)}
        else:
            common["start"] = "alignment from GNSS and levelling"
            common["align"] = asdict(p.align)
        common |= {REFUSED: self.refused} if self.refused else {}
        return common | {"outage": asdict(self.outage) if self.outage else None, "skipped": self.skipped}

    def _align(self, drives: Sequence[Drive], config: AlignConfig) -> dict[int, Start]:
        scored = [k for k, drive in enumerate(drives) if bool(drive.ref_valid.any())]
        for k in sorted(set(range(len(drives))) - set(scored)):
            lacks = "the reference has no valid row with position and velocity; reference=smoothed or gnss needs none"
            self.skipped[drives[k].name] = f"drive {drives[k].name}: {lacks}"
        starts: dict[int, Start] = {}
        for k, start in zip(scored, align_each([drives[k] for k in scored], config)):
            if isinstance(start, InputError):
                self.skipped[drives[k].name] = str(start)
            else:
                starts[k] = start
        if not starts:
            more = f" (and {len(self.skipped) - 1} more)" if len(self.skipped) > 1 else ""
            raise InputError(f"no drive can be scored: {next(iter(self.skipped.values()))}{more}")
        return starts


def describe_short(names: Sequence[str], of: int, protocol: Protocol) -> str:
    """One line on drives of which no segment could be cut."""
    known = " with a known attitude" if protocol.mode == "auto" else ""
    mend = "a shorter length_s takes more of them, mode=drives all"
    return describe_unused_drives(names, of, f"segment of {protocol.length_s:g} s{known}", mend)


def spread_evenly(items: Sequence[Item], limit: int | None) -> list[Item]:
    """At most ``limit`` items (None: all), at even distances over the whole sequence."""
    n = len(items)
    if limit is None or limit >= n:
        return list(items)
    return [items[(2 * k + 1) * n // (2 * limit)] for k in range(limit)]


def repeat_outages(plan: OutagePlan) -> OutagePlan:
    """The plan for whole drives: repeated to the end, in as many runs as cover the drive, where not given."""
    longest = bounds("outage.duration_s", plan.duration_s)[1]
    every = plan.every_s if plan.every_s is not None else 2.0 * longest
    return replace(plan, every_s=every, offsets_s=plan.offsets_s or (0.0, longest))


def drives_that_fit(plan: OutagePlan, length_s: float, length: str = "length_s", outage: str = "outage") -> OutagePlan:
    """The plan with its offsets; InputError, which names the settings, where segments are too short for it."""
    offsets = plan.offsets_s or (0.0,)
    end = bounds("outage.first_s", plan.first_s)[1] + bounds("outage.duration_s", plan.duration_s)[1] + max(offsets)
    if end > length_s + 1e-6:
        raise InputError(
            f"the outage ends after {end:g} s but segments are {length_s:g} s long; "
            f"give a larger {length}, or a smaller {outage}.first_s or {outage}.duration_s"
        )
    return replace(plan, offsets_s=offsets)


def _parts(items: Sequence, epochs: Sequence[int], stack: DriveStack) -> list[list]:
    """Items in order, as many together as four chunks hold when padded to the longest of them."""
    sizes = [n * stack.imu.shape[1] for n in epochs]
    return [[items[k] for k in part] for part in pack(sizes, 4 * CHUNK_SAMPLES)]
