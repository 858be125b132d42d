"""Logs that a recorder cut into several files: one table, where their stamps follow each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.readers.mapping import Mapped


def join_parts(parts: Sequence[Mapped]) -> Mapped | None:
    """The rows of files with the same columns, in the order of their stamps; None where these overlap."""
    if any(list(part.table.frame) != list(parts[0].table.frame) or not len(part) for part in parts):
        return None
    try:
        ends = [_find_ends(part) for part in parts]
    except InputError:  # stamps that cannot be read are refused with the file alone
        return None
    order = sorted(range(len(parts)), key=lambda k: ends[k][0])
    if any(ends[one][1] >= ends[two][0] for one, two in pairwise(order)):
        return None
    first, *others = (parts[k].table for k in order)
    frames = [first.frame]
    for table in others:
        lines = [f"{number} of {table.path.name}" for number in table.frame.index]
        frames.append(table.frame.set_axis(pd.Index(lines), axis=0))
    names = ", ".join(table.path.name for table in (first, *others))
    joined = replace(
        first,
        frame=pd.concat(frames),
        notes=(f"joined {names}", *(note for table in (first, *others) for note in table.notes)),
        beside=tuple(table.path for table in others),
    )
    return replace(parts[order[0]], table=joined)


def _find_ends(part: Mapped) -> tuple[tuple[int, float], tuple[int, float]]:
    """The first and the last stamp, whole seconds and the rest."""
    whole, rest = part.own_stamps()
    order = np.lexsort((rest, whole))
    first, last = ((int(whole[k]), float(rest[k])) for k in (order[0], order[-1]))
    return first, last
