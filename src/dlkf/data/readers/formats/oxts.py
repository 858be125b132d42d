"""KITTI raw drives: a folder oxts/ with timestamps.txt and a text file of 30 values per row (OxTS RT3003).

Columns are named as in KITTI's dataformat.txt; ``t`` is the calendar text of timestamps.txt.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.readers.frames import LogTable

NAMES = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au"),
    *("wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy", "navstat", "numsats"),
    *("posmode", "velmode", "orimode"),
)


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """The rows beside ``path``, the timestamps.txt; rows without a stamp or a file are left out."""
    stamps = path.read_text(encoding="ascii", errors="replace").splitlines()
    files = sorted((path.parent / "data").glob("*.txt"))
    if not files:
        raise InputError(f"{path.parent}: has no data/*.txt; give the folder of a KITTI raw drive")
    rows, kept, notes = [], [], []
    for file in files:
        number = int(file.stem) if file.stem.isdigit() else -1
        cells = file.read_text(encoding="ascii", errors="replace").split()
        if not 0 <= number < len(stamps) or not stamps[number].strip() or len(cells) < 25:
            notes.append(f"{file.name}: has {len(cells)} of 30 values or no stamp, left out")
            continue
        try:
            rows.append(np.array([float(c) for c in cells[:30]] + [np.nan] * (30 - len(cells[:30]))))
        except ValueError:
            raise InputError(f"{file}: holds something that is no number; correct or remove it") from None
        kept.append(number)
    frame = pd.DataFrame(rows, columns=list(NAMES), index=pd.Index(kept))
    frame.insert(0, "t", [stamps[k].strip() for k in kept])
    order = np.argsort(frame["t"].to_numpy(), kind="stable")  # KITTI's unsynced rows come out of order here and there
    frame = frame.iloc[order]
    again = frame["t"].duplicated()
    if bool(again.any()):
        notes.append(f"{path.parent.name}: {int(again.sum())} rows with the stamp of the row before, left out")
    return LogTable(frame[~again], path, "row", tuple(notes[:3]))
