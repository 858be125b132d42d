"""Foreign logs into a dataset: read, split at gaps, write, check, all or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from dlkf.base.errors import InputError
from dlkf.base.files import absolute_place, is_url, replace_file
from dlkf.base.parallel import check_engine, parallel_map
from dlkf.data.plausibility import describe_clocks
from dlkf.data.readers.frames import DriveFrames, Place
from dlkf.data.readers.settling import Unsure
from dlkf.data.readers.sharing import agrees, layout, list_settings, pool_settings
from dlkf.data.schema import new_dataset, remove_drive, write_drive, write_drives_table
from dlkf.data.summary import describe_cover, drive_line
from dlkf.data.tables import DriveRow, read_drives
from dlkf.data.validate import LIMITS, Limits, find_gaps, read_drive, read_fixes, read_imu


class IngestResult(NamedTuple):
    """What became of a log: its parts' rows of ``drives.parquet`` with a line each, notes on the way, and the
    mapping that was found out."""

    rows: list[dict[str, Any]]
    lines: list[str]
    notes: tuple[str, ...]
    mapping: dict[str, Any]


@dataclass(frozen=True)
class IngestOptions:
    """How a drive is taken in: cut at its gaps or not, what is left out, what is accepted."""

    split_gaps: bool = False
    shortest_s: float = 10.0
    limits: Limits = LIMITS

    def take_in(self, drive: DriveFrames, folder: str | Path) -> IngestResult:
        """Write a drive into a dataset's folder and check what lies there; InputError for the first fault, with
        nothing of the drive left."""
        rows, lines, detail = [], [], list(drive.notes)
        try:
            for part in split_at_gaps(drive, self.shortest_s, self.limits) if self.split_gaps else [drive]:
                rows.append(write_drive(folder, part.meta, part.imu, part.gnss, part.reference, part.aids))
                if part.gnss is not None:
                    tables = read_drive(folder, DriveRow(part.name, part.name, (0.0, 0.0, 0.0)), limits=self.limits)
                    fixes = read_fixes(tables.gnss)
                    said = [describe_cover(tables.imu, fixes), *describe_clocks(tables.imu, fixes)]
                    detail += [f"{part.name}: {line}" for line in said if line]
                else:
                    read_imu(folder, part.name, self.limits)
                lines.append(f"{part.name}: {drive_line(part)}")
        except InputError:
            for name in (drive.name, *(str(row["drive"]) for row in rows)):
                remove_drive(folder, name)
            raise
        return IngestResult(rows, lines, tuple(detail), drive.mapping)


def ingest(
    reader: Any,
    source: str | Path,
    out: str | Path,
    how: IngestOptions,
    *,
    parallel: int | str | None,
    skip_unsure: bool = False,
    **options: Any,
) -> int:
    """:func:`ingest_drives` of what a reader makes of ``source``; one that has the places of its drives
    (``places``, ``drive_at``) reads them on ``parallel`` engines (:func:`dlkf.base.parallel.parallel_map`).

    Drives that are not sure of a setting are read again with what the others of the same IMU found. One that still is
    not, or is faulty, raises its InputError, or is left out with ``skip_unsure``.
    """
    check_engine(parallel, out)
    if not is_url(source) and (Path(source) / "drives.parquet").is_file():
        raise InputError(f"source={source}: is a dataset already; navigate and evaluate take dataset={source}")
    if not hasattr(reader, "places"):
        return ingest_drives(reader.read(source), out, how, **options)
    places = reader.places(source)

    def taking(folder: str) -> Iterable[IngestResult]:
        take_in = partial(how.take_in, folder=absolute_place(folder))
        return read_together(reader, take_in, places, parallel, skip_unsure)

    return _write_dataset(taking, out, how, **options)


TakeIn = Callable[[DriveFrames], IngestResult]  # what becomes of a drive that was read


def read_together(
    reader: Any, take_in: TakeIn, places: Sequence[Place], parallel: int | str | None, skip_unsure: bool
) -> Iterator[IngestResult]:
    """What ``take_in`` makes of the drives at a reader's places that are sure, then of those that are with what these
    found, then lines on those that disagree and on those that are left out."""
    places = [(Path(folder).absolute(), name, only and Path(only).absolute()) for folder, name, only in places]
    doubts: dict[Place, Unsure] = {}
    faults: list[InputError] = []
    several = "; or skip_unsure=true leaves such drives out" if len(places) > 1 else ""
    mappings: list[dict[str, Any]] = []

    def read_all(reader: Any, places: Sequence[Place]) -> Iterator[tuple[Place, IngestResult]]:
        for place, result in zip(places, parallel_map(partial(_read_there, reader, take_in), places, parallel)):
            doubts.pop(place, None)
            if isinstance(result, Unsure):
                doubts[place] = result
            elif isinstance(result, InputError):
                if not skip_unsure:
                    raise InputError(f"{result}{several}")
                faults.append(result)
            else:
                yield place, result

    for _, result in read_all(reader, places):
        mappings += [result.mapping] if result.mapping else []
        yield result
    kinds = {layout(mapping): [m for m in mappings if layout(m) == layout(mapping)] for mapping in mappings}
    for kind, alike in kinds.items():
        settings, apart = pool_settings(alike, offsets=False)
        if apart:
            yield IngestResult([], [], tuple(apart), {})
        for offsets in (False, True) if hasattr(reader, "with_settings") else ():
            settings, _ = pool_settings(alike, offsets=offsets)
            again = [place for place, doubt in doubts.items() if doubt.layout == kind]
            if offsets:
                again = [place for place in again if agrees(settings, *doubts[place].offset_s)]
            shared = f"not sure by itself: took {list_settings(settings)}, found in other drives ({len(alike)})"
            for (_, name, _), result in read_all(reader.with_settings(settings), again):
                yield result._replace(notes=(f"{name}: {shared}", *result.notes))
    if doubts and not skip_unsure:
        first = next(iter(doubts.values()))
        raise InputError(f"{first}{several}") if several else first
    for fault in (*faults, *doubts.values()):
        yield IngestResult([], [], (f"left out: {fault}",), {})


def _read_there(reader: Any, take_in: TakeIn, place: Place) -> IngestResult | InputError:
    try:
        return take_in(reader.drive_at(*place))
    except InputError as fault:
        return fault
    except MemoryError:
        return InputError(f"drive {place[1]}: its logs do not fit into memory; split them, or write Parquet")


def ingest_drives(
    drives: Iterable[DriveFrames], out: str | Path, how: IngestOptions = IngestOptions(), **options: Any
) -> int:
    """Write drives as a dataset at ``out`` and return how many there are.

    With ``split_gaps`` a drive with IMU gaps becomes parts ``<drive>-s0``, ``-s1``, … of one group; parts
    shorter than ``shortest_s`` or, of a log with GNSS, without fixes are left out. ``progress(taken, done)`` is called
    after each log, ``overwrite`` replaces what lies at ``out``.
    What readers found out stands in ``reader/found.yaml``, as a preset that reads the same logs again and that a person
    can correct. Raises InputError, leaving nothing behind, if a drive does not pass the checks or none is left.
    """
    return _write_dataset(lambda folder: (how.take_in(drive, folder) for drive in drives), out, how, **options)


def _write_dataset(
    taking: Callable[[str], Iterable[IngestResult]],
    out: str | Path,
    how: IngestOptions,
    *,
    overwrite: bool = False,
    progress: Callable[[IngestResult, int], None] | None = None,
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
    with replace_file(path) as beside:
        beside.write_text(
            head + yaml.safe_dump(_merge_values(mappings), sort_keys=False, allow_unicode=True), encoding="utf-8"
        )


def _merge_values(values: Sequence[Any]) -> Any:
    first = values[0]
    if all(isinstance(v, dict) and v.keys() == first.keys() for v in values) and set(first) != {"roll", "pitch", "yaw"}:
        return {key: _merge_values([v[key] for v in values]) for key in first}
    return first if all(v == first for v in values) else "auto"


def split_at_gaps(drive: DriveFrames, shortest_s: float, limits: Limits) -> Iterator[DriveFrames]:
    """The parts of a drive between its IMU gaps; the drive itself where it has none."""
    t = drive.imu["t"].to_numpy()
    gaps = find_gaps(t, limits)
    if not len(gaps):
        yield drive
        return
    edges = np.concatenate(([0], gaps, [len(t)]))
    tables = {"gnss": drive.gnss, "reference": drive.reference, **drive.aids}
    count = 0
    for first, last in pairwise(edges):
        begin, end = t[first], t[last - 1]
        cut = {kind: table[table["t"].between(begin, end)] for kind, table in tables.items() if table is not None}
        kept = {kind: table.reset_index(drop=True) for kind, table in cut.items() if len(table)}
        if end - begin < shortest_s or (drive.gnss is not None and "gnss" not in kept):
            continue
        yield replace(
            drive,
            meta={**drive.meta, "drive": f"{drive.name}-s{count}"},
            imu=drive.imu.iloc[first:last].reset_index(drop=True),
            gnss=kept.pop("gnss", None),
            reference=kept.pop("reference", None),
            aids=kept,
        )
        count += 1
