"""Logs of which nothing is known: every file's format and columns, then all else as with ``auto`` in a mapping."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from dlkf.config import config_dir
from dlkf.data.readers import formats, recognise
from dlkf.data.readers.formats import rosbag, text
from dlkf.data.readers.frames import DriveFrames, Place, Table
from dlkf.data.readers.logs import LogReader
from dlkf.errors import InputError

# presets whose files are known by a name
LAYOUTS = {
    "kitti": "oxts/timestamps.txt",
    "sensor_logger": "TotalAcceleration.csv",
    "phyphox": "Gyroscope.csv",
}
PRESETS = {"ubx": "ubx", "nmea": "nmea", "rosbag": "rosbag", "rtklib": "rtklib", "gnss_logger": "gnss_logger"}
PRESETS |= {"inertial_explorer": "inertial_explorer", "novatel": "novatel", "navego": "navego"}
GNSS_ONLY = ("nmea", "rtklib", "inertial_explorer")
LARGEST_PEEK = 400  # lines
TABLES = (".csv", ".tsv", ".txt", ".dat")
RECEIVERS = (".ubx", ".nmea", ".pos", ".bag", ".mcap", ".asc")


@dataclass(frozen=True)
class Offer:
    """What a file can give, as specs of a mapping."""

    path: Path
    told: str
    imu: dict[str, Any] | None = None
    gnss: dict[str, Any] | None = None


class AutoReader:
    """Finds the IMU's and the GNSS's file of a drive by their contents, and everything about them.

    ``imu`` and ``gnss`` say what is known: ``{file: …}`` chooses among several, any other key wins over what is found.
    """

    def __init__(
        self,
        imu: Mapping[str, Any] | None = None,
        gnss: Mapping[str, Any] | None = None,
        *,
        drive: str | None = None,
        group: str | None = None,
        lever_arm_m: Any = "auto",
        meta: Mapping[str, Any] | None = None,
        sure: Mapping[str, Any] | None = None,
    ) -> None:
        self.known = {"imu": dict(imu or {}), "gnss": dict(gnss or {})}
        self.drive = drive
        self.rest = {"group": group, "lever_arm_m": lever_arm_m, "meta": meta, "sure": sure}

    def read(self, source: str | Path) -> Iterator[DriveFrames]:
        """The drive in a folder or file, or the drives in its subfolders."""
        return (self.drive_at(*place) for place in self.places(source))

    def places(self, source: str | Path) -> list[Place]:
        """Where the drives lie, for :meth:`drive_at`."""
        source = Path(source)
        if source.is_file():
            source, only = source.parent, _whole_bag(source)
        else:
            only = None
        if not source.is_dir():
            raise InputError(f"source={source}: no such file or folder; it holds one drive, or one subfolder per drive")
        if only is not None or self._offers(source):
            named = source.absolute() if only is None or only.name == "metadata.yaml" else only
            return [(source, self.drive or named.name.partition(".")[0], only)]
        folders = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
        if not folders:
            raise InputError(f"source={source}: holds no log that can be recognised; name a reader and its columns")
        return [(folder, folder.name, None) for folder in folders]

    def drive_at(self, folder: Path, name: str, only: Path | None = None) -> DriveFrames:
        """The drive of a place, by that name."""
        offers = [offer(only)] if only is not None else self._offers(folder)
        specs, told = {}, []
        for kind in ("imu", "gnss"):
            chosen = self._chosen([o for o in offers if o is not None], kind, folder, only)
            if chosen is None:
                specs[kind] = {"file": None}
                continue
            specs[kind] = _merged(getattr(chosen, kind), self.known[kind])
            told.append(f"found the {kind} in {chosen.path.name}: {chosen.told}")
            if kind == "gnss" and (more := _velocities_beside(chosen, specs[kind], [] if only else folder.iterdir())):
                specs[kind]["velocity"] |= more
                told.append(f"found velocities in {more.get('table') or more['file']}")
        if (specs["gnss"].get("time") or {}).get("offset_s") is None and specs["gnss"].get("file"):
            specs["gnss"]["time"]["offset_s"] = "auto"
        if not specs["gnss"].get("file") and (foreign := _foreign(folder, offers, only)):
            raise InputError(
                f"{folder}: no fixes found in {foreign}; name its columns (reader=csv reader.gnss.file={foreign} …), "
                "or take it away where this is a log at rest"
            )
        rest = dict(self.rest)
        if not specs["gnss"].get("file"):
            rest["lever_arm_m"] = [0.0, 0.0, 0.0]
            for key in ("accel", "gyro"):
                taken = {"unit": "auto" if key == "accel" else "rad/s", "axes": "frd"}
                unsaid = {name: value for name, value in taken.items() if specs["imu"][key][name] == "auto"}
                specs["imu"][key] |= unsaid
                left = [f"reader.imu.{key}.{name}={value}" for name, value in unsaid.items() if value != "auto"]
                told += [f"took {' and '.join(left)}: without fixes nothing tells"] if left else []
        reader = LogReader(specs["imu"], specs["gnss"], drive=name, **rest)
        (drive,) = reader.read(folder)
        notes = (*told, *drive.notes)
        return DriveFrames(drive.meta, drive.imu, drive.gnss, drive.reference, notes, drive.mapping)

    def _offers(self, folder: Path) -> list[Offer]:
        for preset, file in LAYOUTS.items():
            if (folder / file).is_file():
                if preset == "phyphox" and not (folder / "Location.csv").is_file():
                    continue
                base = _preset(preset)
                specs = {kind: {**base[kind]} for kind in ("imu", "gnss")}
                return [Offer(folder / file, f"layout of {preset}", *_opened(specs))]
        files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
        return [found for path in files if (found := offer(path)) is not None]

    def _chosen(self, offers: list[Offer], kind: str, folder: Path, only: Path | None) -> Offer | None:
        fits = [o for o in offers if getattr(o, kind) is not None]
        if (file := self.known[kind].get("file")) is not None:
            fits = [o for o in fits if o.path.match(str(file))]
            if not fits:
                have = ", ".join(o.path.name for o in offers if getattr(o, kind) is not None) or "no file"
                raise InputError(f"{folder}: reader.{kind}.file={file}: no such {kind.upper()} here; found in {have}")
        if len(fits) > 1:
            names = ", ".join(o.path.name for o in fits)
            raise InputError(f"{folder}: {names} all hold {kind.upper()}; choose one with reader.{kind}.file")
        if not fits and kind == "imu" and only is not None:
            raise InputError(f"{only}: no IMU found in it; give the folder that holds the IMU's file too, or name both")
        if not fits and kind == "imu":
            have = ", ".join(p.name for p in sorted(folder.iterdir())[:8]) or "nothing"
            raise InputError(f"{folder}: no IMU found in {have}; name the reader and its columns (reader=csv …)")
        return fits[0] if fits else None


def offer(path: Path) -> Offer | None:
    """What a file holds; None if nothing that is known."""
    name = sniffed(path)
    if name is None:
        return None
    if name in PRESETS:
        base = _preset(PRESETS[name])
        specs = {}
        for kind in ("imu", "gnss"):
            there = rosbag.holds(path, kind) if name == "rosbag" else kind == "gnss" or _has_imu(path, name)
            if not there:
                continue
            specs[kind] = {**base[kind], "file": path.name, "text": _text_options(base)}
        return Offer(path, f"{name}, as reader={PRESETS[name]}", *_opened(specs))
    options: dict[str, Any] = text_options(path) if name == "csv" else {}
    try:
        table = formats.read(name, path, kind="imu", table=None, text=options, where="reader")
    except InputError:
        return None
    return _offer_of_table(path, name, table, options)


def _offer_of_table(path: Path, name: str, table: Table, options: dict[str, Any]) -> Offer | None:
    imu, gnss = recognise.imu_spec(table), None
    if imu is None or not all(c.isdigit() for c in map(str, table.frame.columns)):
        gnss = recognise.gnss_spec(table)
    if imu is None and gnss is None:
        return None
    source: dict[str, Any] = {"format": name, "file": path.name, "text": options}
    if imu is not None and gnss is not None:
        source["rows"] = "filled"
    specs = {kind: {**spec, **source} for kind, spec in (("imu", imu), ("gnss", gnss)) if spec is not None}
    columns = ", ".join(str(c) for spec in specs.values() for c in _columns(spec))
    return Offer(path, f"{name} with {columns}", *_opened(specs))


def sniffed(path: Path) -> str | None:
    """Format of a file by its first bytes; None if it is none of those known."""
    try:
        with path.open("rb") as file:
            head = file.read(65_536)
    except OSError:
        return None
    if path.name == "metadata.yaml":
        return "rosbag" if b"rosbag2" in head else None
    for mark, name in ((b"#ROSBAG", "rosbag"), (b"\x89MCAP", "rosbag"), (b"PAR1", "parquet"), (b"ARROW1", "feather")):
        if head.startswith(mark):
            return name
    if head.startswith((b"MATLAB", b"\x89HDF")):
        return "navego"
    if b"\xb5b\x01\x07" in head:
        return "ubx"
    if len(re.findall(rb"\$[A-Z]{2}(GGA|RMC|GNS),", head)) >= 3:
        return "nmea"
    if path.suffix == ".gz":
        return "csv"
    if b"\0" in head[:4096] or not head.strip():
        return None
    if re.search(rb"^%.*(latitude\(deg\)|x-ecef|latitude\(d)", head, re.M):
        return "rtklib"
    if re.search(rb"^Project:.*\n(.*\n)?Program:", head):
        return "inertial_explorer"
    if re.search(rb"^[#%](BESTPOS|RAWIMU|INSPVA)", head, re.M):
        return "novatel"
    return "gnss_logger" if re.search(rb"^(# )?UncalAccel,", head, re.M) else "csv"


def text_options(path: Path) -> dict[str, Any]:
    """Separator, decimal mark, comment and header of a text table, by its first lines."""
    lines = [line for line in text.decoded(path, None).splitlines()[:LARGEST_PEEK] if line.strip()]
    options: dict[str, Any] = {}
    marked = [line.lstrip()[:1] in "#%" for line in lines]
    if sum(marked) > 1 or (marked and marked[0] and lines[0].lstrip()[0] == "%"):
        options["comment"] = lines[marked.index(True)].lstrip()[0]
        lines = [line for line, is_comment in zip(lines, marked) if not is_comment]
    if len(lines) < 2:
        return options
    body = lines[1 : min(len(lines), 50)]
    counts = {s: len(text._cells(body[-1], s)) for s in (";", "\t", ",", r"\s+")}
    separator = next((s for s in (";", "\t") if counts[s] > 3), "," if counts[","] > 2 else r"\s+")
    options["separator"] = separator
    if separator in (";", "\t", r"\s+") and any(re.search(r"\d,\d", line) for line in body):
        options["decimal"] = ","
    first = text._cells(lines[0].lstrip("#").strip(), separator)
    options["header"] = not any(text._is_number(c, options.get("decimal", ".")) for c in first)
    return options


def _whole_bag(path: Path) -> Path:
    """Of a part of a ROS 2 bag its metadata.yaml; any other file itself."""
    if path.suffix != ".db3":
        return path
    whole = path.parent / "metadata.yaml"
    if not whole.is_file():
        raise InputError(f"{path}: its metadata.yaml is missing; ros2 bag reindex {path.parent} writes it again")
    return whole


def _velocities_beside(chosen: Offer, gnss: Mapping[str, Any], files: Iterable[Path]) -> dict[str, Any] | None:
    """Velocities for fixes without any: of the first text table of the same columns of time, or of the only topic."""
    if gnss.get("format") == "rosbag" and not gnss["velocity"].get("table") and gnss.get("table") is None:
        topics = rosbag.velocities_beside(chosen.path)
        if len(topics) > 1:
            raise InputError(
                f"{chosen.path}: {', '.join(topics)} all hold velocities; choose one with reader.gnss.velocity.table"
            )
        return {"table": topics[0]} if topics else None
    if gnss.get("format") != "csv" or gnss["velocity"].get("columns"):
        return None
    for path in sorted(files):
        if path == chosen.path or not path.is_file() or path.name.startswith(".") or sniffed(path) != "csv":
            continue
        try:
            options = text_options(path)
            table = formats.read("csv", path, kind="gnss", table=None, text=options, where="reader")
        except InputError:
            continue
        found = recognise.velocity_spec(table) if options == gnss["text"] else None
        if found is not None and all(gnss["time"].get(key) == value for key, value in found[0].items()):
            return {**found[1], "file": path.name}
    return None


def _foreign(folder: Path, offers: Iterable[Offer | None], only: Path | None) -> str:
    """A text table or a receiver's log beside the IMU's file of which nothing is known; empty where there is none."""
    known = {found.path for found in offers if found is not None}
    beside = [] if only is not None else sorted(folder.iterdir())
    logs = (p for p in beside if p.is_file() and not p.name.startswith(".") and p not in known)
    unread = (p for p in logs if p.suffix in RECEIVERS or (p.suffix in TABLES and sniffed(p) in ("csv", None)))
    return next((f"{p.name} (it is empty)" if p.stat().st_size == 0 else p.name for p in unread), "")


def _preset(name: str) -> dict[str, Any]:
    """A reader's preset with what it takes over from csv's."""
    folder = config_dir() / "reader"
    own = yaml.safe_load((folder / f"{name}.yaml").read_text())
    return _merged(yaml.safe_load((folder / "csv.yaml").read_text()), own)


def _merged(base: Any, over: Any) -> Any:
    if not isinstance(base, Mapping) or not isinstance(over, Mapping):
        return copy.deepcopy(over)
    out = {key: copy.deepcopy(value) for key, value in base.items() if key not in over}
    return out | {key: _merged(base.get(key), value) for key, value in over.items()}


def _text_options(base: Mapping[str, Any]) -> dict[str, Any]:
    return {key: base[key] for key in ("separator", "decimal", "header", "comment") if key in base}


def _opened(specs: Mapping[str, Any]) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """Specs with everything that a drive can tell left to it."""
    imu, gnss = (copy.deepcopy(specs.get(kind)) for kind in ("imu", "gnss"))
    if imu is not None:
        for key in ("accel", "gyro"):
            imu[key] = {**imu[key], "unit": "auto", "axes": "auto"}
    if gnss is not None:
        gnss["time"] = {**gnss["time"], "offset_s": "auto", "drift_ppm": "auto"}
        gnss["velocity"] = {**(gnss.get("velocity") or {}), "unit": "auto"}
        gnss["position"] = {**gnss["position"], "zero": "none", "delay_s": "auto"}
    return imu, gnss


def _columns(spec: Mapping[str, Any]) -> list[Any]:
    entries = [v for k, v in spec.items() if isinstance(v, Mapping) and k != "time"]
    return [c for entry in entries for c in entry.get("columns") or []]


def _has_imu(path: Path, name: str) -> bool:
    if name in GNSS_ONLY:
        return False
    try:
        base = _preset(PRESETS[name])["imu"]
        options = {**_text_options(_preset(PRESETS[name])), "lines": base.get("lines")}
        table = formats.read(base["format"], path, kind="imu", table=base.get("table"), text=options, where="reader")
    except InputError:
        return False
    return isinstance(table.frame, pd.DataFrame) and len(table.frame) > 10
