"""Drives from log files of any format: the one way from a folder of logs to the contract's tables.

A file of some format gives a table in its own columns (:mod:`dlkf.data.readers.formats`); the mapping of the reader's
configuration (``conf/reader/csv.yaml`` explains every key) defines the columns; the result is a drive in the
contract's units, axes and clock.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError, list_some
from dlkf.base.settings import is_number, settings_from
from dlkf.data.discovery.findings import Sure
from dlkf.data.readers import formats
from dlkf.data.readers.aids import read_aids
from dlkf.data.readers.archives import drive_name, drive_places, is_archive, unpack
from dlkf.data.readers.contract import drop_zero_stds, gnss_frame, imu_frame, reference_frame
from dlkf.data.readers.formats import rosbag
from dlkf.data.readers.frames import DriveFrames, Place
from dlkf.data.readers.mapping import (
    MOST_NAMED,
    SOURCE,
    Mapped,
    Spec,
    check_keys,
    list_unused,
    select_rows,
    spread_stamps,
)
from dlkf.data.readers.parts import join_parts
from dlkf.data.readers.settling import AUTO, Unsure, open_settings, placeholders, settle
from dlkf.data.readers.sharing import layout
from dlkf.data.readers.stamps import epoch_note, local_time_s
from dlkf.data.validate import check_time

TEXT = ("separator", "decimal", "header", "comment", "skip_rows", "encoding")
NEAR_S = 0.05  # rows of two GNSS tables this close are of one fix
FRAMES = {"imu": imu_frame, "gnss": gnss_frame, "reference": reference_frame}


class LogReader:
    """Reads a file, a folder with one drive's files, or a folder with one subfolder per drive.

    ``imu``, ``gnss``, ``reference``, ``speed``, ``heading`` and ``baro`` give format, file, columns, units, axes and
    clock as the comments of ``conf/reader/csv.yaml`` explain; the other arguments are the format of text files and the
    drive's row in ``drives.parquet``. All errors are InputErrors with file, and column or line.
    """

    def __init__(
        self,
        imu: Spec,
        gnss: Spec,
        reference: Spec | None = None,
        *,
        speed: Spec | None = None,
        heading: Spec | None = None,
        baro: Spec | None = None,
        separator: str = ",",
        decimal: str = ".",
        header: bool = True,
        comment: str | None = None,
        skip_rows: int = 0,
        encoding: str | None = None,
        time_zero: str = "imu",
        drive: str | None = None,
        group: str | None = None,
        lever_arm_m: Sequence[float] | str = (0.0, 0.0, 0.0),
        meta: Spec | None = None,
        sure: Spec | None = None,
    ) -> None:
        if time_zero not in ("imu", "keep"):
            raise InputError(f"reader.time_zero={time_zero}: must be imu (count from the first sample) or keep")
        if isinstance(skip_rows, bool) or not isinstance(skip_rows, int) or skip_rows < 0:
            raise InputError(f"reader.skip_rows is {skip_rows!r}, must be a whole number ≥ 0")
        self.specs: dict[str, Spec] = {"imu": imu, "gnss": gnss, "reference": reference or {}}
        self.specs |= {name: spec or {} for name, spec in (("speed", speed), ("heading", heading), ("baro", baro))}
        for kind, spec in self.specs.items():
            check_keys(spec, kind)
        self.text = dict(zip(TEXT, (separator, decimal, header, comment, skip_rows, encoding)))
        self.time_zero, self.drive, self.group = time_zero, drive, group
        self.lever_arm_m = lever_arm_m if lever_arm_m == AUTO else _lever_arm(lever_arm_m)
        self.meta, self.sure = dict(meta or {}), settings_from(Sure, sure or {}, "reader.sure")
        self.wanted = open_settings(self.specs, lever_arm_m)
        self.neutral = placeholders(self.specs)

    def read(self, source: str | Path) -> Iterator[DriveFrames]:
        """The drives of a folder, in the order of their names."""
        return (self.drive_at(*place) for place in self.places(source))

    def places(self, source: str | Path) -> list[Place]:
        """Where the drives lie, for :meth:`drive_at`."""
        source = Path(source)
        patterns = self.specs["imu"].get("file")
        if source.is_file() and not is_archive(source):
            return [(source.parent, self.drive or drive_name(source), source)]
        if not source.exists():
            raise InputError(f"source={source}: no such file or folder; it holds one drive, or one subfolder per drive")
        if source.is_file() or _match_files(source, patterns):
            return [(source, self.drive or drive_name(source), None)]
        if not (places := drive_places(source)):
            named = _name_patterns(patterns)
            raise InputError(f"source={source}: no file {named} and no subfolders; set reader.imu.file")
        return [(place, drive_name(place), None) for place in places]

    def with_settings(self, settings: Mapping[str, Any]) -> LogReader:
        """The same reader, with settings that other drives found in the place of ``auto``."""
        other = copy.copy(self)
        known = {kind: _fill_auto(spec, settings.get(kind, {})) for kind, spec in self.specs.items()}
        other.specs, other.wanted = known, open_settings(known, self.lever_arm_m)
        other.neutral = placeholders(known)
        return other

    def drive_at(self, folder: Path, name: str, only: Path | None = None) -> DriveFrames:
        """The drive of a place, by that name."""
        with unpack(folder) as inside:
            return self._drive(inside, name, only)

    def _drive(self, folder: Path, name: str, only: Path | None) -> DriveFrames:
        kinds = [kind for kind, spec in self.specs.items() if spec.get("file") is not None]
        if "imu" not in kinds:
            raise InputError("reader.imu.file is null; a drive needs an IMU")
        every = {kind: self._map_table(folder, self.neutral[kind], kind, only) for kind in kinds}
        mapped = {kind: part for kind, part in every.items() if kind in FRAMES}
        zero, t = self._times(mapped)
        arm, found, mapping = self.lever_arm_m, (), {}
        if self.wanted:
            try:
                specs, arm, found = settle(mapped, t, self.wanted, self.sure, f"drive {name}", arm)
            except Unsure as unsure:
                unsure.layout = layout(self.neutral)
                raise
            mapped = {kind: replace(part, spec=specs[kind]) for kind, part in mapped.items()}
            zero, t = self._times(mapped)
        frames = {kind: FRAMES[kind](part, t[kind]) for kind, part in mapped.items()}
        for kind, part in mapped.items():
            check_time(t[kind], f"drive {name}, {part.table.path.name}", kind, part.name_row)
        others = {kind: part for kind, part in every.items() if kind not in FRAMES}
        aids, specs, of_aids = read_aids(
            others, zero, frames["imu"], mapped.get("gnss"), frames.get("gnss"), f"drive {name}"
        )
        if self.wanted or of_aids:
            assert not isinstance(arm, str)  # auto is wanted, and found above
            named = {"time_zero": self.time_zero, "group": self.group, "lever_arm_m": list(arm), "meta": self.meta}
            known = {**self.neutral, **{kind: dict(part.spec) for kind, part in mapped.items()}, **specs}
            mapping = {"_target_": "dlkf.data.readers.logs.LogReader", **self.text, **named, **known}
        meta = {"drive": name, "group": self.group or name, "time_zero_s": float(zero)}
        if "gnss" in mapped:
            zone_s = local_time_s(mapped["gnss"], mapped["imu"])
            meta |= _gps_time(mapped["gnss"], t["gnss"], zone_s)
        meta |= self.meta
        meta |= dict(zip(("lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m"), arm))
        notes = [note for part in every.values() for one in (part, *part.parts.values()) for note in one.table.notes]
        notes += [note for part in mapped.values() if (note := epoch_note(part)) is not None]
        if "gnss" in frames:
            frames["gnss"], of_stds = drop_zero_stds(frames["gnss"])
            notes += of_stds
        if "gnss" in mapped and zone_s:
            file = mapped["gnss"].table.path.name
            notes.append(f"dates of {file}: {zone_s / 3600:+g} h from UTC by the IMU's stamps, so they are local time")
        unread = _list_unread_velocities(mapped.get("gnss"))
        said = (*dict.fromkeys((*notes, *list_unused(every))), *unread, *found, *of_aids)
        said = said if only is not None else (*_list_unread_files(folder, every), *said)
        return DriveFrames(meta, frames["imu"], frames.get("gnss"), frames.get("reference"), said, mapping, aids)

    def _times(self, mapped: Mapping[str, Mapped]) -> tuple[int, dict[str, np.ndarray]]:
        """The second that a drive's times count from, and those of its tables."""
        stamps = {kind: part.stamps() for kind, part in mapped.items()}
        zero = int(stamps["imu"][0][0]) if self.time_zero == "imu" else 0
        t = {kind: (whole - zero) + part for kind, (whole, part) in stamps.items()}
        for kind, part in mapped.items():
            if part.time.get("respace"):
                t[kind] = spread_stamps(t[kind])
        return zero, t

    def _map_table(self, folder: Path, spec: Spec, kind: str, only: Path | None) -> Mapped:
        """The table of a kind, with the entries that come from other tables brought to its rows."""
        whole = select_rows(self._table(folder, spec, kind, f"reader.{kind}", only))
        parts: dict[str, Mapped] = {}
        for key, entry in spec.items():
            if not isinstance(entry, Mapping) or key == "time" or not any(entry.get(s) is not None for s in SOURCE):
                continue
            if not whole.has(key):
                continue
            own = {**spec, **{s: entry[s] for s in SOURCE if entry.get(s) is not None}}
            parts[key] = select_rows(self._table(folder, own, kind, f"reader.{kind}.{key}", only))
        of_std = {str(name) for name in spec["std_velocity"]["columns"]} if whole.has("std_velocity") else set()
        if "velocity" in parts and of_std and of_std <= {str(name) for name in parts["velocity"].table.frame}:
            parts.setdefault("std_velocity", parts["velocity"])
        return _join_parts(whole, parts) if parts else whole

    def _table(self, folder: Path, spec: Spec, kind: str, where: str, only: Path | None) -> Mapped:
        first, *others = _find_files(folder, spec, kind, where, only)
        text = {**self.text, **(spec.get("text") or {}), "lines": spec.get("lines")}
        if unknown := [key for key in text if key not in (*TEXT, "lines")]:
            raise InputError(f"{where}.text: unknown key {unknown[0]}; known are {', '.join(TEXT)}")
        name = None if spec.get("table") is None else str(spec["table"])

        def read(path: Path) -> Mapped:
            table = formats.read(spec.get("format") or "csv", path, kind=kind, table=name, text=text, where=where)
            return Mapped(table, spec, kind)

        whole = read(first)
        if not others:
            return whole
        try:
            joined = join_parts([whole, *map(read, others)])
        except InputError:
            joined = None
        if joined is not None:
            return joined
        if isinstance(spec.get("file"), str):
            names = ", ".join(path.name for path in (first, *others))
            raise InputError(
                f"{folder}: {names} match {spec['file']}, and are no parts of one log: their columns differ or their "
                f"times overlap; set {where}.file"
            )
        return whole


def _find_files(folder: Path, spec: Spec, kind: str, where: str, only: Path | None) -> list[Path]:
    """The file of a kind; several that match a pattern, or are listed by their names, may be parts of one log."""
    patterns = _patterns(spec.get("file"))
    if only is not None and any(only.match(p) for p in patterns):
        return [only]
    listed = [found for p in patterns if (found := _match_files(folder, p))]
    if len(listed) > 1 and len(listed) == len(patterns) and all(len(found) == 1 for found in listed):
        return [path for (path,) in listed]
    if not listed:
        seen = [] if only is not None else sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))
        have = ", ".join(seen[:8]) or (only.name if only is not None else "nothing")
        without = ", or reader.reference=null" if kind == "reference" else ""
        raise InputError(
            f"{folder}: no {kind} file {_name_patterns(spec.get('file'))}; has {have}; set {where}.file{without}"
        )
    return listed[0]


def _patterns(file: Any) -> list[str]:
    return [str(p) for p in (file if isinstance(file, (list, tuple)) else [file]) if p is not None]


def _name_patterns(file: Any) -> str:
    return " or ".join(_patterns(file))


def _match_files(folder: Path, file: Any) -> list[Path]:
    """What the first pattern that fits anything fits."""
    for pattern in _patterns(file):
        try:
            found = sorted(p for p in folder.glob(pattern) if not p.name.startswith("."))
        except (ValueError, NotImplementedError):
            raise InputError(f"file {pattern!r}: must be a name or pattern inside the drive's folder") from None
        if found:
            return found
    return []


def _join_parts(whole: Mapped, parts: Mapping[str, Mapped]) -> Mapped:
    """The parts at the rows of the whole: of GNSS the row of the same fix, of an IMU interpolated."""
    base, rest = whole.stamps()
    zero = base[0]
    t = (base - zero) + rest
    keep = np.ones(len(t), bool)
    brought: dict[str, Mapped] = {}
    for key, part in parts.items():
        seconds, fraction = part.stamps()
        at = (seconds - zero) + fraction
        if whole.kind == "imu":
            frame, near = _interpolate(part, key, at, t)
        else:
            order = np.argsort(at, kind="stable")
            place = np.clip(np.searchsorted(at[order], t), 1, max(len(at) - 1, 1))
            before, after = order[place - 1], order[np.minimum(place, len(at) - 1)]
            nearest = np.where(np.abs(at[before] - t) <= np.abs(at[after] - t), before, after)
            near = np.abs(at[nearest] - t) <= NEAR_S
            frame = part.table.frame.iloc[nearest].reset_index(drop=True)
            if key != "position" and not near.all():
                frame = frame.astype(object)
                frame.loc[~near] = np.nan
                near = near | near.any()
        if not near.any():
            raise InputError(
                f"{part.table.path}: no row within {NEAR_S:g} s of those of {whole.table.path.name}; both need one "
                f"clock (reader.{whole.kind}.{key}.time)"
            )
        keep &= near
        brought[key] = replace(part, table=replace(part.table, frame=frame))
    joined = replace(whole, parts=brought)
    return joined if keep.all() else joined.rows(keep)


def _list_unread_files(folder: Path, mapped: Mapping[str, Mapped]) -> list[str]:
    """Lines on files beside those that were read, of the same suffixes, and on subfolders that have such."""
    tables = [p.table for whole in mapped.values() for p in (whole, *whole.parts.values())]
    read = {path for table in tables for path in (table.path, *table.beside)}
    suffixes = {path.suffix.lower() for path in read} - {""}

    def lists_logs(inside: Path) -> bool:
        return inside not in {up for path in read for up in path.parents} and any(
            p.suffix.lower() in suffixes for p in inside.iterdir()
        )

    names = {path.name for path in read}
    left = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name not in names)
    below = sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._" and lists_logs(p))
    said = [f"files that are not read: {list_some(left, MOST_NAMED)}"] if left else []
    if below:
        said.append(
            f"subfolders that are not read: {list_some(below, MOST_NAMED)}, since files beside them make a drive; "
            "give each as source, or move these files into a subfolder too"
        )
    return said


def _list_unread_velocities(gnss: Mapped | None) -> list[str]:
    """A line where the fixes of a bag have no velocities, and topics beside them do."""
    if gnss is None or gnss.spec.get("format") != "rosbag" or "velocity" in gnss.parts:
        return []
    topics = rosbag.find_velocities(gnss.table.path)
    return [f"velocities lie in {' and '.join(topics)}: reader.gnss.velocity.table={topics[0]}"] if topics else []


def _gps_time(gnss: Mapped, t: np.ndarray, zone_s: int) -> dict[str, float]:
    """GPS time = ``gps_zero_s`` + ``gps_rate`` t by the fixes' own stamps (``zone_s`` ahead of UTC), independent of t's
    clock; empty where they have no date."""
    first = gnss.first_gps_s()
    if first is None:
        return {}
    rate = 1 / (1 + 1e-6 * float(gnss.time.get("drift_ppm") or 0.0))
    return {"gps_zero_s": first - zone_s - rate * float(t[0]), "gps_rate": rate}


def _interpolate(part: Mapped, key: str, at: np.ndarray, t: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
    """A sensor's columns at another sensor's stamps, and where it has neighbours close enough."""
    values = part.vector(key, (3,), nan=False)
    order = np.argsort(at, kind="stable")
    at, values = at[order], values[order]
    usual = float(np.median(np.diff(at))) if len(at) > 1 else 0.0
    place = np.clip(np.searchsorted(at, t), 1, max(len(at) - 1, 1))
    bridged = (at[np.minimum(place, len(at) - 1)] - at[place - 1]) <= max(0.25, 5 * usual)
    near = (t >= at[0] - usual) & (t <= at[-1] + usual) & bridged
    names = [str(n) for n in part.spec[key]["columns"]]
    return pd.DataFrame({n: np.interp(t, at, v) for n, v in zip(names, values.T)}), near


def _fill_auto(spec: Any, settings: Any) -> Any:
    """A mapping with settings in the place of every ``auto`` for which there is one."""
    if not isinstance(spec, Mapping) or not isinstance(settings, Mapping):
        return settings if spec == AUTO and settings else spec
    return {key: _fill_auto(value, settings[key]) if key in settings else value for key, value in spec.items()}


def _lever_arm(arm: Any) -> tuple[float, float, float]:
    numbers = arm if isinstance(arm, (list, tuple)) else [arm]
    if len(numbers) != 3 or not all(map(is_number, numbers)):
        raise InputError(
            f"reader.lever_arm_m={arm}: must be three numbers, IMU → antenna: '[forward, right, down]' [m]"
        )
    return float(numbers[0]), float(numbers[1]), float(numbers[2])
