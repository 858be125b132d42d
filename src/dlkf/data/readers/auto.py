"""Logs of which nothing is known: every file's format and columns, then all else as with ``auto`` in a mapping."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dlkf.base.config import merge_settings, read_preset
from dlkf.base.errors import InputError
from dlkf.data.readers import formats, recognise, units, vocabulary
from dlkf.data.readers.archives import drive_name, drive_places, is_archive, unpack
from dlkf.data.readers.formats import rosbag
from dlkf.data.readers.frames import DriveFrames, Place
from dlkf.data.readers.logs import LogReader
from dlkf.data.readers.mapping import Mapped
from dlkf.data.readers.offers import (
    NO_LOGS,
    Contents,
    Known,
    Offer,
    find_format,
    leave_open,
    matches,
    recognise_file,
    text_options,
)
from dlkf.data.readers.parts import join_parts
from dlkf.data.readers.settling import Unsure

LAYOUTS = {  # presets whose files are known by their names
    "kitti": ("oxts/timestamps.txt",),
    "sensor_logger": ("TotalAcceleration.csv",),
    "phyphox": ("Gyroscope.csv", "Location.csv"),
}
BAROMETERS = {"sensor_logger": "Barometer.csv", "phyphox": "Pressure.csv"}
TABLES = (".csv", ".tsv", ".txt", ".dat")
DAMAGED = ("not a whole", "cannot be opened")  # how a line on a file begins that may hold the fixes
RECEIVERS = (".ubx", ".nmea", ".pos", ".bag", ".mcap", ".asc", ".mat", ".bin", ".ulg")
MOST_HELD = 6  # files that a refusal describes


class AutoReader:
    """Finds the IMU's and the GNSS's file of a drive by their contents, and everything about them.

    ``imu`` and ``gnss`` give what is known: ``{file: …}`` chooses among several, any other key wins over what is found.
    """

    def __init__(
        self,
        imu: Mapping[str, Any] | None = None,
        gnss: Mapping[str, Any] | None = None,
        *,
        drive: str | None = None,
        group: str | None = None,
        lever_arm_m: Any = "auto",
        speed: Mapping[str, Any] | None = None,
        heading: Mapping[str, Any] | None = None,
        baro: Mapping[str, Any] | None = None,
        meta: Mapping[str, Any] | None = None,
        sure: Mapping[str, Any] | None = None,
    ) -> None:
        known = {"imu": imu, "gnss": gnss, "speed": speed, "heading": heading, "baro": baro}
        self.known = {kind: dict(spec or {}) for kind, spec in known.items()}
        self.drive = drive
        self.rest = {"group": group, "lever_arm_m": lever_arm_m, "meta": meta, "sure": sure}

    def read(self, source: str | Path) -> Iterator[DriveFrames]:
        """The drive in a folder or file, or the drives in its subfolders and archives."""
        return (self.drive_at(*place) for place in self.places(source))

    def places(self, source: str | Path) -> list[Place]:
        """Where the drives lie, for :meth:`drive_at`."""
        source = Path(source)
        if source.is_file() and not is_archive(source):
            only = _find_bag(source)
            return [(only.parent, self.drive or drive_name(only), only)]
        if not source.exists():
            raise InputError(f"source={source}: no such file or folder; it holds one drive, or one subfolder per drive")
        within = [] if source.is_file() else _recognise_files(source, self.known)
        if source.is_file() or any(one.offers for one in within):
            return [(source, self.drive or drive_name(source), None)]
        if not (places := drive_places(source)):
            raise InputError(
                f"source={source}: holds no log that can be recognised{_describe_files(within)}; name a reader and "
                "its columns, reader=csv reader.imu.file=… reader.gnss.file=…"
            )
        return [(place, drive_name(place), None) for place in places]

    def with_settings(self, settings: Mapping[str, Any]) -> AutoReader:
        """The same reader, with settings found from other drives; settings given before still win."""
        known = {kind: merge_settings(settings.get(kind, {}), spec) for kind, spec in self.known.items()}
        return AutoReader(drive=self.drive, **known, **self.rest)

    def drive_at(self, folder: Path, name: str, only: Path | None = None) -> DriveFrames:
        """The drive of a place, by that name."""
        with unpack(folder) as inside:
            return self._drive(inside, name, only)

    def _drive(self, folder: Path, name: str, only: Path | None) -> DriveFrames:
        within = [recognise_file(only, self.known)] if only is not None else _recognise_files(folder, self.known)
        specs, detail = {}, []
        for kind in ("imu", "gnss"):
            chosen = self._choose_offer(within, kind, folder)
            if chosen is None:
                self._refuse_absent(within, kind, folder, only)
                specs[kind] = {"file": None}
                continue
            if kind == "gnss" and chosen.refusal:
                raise InputError(f"{chosen.path}: {chosen.refusal}")
            specs[kind] = merge_settings(chosen.specs[kind], self.known[kind])
            file = specs[kind].get("file")
            there = chosen.name if chosen.table else ", ".join(file) if isinstance(file, list) else file or chosen.name
            detail += [f"found the {kind} in {there}: {chosen.detail}", *chosen.notes]
            if kind == "gnss" and (more := _find_velocities(chosen, specs[kind], [] if only else folder.iterdir())):
                specs[kind]["velocity"] |= more
                detail.append(f"found velocities in {more.get('table') or more['file']}")
        if (specs["gnss"].get("time") or {}).get("offset_s") is None and specs["gnss"].get("file"):
            specs["gnss"]["time"]["offset_s"] = "auto"
        without = "file" in self.known["gnss"] and self.known["gnss"]["file"] is None
        if not specs["gnss"].get("file") and not without:
            _refuse_lost(within, folder)
        if not specs["gnss"].get("file") and not without and (foreign := _find_unread(within, only)):
            if foreign.held.startswith(DAMAGED):
                raise InputError(f"{foreign.path}: {foreign.held}; or take it away where this is a log at rest")
            what = "it is empty" if foreign.held == "empty" else foreign.held
            raise InputError(
                f"{folder}: no fixes found in {foreign.path.name} ({what}); name its columns (reader=csv "
                f"reader.gnss.file={foreign.path.name} …), or take it away where this is a log at rest"
            )
        rest = dict(self.rest)
        for kind in ("speed", "heading", "baro"):
            rest[kind], notes = self._aid(within, kind, folder)
            detail += notes
        if not specs["gnss"].get("file"):
            rest["lever_arm_m"] = [0.0, 0.0, 0.0]
            detail += _settle_at_rest(specs["imu"])
        reader = LogReader(specs["imu"], specs["gnss"], drive=name, **rest)
        try:
            drive = reader.drive_at(folder, name)
        except Unsure as unsure:
            unsure.args = (f"{unsure}{_suggest_preset(specs)}",)
            raise
        return replace(drive, notes=(*dict.fromkeys(detail), *drive.notes))

    def _choose_offer(self, within: list[Contents], kind: str, folder: Path) -> Offer | None:
        """What gives a kind, of several the one in the file or table that is asked for; None where nothing does."""
        offers, known = [o for one in within for o in one.offers], self.known[kind]
        fits = [o for o in offers if kind in o.specs] or (_join_sensors(offers) if kind == "imu" else [])
        if (file := known.get("file")) is not None:
            fits = [o for o in fits if matches(o.path, file)]
        if (table := known.get("table")) is not None and any(o.table for o in fits):
            fits = [o for o in fits if o.table == str(table)]
        if len(fits) > 1 and (whole := _join_offers(fits, kind)) is not None:
            return whole
        if len(fits) > 1:
            key = "table" if len({o.path for o in fits}) == 1 else "file"
            names = ", ".join((o.table or o.name) if key == "table" else o.name for o in fits)
            needed = kind in ("imu", "gnss")
            what, none = kind.upper() if needed else kind, "" if needed else f", or reader.{kind}.file=null for none"
            raise InputError(f"{folder}: {names} all hold {what}; choose one with reader.{kind}.{key}{none}")
        return fits[0] if fits else None

    def _refuse_absent(self, within: list[Contents], kind: str, folder: Path, only: Path | None) -> None:
        """InputError where a file that is asked for gives no such kind, or nothing an IMU."""
        offers = [o for one in within for o in one.offers]
        if (file := self.known[kind].get("file")) is not None:
            if there := [one for one in within if matches(one.path, file)]:
                columns = "accel.columns=[…] and .gyro.columns" if kind == "imu" else "position.columns"
                raise InputError(
                    f"{folder}: no {kind.upper()} found{_describe_files(there, offers)}; name its columns "
                    f"(reader.{kind}.{columns}=[…])"
                )
            have = ", ".join(o.name for o in offers if kind in o.specs) or "no file"
            raise InputError(f"{folder}: reader.{kind}.file={file}: no such file here; {kind.upper()} found in {have}")
        if kind == "gnss" and (named := _list_named(self.known[kind])):
            have = [o.name for o in offers if kind in o.specs]
            why = "; ".join(one.lost for one in within if one.lost)
            where = f"; GNSS found in {', '.join(have)}" if have else ""
            raise InputError(f"{folder}: no GNSS found for {' '.join(named)}{why and f' ({why})'}{where}")
        if kind == "imu":
            remedy = "give the folder that holds the IMU's file too, or name both" if only is not None else (
                "name the reader and its columns (reader=csv reader.imu.file=… 'reader.imu.accel.columns=[…]' …)"
            )  # fmt: skip
            raise InputError(f"{only or folder}: no IMU found{_describe_files(within, offers)}; {remedy}")

    def _aid(self, within: list[Contents], kind: str, folder: Path) -> tuple[dict[str, Any] | None, list[str]]:
        """The spec of an aid, and what it was found in; None where there is none, or file=null leaves it out."""
        known = self.known[kind]
        if "file" in known and known["file"] is None:
            return None, []
        if (chosen := self._choose_offer(within, kind, folder)) is not None:
            spec = merge_settings(chosen.specs[kind], known)
            columns = [c for key in ("value", "pressure", "height") for c in (spec.get(key) or {}).get("columns") or []]
            return spec, [f"found {kind} in {chosen.name}: {', '.join(map(str, columns))}"]
        if (file := known.get("file")) is None:
            return None, []
        if not (known.get("value") or known.get("pressure") or known.get("height")):
            raise InputError(f"{folder}: reader.{kind}.file={file}: nothing there is known as {kind}; give its columns")
        return merge_settings(leave_open({kind: read_preset("reader", "csv")[kind]})[kind], known), []


def _recognise_files(folder: Path, known: Known) -> list[Contents]:
    """What the files of a folder hold; of one whose files are known by their names, that."""
    for name, files in LAYOUTS.items():
        first = folder / files[0]
        if not all((folder / file).is_file() for file in files):
            continue
        if name != "phyphox" or b"Time (s)" in first.open("rb").read(200):  # Sensor Logger calls its files the same
            base = read_preset("reader", name)
            options = text_options(first) if first.suffix == ".csv" else {}
            marks = {"text": {key: options[key] for key in ("separator", "decimal") if key in options}}
            specs = leave_open({kind: {**base[kind], **marks} for kind in ("imu", "gnss")})
            if (beside := BAROMETERS.get(name)) and (folder / beside).is_file():  # by the clock of the IMU
                specs["baro"] = {**base["baro"], **marks, "file": beside}
            return [Contents(first, [Offer(first, f"layout of {name}", specs)])]
    return [recognise_file(p, known) for p in sorted(folder.iterdir()) if p.is_file() and not p.name.startswith(".")]


def _describe_files(within: Iterable[Contents], offers: Iterable[Offer] = ()) -> str:
    """What stands in the files, for a line that refuses them."""
    given = {o.path: o.detail for o in offers}
    said = [f"{one.path.name} ({one.held or given.get(one.path, 'fixes')})" for one in within]
    if not said:
        return ""
    more = f" and {len(said) - MOST_HELD} other files" if len(said) > MOST_HELD else ""
    return f" in {'; '.join(said[:MOST_HELD])}{more}"


def _join_offers(offers: list[Offer], kind: str) -> Offer | None:
    """Files of the same columns whose stamps follow each other as one log; None where they are none."""
    specs = [{key: value for key, value in o.specs[kind].items() if key != "file"} for o in offers]
    first = offers[0]
    if any(spec != specs[0] for spec in specs) or any(o.table is not None for o in offers):
        return None
    spec = first.specs[kind]
    name, options = spec.get("format", "csv"), spec.get("text") or {}
    parts = [
        Mapped(formats.read(name, o.path, kind=kind, table=spec.get("table"), text=options, where="reader"), spec, kind)
        for o in offers
    ]
    if join_parts(parts) is None:
        return None
    return replace(first, specs={**first.specs, kind: {**spec, "file": [o.path.name for o in offers]}})


def _join_sensors(offers: list[Offer]) -> list[Offer]:
    """An accelerometer and a gyroscope that lie in tables of their own as an IMU."""
    accels, gyros = ([o for o in offers if key in o.specs] for key in ("accel", "gyro"))
    if len(accels) != 1 or len(gyros) != 1:
        return []
    (accel,), (gyro,) = accels, gyros
    rate = gyro.specs["gyro"]
    source = {key: rate[key] for key in ("format", "file", "table", "text", "time") if key in rate}
    specs = leave_open({"imu": {**accel.specs["accel"], "gyro": {**rate["gyro"], **source}}})
    detail = f"{accel.detail}, and {gyro.name} with {', '.join(rate['gyro']['columns'])}"
    return [Offer(accel.path, detail, specs, table=accel.table)]


def _refuse_lost(within: Iterable[Contents], folder: Path) -> None:
    """InputError for positions of which no fixes can be made: without them the drive would be a log at rest."""
    if lost := next((one for one in within if one.lost), None):
        raise InputError(
            f"{folder}: no fixes found in {lost.path.name} ({lost.lost}); name their columns (reader.gnss.…), or "
            "reader.gnss.file=null where this is a log at rest"
        )


def _list_named(gnss: Mapping[str, Any]) -> list[str]:
    """The table and the columns that settings of fixes name."""
    named = [] if gnss.get("table") is None else [f"reader.gnss.table={gnss['table']}"]
    columns = {key: spec.get("columns") for key, spec in gnss.items() if isinstance(spec, Mapping)}
    return named + [f"reader.gnss.{key}.columns=[{', '.join(map(str, c))}]" for key, c in columns.items() if c]


def _settle_at_rest(imu: dict[str, Any]) -> list[str]:
    """Settle what cannot be estimated without fixes, and report it."""
    detail = []
    for key in ("accel", "gyro"):
        stated = vocabulary.find_unit(str(imu[key]["columns"][0]))
        rate = stated if stated in units.RATE else "rad/s"
        taken = {"unit": "auto" if key == "accel" else rate, "axes": "frd"}
        unsaid = {name: value for name, value in taken.items() if imu[key][name] == "auto"}
        imu[key] |= unsaid
        left = [f"reader.imu.{key}.{name}={value}" for name, value in unsaid.items() if value != "auto"]
        detail += [f"took {' and '.join(left)}: without fixes it cannot be estimated"] if left else []
    return detail


def _suggest_preset(specs: Mapping[str, Any]) -> str:
    """The preset of a program whose files are laid out so, for a line that refuses them."""
    imu, gnss = specs["imu"], specs["gnss"]
    columns = [*(imu["gyro"].get("columns") or []), *(imu["accel"].get("columns") or [])]
    numbers = [str(k) for k in range(1, 7)]
    if imu.get("increments") and columns == numbers and (gnss.get("position") or {}).get("columns") == numbers[:3]:
        files = f"reader.imu.file={imu['file']} reader.gnss.file={gnss['file']}"
        return f"; or, if these are KF-GINS' files, on one clock and with its axes: reader=kfgins {files}"
    return ""


def _find_bag(path: Path) -> Path:
    """Of a part of a ROS 2 bag its metadata.yaml; any other file itself."""
    if path.suffix != ".db3":
        return path
    whole = path.parent / "metadata.yaml"
    if not whole.is_file():
        raise InputError(f"{path}: its metadata.yaml is missing; ros2 bag reindex {path.parent} writes it again")
    return whole


def _find_velocities(chosen: Offer, gnss: Mapping[str, Any], files: Iterable[Path]) -> dict[str, Any] | None:
    """Velocities for fixes without any: of the first text table of the same columns of time, or of the only topic."""
    if gnss.get("format") == "rosbag" and not gnss["velocity"].get("table") and gnss.get("table") is None:
        topics = rosbag.find_velocities(chosen.path)
        if len(topics) > 1:
            raise InputError(
                f"{chosen.path}: {', '.join(topics)} all hold velocities; choose one with reader.gnss.velocity.table"
            )
        return {"table": topics[0]} if topics else None
    if gnss.get("format") != "csv" or gnss["velocity"].get("columns"):
        return None
    for path in sorted(files):
        if path == chosen.path or not path.is_file() or path.name.startswith(".") or find_format(path) != "csv":
            continue
        try:
            options = text_options(path)
            table = formats.read("csv", path, kind="gnss", table=None, text=options, where="reader")
            table = recognise.convert_numbers(table)
        except InputError:
            continue
        found = recognise.velocity_spec(table) if options == gnss["text"] else None
        if found is not None and all(gnss["time"].get(key) == value for key, value in found[0].items()):
            return {**found[1], "file": path.name}
    return None


def _find_unread(within: Iterable[Contents], only: Path | None) -> Contents | None:
    """A text table or a receiver's log beside the IMU's file of which nothing is known; None where there is none."""
    for one in within if only is None else ():
        suffix = one.path.suffix.lower()
        known = suffix in (*RECEIVERS, *NO_LOGS) or one.held.startswith(DAMAGED)
        if not one.offers and (known or (suffix in TABLES and (one.held == "empty" or find_format(one.path) == "csv"))):
            return one
    return None
