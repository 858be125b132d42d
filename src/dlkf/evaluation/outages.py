"""Outage schedules: which epochs of a batch lose their fix, the same for every filter.

An outage of d seconds that starts at s withholds the fixes at s < t ≤ s + d. The last fix used is that of s,
and the error of the last withheld epoch is the error after exactly d seconds without GNSS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dlkf.base.errors import InputError, list_some
from dlkf.data.draws import draw_per_segment
from dlkf.data.drive import Batch
from dlkf.data.masks import mask_outage

UNUSED = "without outage"  # of the rules of an evaluation: drives of which none could be scored
FEW_NAMED = 4  # drives in a line
LAST_FIX_WITHIN_S = 2.0  # an outage counts from a fix: one must lie this close before its start


@dataclass(frozen=True)
class OutagePlan:
    """When GNSS is taken away [s since the start of a segment].

    ``first_s`` and ``duration_s`` are numbers, or (low, high): drawn for each segment, uniformly, in whole
    epochs. ``every_s`` repeats the outage to the end of the segment (None: one outage). Each of ``offsets_s``
    gives one run over the same segments with the whole schedule shifted, so that the windows cover a drive
    (none: one run, not shifted).
    """

    first_s: float | Sequence[float] = 60.0
    duration_s: float | Sequence[float] = 60.0
    every_s: float | None = None
    offsets_s: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _, high = bounds("outage.duration_s", self.duration_s, positive=True)
        bounds("outage.first_s", self.first_s)
        if min(self.offsets_s or (0.0,)) < 0:
            raise InputError("outage.offsets_s must be a list of numbers ≥ 0, such as [0]")
        if self.every_s is not None and self.every_s <= high:
            raise InputError(
                f"outage.every_s is {self.every_s:g} s but the outages last {high:g} s: "
                "leave time with GNSS between them"
            )

    def in_whole_epochs(self, epoch_s: float) -> OutagePlan:
        """The plan with every time rounded down to whole epochs, a duration to one at least."""

        def whole(seconds: float, least: int = 0) -> float:
            epochs = max(int(seconds / epoch_s + 1e-6), least)
            return seconds if abs(seconds - epochs * epoch_s) < 1e-6 * epoch_s else round(epochs * epoch_s, 9)

        def each(value: Any, least: int = 0) -> Any:
            if value is None or isinstance(value, (int, float)):
                return value and whole(value, least)
            return type(value)(whole(x, least) for x in value)

        return OutagePlan(each(self.first_s), each(self.duration_s, 1), each(self.every_s), each(self.offsets_s))

    def masks(self, batch: Batch, seed: int = 0) -> list[Tensor]:
        """One mask (B, T) per offset, True where a fix is withheld; only outages that can be scored stay.

        What is drawn for a segment depends on ``seed`` and on the segment alone (:mod:`dlkf.data.draws`).
        """
        B, T, _ = batch.size
        epoch_s = batch.epoch_s
        first = _draw(self.first_s, batch, seed, "first_s")
        duration = _draw(self.duration_s, batch, seed, "duration_s")
        repeats = 1 if self.every_s is None else max(1, int(T * epoch_s / self.every_s) + 1)
        out = []
        for offset in self.offsets_s or (0.0,):
            mask = torch.zeros(B, T, dtype=torch.bool)
            for k in range(repeats):
                start = first + offset + k * (self.every_s or 0.0)
                mask |= outage_mask(batch, start, duration)
            out.append(scorable_outages(batch, mask))
        return out


def outage_mask(batch: Batch, start_s: Tensor, duration_s: Tensor) -> Tensor:
    """True where an epoch's end t has start < t ≤ start + duration (B,); all False where that leaves it."""
    start, stop = start_s.double()[:, None], (start_s + duration_s).double()[:, None]
    slack = 1e-6 * batch.epoch_s
    length = batch.present.cpu().sum(-1, keepdim=True) * batch.epoch_s
    return mask_outage(batch, start_s, duration_s) & (start > -slack) & (stop <= length + slack)


def scorable_outages(batch: Batch, outage: Tensor) -> Tensor:
    """The mask without the outages whose truth is not known throughout, or that no fix precedes closely."""
    truth = batch.truth_valid.cpu() & batch.present.cpu()
    position = batch.gnss_valid[..., :3].all(-1).cpu() & batch.available.cpu()
    reach = max(1, round(LAST_FIX_WITHIN_S / batch.epoch_s))
    before = torch.nn.functional.pad(position, (reach, 0))  # column t + reach is epoch t
    recent = before.unfold(1, reach, 1)[:, : outage.shape[1]].any(-1)  # a fix in the `reach` epochs before t
    first = outage & ~torch.nn.functional.pad(outage, (1, 0))[:, :-1]
    bad_start = first & ~recent
    bad_start[:, 0] = False  # an outage from the very start counts from the initial state
    window = first.long().cumsum(-1) * outage  # 1, 2, … within each outage, 0 outside
    faulty = torch.zeros(outage.shape[0], int(window.max()) + 1, dtype=torch.long)
    faulty.scatter_add_(1, window, (outage & (~truth | bad_start)).long())
    return outage & (faulty.gather(1, window) == 0)


def describe_rounding(plan: OutagePlan | None, epoch_s: float) -> str:
    """One line on the times of a plan that are not whole epochs, with those that are taken; empty if all are."""
    rounded = plan and plan.in_whole_epochs(epoch_s)
    if plan is None or rounded is None or rounded == plan:
        return ""
    before, after = asdict(plan), asdict(rounded)
    changed = [f"outage.{name}={_as_text(after[name])}" for name in before if before[name] != after[name]]
    return f"rounded to whole epochs of {epoch_s:g} s: {', '.join(changed)}"


def describe_unused(plan: OutagePlan, outage: np.ndarray, ends_s: np.ndarray, drives: Sequence[str]) -> str:
    """One line on drives without an outage that could be scored, empty if there is none.

    ``outage`` (P, T) has the masks of the segments, ``ends_s`` (P,) the last time of their truth [s since the start],
    ``drives`` (P,) their names.
    """
    first, duration = (bounds(f"outage.{name}", getattr(plan, name))[0] for name in ("first_s", "duration_s"))
    longest: dict[str, float] = {}
    for drive, end in zip(drives, ends_s):
        longest[drive] = max(longest.get(drive, 0.0), float(end))
    used = {drive for drive, mask in zip(drives, outage) if mask.any()}
    unused = sorted(set(longest) - used)
    short = [drive for drive in unused if longest[drive] < first + duration]
    needed = f"outage.first_s={first:g} + outage.duration_s={duration:g} s"
    said = [
        f"{list_some(names, FEW_NAMED)} {why}"
        for names, why in (
            (short, f"too short for {needed}"),
            ([d for d in unused if d not in short], "without a fix at its start or valid truth throughout"),
        )
        if names
    ]
    return f"no outage in {len(unused)} of {len(longest)} drives: {'; '.join(said)}" if unused else ""


def check_outages(plan: OutagePlan | None, withheld: Tensor | np.ndarray, longest_s: float) -> None:
    """Raises InputError where a plan was given and nothing was ``withheld``: no outage could be scored.

    ``longest_s``: from the first fix to the last of the longest drive.
    """
    if plan is not None and not withheld.any():
        raise InputError(
            f"no outage fits into these drives: outage.first_s={plan.first_s} and outage.duration_s={plan.duration_s} "
            f"need a fix at its start and valid truth throughout; the longest drive has {longest_s:.0f} s with GNSS; "
            "give smaller ones, or outage=null"
        )


def bounds(name: str, value: float | Sequence[float], positive: bool = False) -> tuple[float, float]:
    """Least and greatest of a number or (low, high), ≥ 0 or > 0; InputError for what is neither."""
    values = [value] if isinstance(value, (int, float)) else list(value)
    wrong = len(values) not in (1, 2) or not np.isfinite(values).all() or values[0] > values[-1]
    if wrong or min(values) < 0 or (positive and min(values) == 0):
        several = f"; for a run each -m {name}={','.join(f'{x:g}' for x in values)}" if len(values) > 2 else ""
        given, least = values if len(values) > 1 else values[0], "> 0" if positive else "≥ 0"
        raise InputError(f"{name} is {given}, must be a number {least} or [low, high] in seconds{several}")
    return float(values[0]), float(values[-1])


def _as_text(value: float | Sequence[float]) -> str:
    return f"{value:g}" if isinstance(value, (int, float)) else f"[{','.join(f'{x:g}' for x in value)}]"


def _draw(value: float | Sequence[float], batch: Batch, seed: int, name: str) -> Tensor:
    low, high = bounds(f"outage.{name}", value)
    steps = round((high - low) / batch.epoch_s)
    if not steps:
        return torch.full((batch.size[0],), low, dtype=torch.float64)

    def whole_epochs(generator: torch.Generator) -> Tensor:
        return torch.randint(0, steps + 1, (), generator=generator)

    draws = draw_per_segment(whole_epochs, seed, f"outage.{name}", batch.drive, batch.t_start)
    return low + draws.double() * batch.epoch_s
