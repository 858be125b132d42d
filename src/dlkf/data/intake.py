"""Foreign logs into a dataset: read, split at gaps, write, check, all or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml

from dlkf.data.plausibility import drift_told, turned_told
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.schema import new_dataset, write_drive, write_drives_table
from dlkf.data.summary import drive_line
from dlkf.data.tables import DriveRow, read_drives
from dlkf.data.validate import LIMITS, Limits, fixes, gap_rows, read_checked, read_imu
from dlkf.errors import InputError
from dlkf.files import absolute, whole_file
from dlkf.parallel import check, each


class Taken(NamedTuple):
    """What became of a log: its parts' rows of ``drives.parquet`` with a line each, what was met on the way, and the
    mapping that was found out."""

    rows: list[dict[str, Any]]
    lines: list[str]
    notes: tuple[str, ...]
    mapping: dict[str, Any]


@dataclass(frozen=True)
class Intake:
    """How a drive is taken in: cut at its gaps or not, what is left out, what is accepted."""

    split_gaps: bool = False
    shortest_s: float = 10.0
    limits: Limits = LIMITS

    def taken(self, drive: DriveFrames, folder: str | Path) -> Taken:
        """Write a drive into a dataset's folder and check what lies there; InputError for the first fault."""
        rows, lines, told = [], [], list(drive.notes)
        for part in split_at_gaps(drive, self.shortest_s, self.limits) if self.split_gaps else [drive]:
            rows.append(write_drive(folder, part.meta, part.imu, part.gnss, part.reference))
            if part.gnss is not None:
                tables = read_checked(folder, DriveRow(part.name, part.name, (0.0, 0.0, 0.0)), limits=self.limits)
                for check in (drift_told, turned_told):
                    if line := check(tables.imu, fixes(tables.gnss)):
                        told.append(f"{part.name}: {line}")
            else:
                read_imu(folder, part.name, self.limits)
            lines.append(f"{part.name}: {drive_line(part)}")
        return Taken(rows, lines, tuple(told), drive.mapping)


def ingest(
    reader: Any,
    source: str | Path,
    out: str | Path,
    how: Intake,
    *,
    parallel: int | str | None,
    **options: Any,
) -> int:
    """:func:`ingest_drives` of what a reader makes of ``source``; one that knows the places of its drives
    (``places``, ``drive_at``) reads them on ``parallel`` engines (:func:`dlkf.parallel.each`)."""
    check(parallel, out)
    if parallel is None or not hasattr(reader, "places"):
        return ingest_drives(reader.read(source), out, how, **options)
    places = [(absolute(folder), name, only and absolute(only)) for folder, name, only in reader.places(source)]

    def taking(folder: str) -> Iterable[Taken]:
        return each(partial(_read_there, reader, how, absolute(folder)), places, parallel)

    return _ingested(taking, out, how, **options)


def _read_there(reader: Any, how: Intake, out: str, place: tuple[str, str, str | None]) -> Taken:
    folder, name, only = place
    return how.taken(reader.drive_at(Path(folder), name, only and Path(only)), out)


def ingest_drives(drives: Iterable[DriveFrames], out: str | Path, how: Intake = Intake(), **options: Any) -> int:
    """Write drives as a dataset at ``out`` and return how many there are.

    With ``split_gaps`` a drive with IMU gaps becomes parts ``<drive>-s0``, ``-s1``, … of one group; parts
    shorter than ``shortest_s`` or, of a log with GNSS, without fixes are left out. ``progress(taken, done)`` is called
    after each log, ``overwrite`` replaces what lies at ``out``.
    What readers found out stands in ``reader/found.yaml``, as a preset that reads the same logs again and that a person
    can correct. Raises InputError, leaving nothing behind, if a drive does not pass the checks or none is left.
    """
    return _ingested(lambda folder: (how.taken(drive, folder) for drive in drives), out, how, **options)


def _ingested(
    taking: Callable[[str], Iterable[Taken]],
    out: str | Path,
    how: Intake,
    *,
    overwrite: bool = False,
    progress: Callable[[Taken, int], None] | None = None,
) -> int:
    rows: list[dict[str, Any]] = []
    mappings: list[dict[str, Any]] = []
    with new_dataset(out, overwrite) as folder:
        for taken in taking(str(folder)):
            mappings += [taken.mapping] if taken.mapping else []
            rows += taken.rows
            if progress is not None:
                progress(taken, len(rows))
        if not rows:
            raise InputError(f"out={out}: no drive of at least {how.shortest_s:g} s with GNSS; nothing was written")
        write_drives_table(folder, rows)
        if mappings:
            write_found(folder / "reader" / "found.yaml", mappings)
        read_drives(folder)
    return len(rows)


def write_found(path: Path, mappings: Sequence[dict[str, Any]]) -> None:
    """One preset for all drives: settings in which they differ are left to be found out for each (``auto``)."""
    head = (
        "# Found out by dlkf.ingest. Correct it where it is wrong, then read the logs again:\n"
        "#   python -m dlkf.ingest --config-dir <this dataset> reader=found source=<the logs> out=<another dataset>\n"
    )
    with whole_file(path) as beside:
        beside.write_text(head + yaml.safe_dump(_agreed(mappings), sort_keys=False, allow_unicode=True))


def _agreed(values: Sequence[Any]) -> Any:
    first = values[0]
    if all(isinstance(v, dict) and v.keys() == first.keys() for v in values) and set(first) != {"roll", "pitch", "yaw"}:
        return {key: _agreed([v[key] for v in values]) for key in first}
    return first if all(v == first for v in values) else "auto"


def split_at_gaps(drive: DriveFrames, shortest_s: float, limits: Limits) -> Iterator[DriveFrames]:
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
