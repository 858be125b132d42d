"""Foreign logs into a dataset: read, split at gaps, write, check, all or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from dlkf.data.readers.frames import DriveFrames
from dlkf.data.schema import new_dataset, write_drive, write_drives_table
from dlkf.data.tables import read_drives
from dlkf.data.validate import LIMITS, Limits, gap_rows, read_checked, read_imu
from dlkf.errors import InputError


def ingest_drives(
    drives: Iterable[DriveFrames],
    out: str | Path,
    *,
    split_gaps: bool = False,
    shortest_s: float = 10.0,
    overwrite: bool = False,
    limits: Limits = LIMITS,
    progress: Callable[[DriveFrames, int], None] | None = None,
) -> int:
    """Write drives as a dataset at ``out`` and return how many there are.

    With ``split_gaps`` a drive with IMU gaps becomes parts ``<drive>-s0``, ``-s1``, … of one group; parts
    shorter than ``shortest_s`` or, of a log with GNSS, without fixes are left out. ``progress(drive, done)`` is called
    after each.
    What readers found out stands in ``reader/found.yaml``, as a preset that reads the same logs again and that a person
    can correct. Raises InputError, leaving nothing behind, if a drive does not pass the checks or none is left.
    """
    rows: list[dict[str, Any]] = []
    mappings: list[dict[str, Any]] = []
    with new_dataset(out, overwrite) as folder:
        for drive in drives:
            mappings += [drive.mapping] if drive.mapping else []
            for part in split_at_gaps(drive, shortest_s, limits) if split_gaps else [drive]:
                rows.append(write_drive(folder, part.meta, part.imu, part.gnss, part.reference))
                if progress is not None:
                    progress(part, len(rows))
        if not rows:
            raise InputError(f"out={out}: no drive of at least {shortest_s:g} s with GNSS; nothing was written")
        write_drives_table(folder, rows)
        if mappings:
            write_found(folder / "reader" / "found.yaml", mappings)
        for row in read_drives(folder):
            if (folder / "gnss" / f"drive={row.name}").is_dir():
                read_checked(folder, row, limits=limits)
            else:
                read_imu(folder, row.name, limits)
    return len(rows)


def write_found(path: Path, mappings: Sequence[dict[str, Any]]) -> None:
    """One preset for all drives: settings in which they differ are left to be found out for each (``auto``)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = (
        "# Found out by dlkf.ingest. Correct it where it is wrong, then read the logs again:\n"
        "#   python -m dlkf.ingest --config-dir <this dataset> reader=found source=<the logs> out=<another dataset>\n"
    )
    path.write_text(head + yaml.safe_dump(_agreed(mappings), sort_keys=False, allow_unicode=True))


def _agreed(values: Sequence[Any]) -> Any:
    first = values[0]
    if all(isinstance(v, dict) and v.keys() == first.keys() for v in values) and set(first) != {"roll", "pitch", "yaw"}:
        return {key: _agreed([v[key] for v in values]) for key in first}
    return first if all(v == first for v in values) else "auto"


def split_at_gaps(drive: DriveFrames, shortest_s: float, limits: Limits = LIMITS) -> Iterator[DriveFrames]:
    """The parts of a drive between its IMU gaps; the drive itself where it has none."""
    t = drive.imu["t"].to_numpy()
    gaps = gap_rows(t, limits)
    if not len(gaps):
        yield drive
        return
    edges = np.concatenate(([0], gaps, [len(t)]))
    count = 0
    for first, last in pairwise(edges):
        begin, end = t[first], t[last - 1]
        gnss = None if drive.gnss is None else _between(drive.gnss, begin, end)
        if end - begin < shortest_s or (gnss is not None and not len(gnss)):
            continue
        reference = None if drive.reference is None else _between(drive.reference, begin, end)
        if reference is not None and not len(reference):
            reference = None
        yield replace(
            drive,
            meta={**drive.meta, "drive": f"{drive.name}-s{count}"},
            imu=drive.imu.iloc[first:last].reset_index(drop=True),
            gnss=gnss,
            reference=reference,
        )
        count += 1


def _between(frame: pd.DataFrame, begin: float, end: float) -> pd.DataFrame:
    t = frame["t"]
    return frame[(t >= begin) & (t <= end)].reset_index(drop=True)
