"""Training, validation and test split: whole recordings on one side (paper.md 4.8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from dlkf.base.errors import InputError, list_some
from dlkf.data.segments import count_epochs
from dlkf.data.stack import DriveStack

SIDES = ("train", "val", "test")
Split = str | Mapping[str, Sequence[str] | str]


def split_rows(
    stack: DriveStack, split: Split, fractions: Sequence[float], seed: int, block_s: float
) -> dict[str, Int[Tensor, " rows"]]:
    """For each side a label per boundary, that of the epoch it begins; −1 belongs to none.

    Segments of a side stay inside one label.

    ``split``: "group" assigns whole groups by ``fractions`` of the driving time; a mapping names the groups
    of each side ("all" and "rest" may stand for lists); "random" shuffles blocks of ``block_s``, as the paper
    did, so that neighbours in time come to lie on both sides. Raises InputError if a side that should have
    something gets nothing, or a group is unknown or on two sides.
    """
    if split == "random":
        return _shuffle_blocks(stack, _check_fractions(fractions), seed, count_epochs(block_s, stack.epoch_s))
    if split == "group":
        sides = _split_by_time(stack, _check_fractions(fractions), seed)
    elif isinstance(split, Mapping):
        sides = _split_by_name(stack, split)
    else:
        raise InputError(f"split={split}: must be group, random, or a mapping of train, val and test to groups")
    labels = {}
    for side in SIDES:
        of_drive = torch.tensor([i if d.group in sides[side] else -1 for i, d in enumerate(stack)])
        labels[side] = torch.repeat_interleave(of_drive, stack.epochs + 1)
    return labels


def _check_fractions(fractions: Sequence[float]) -> list[float]:
    values = [float(f) for f in fractions]
    if len(values) != 3 or min(values) < 0 or abs(sum(values) - 1) > 1e-6:
        raise InputError(f"fractions={values}: must be three numbers ≥ 0 for train, val and test with sum 1")
    return values


def _split_by_time(stack: DriveStack, fractions: list[float], seed: int) -> dict[str, set[str]]:
    """Groups in random order, each to the side that lacks most of its share of the driving time."""
    time: dict[str, int] = {}
    for d in stack:
        time[d.group] = time.get(d.group, 0) + d.epochs
    wanted = [side for side, f in zip(SIDES, fractions) if f > 0]
    if len(time) < len(wanted):
        raise InputError(
            f"split by group needs a group for each of {', '.join(wanted)}, but the drives have only {len(time)} "
            f"({', '.join(sorted(time))}); add recordings, or set fractions or split (data.fractions "
            "and data.split in train)"
        )
    names = sorted(time)
    order = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    share = {side: f * sum(time.values()) for side, f in zip(SIDES, fractions)}
    sides: dict[str, set[str]] = {side: set() for side in SIDES}
    for k, group in enumerate(order):
        empty = [s for s in wanted if not sides[s]]
        choice = empty if len(order) - k <= len(empty) else wanted
        side = max(choice, key=lambda s: share[s] - sum(time[g] for g in sides[s]))
        sides[side].add(group)
    return sides


def _split_by_name(stack: DriveStack, split: Mapping[str, Sequence[str] | str]) -> dict[str, set[str]]:
    known = {d.group for d in stack}
    if unknown := sorted(set(split) - set(SIDES)):
        raise InputError(f"split: unknown side {unknown[0]}; known are {', '.join(SIDES)}")
    sides: dict[str, set[str]] = {side: set() for side in SIDES}
    for side, groups in split.items():
        if groups in ("all", "rest"):
            continue
        listed = [groups] if isinstance(groups, str) else [str(g) for g in groups or ()]
        if missing := [g for g in listed if g not in known]:
            raise InputError(f"split.{side}: no group {missing[0]}; has {list_some(sorted(known))}")
        sides[side] = set(listed)
    taken = set().union(*sides.values())
    for side, groups in split.items():
        if groups == "all":
            sides[side] = set(known)
        elif groups == "rest":
            sides[side] = known - taken
    for a, b in (("train", "val"), ("train", "test"), ("val", "test")):
        if shared := sorted(sides[a] & sides[b]):
            raise InputError(f"split: group {shared[0]} is in {a} and in {b}; a recording may be on one side only")
    if empty := [side for side in split if not sides[side]]:
        raise InputError(f"split.{empty[0]}: has no group; name at least one or leave the side out")
    return sides


def _shuffle_blocks(
    stack: DriveStack, fractions: list[float], seed: int, block: int
) -> dict[str, Int[Tensor, " rows"]]:
    labels = torch.full((int((stack.epochs + 1).sum()),), -1, dtype=torch.int64)
    count = 0
    for first, epochs in zip(stack.first_row.tolist(), stack.epochs.tolist()):
        blocks = epochs // block
        labels[first : first + blocks * block] = count + torch.arange(blocks).repeat_interleave(block)
        count += blocks
    if count < 3:
        raise InputError(f"split=random: only {count} blocks of the segment length; use shorter segments or more data")
    order = np.random.default_rng(seed).permutation(count)
    edges = np.round(np.cumsum([0.0, *fractions]) * count).astype(int)
    sides = {}
    for side, low, high, fraction in zip(SIDES, edges[:-1], edges[1:], fractions):
        if fraction > 0 and high == low:
            raise InputError(f"split=random: {count} blocks leave none for {side}; use shorter segments or more data")
        mine = torch.zeros(count + 1, dtype=torch.bool)
        mine[torch.from_numpy(order[low:high].copy())] = True
        sides[side] = torch.where(mine[labels], labels, -1)
    return sides
