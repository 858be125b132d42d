"""What a file can give to a drive, and what stands in one that gives nothing."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from dlkf.base.config import read_preset
from dlkf.base.errors import InputError
from dlkf.data.readers import formats, recognise, stamps, vocabulary
from dlkf.data.readers.formats import autopilot, matlab, nmea, rosbag, text, ubx
from dlkf.data.readers.frames import LogTable

Known = Mapping[str, Mapping[str, Any]]
GNSS_ONLY = ("nmea", "rtklib", "inertial_explorer")
PRESETS = (*GNSS_ONLY, "ubx", "rosbag", "gnss_logger", "novatel", "navego", "px4", "ardupilot")
WITH_AIDS = {"ubx": ubx, "nmea": nmea, "rosbag": rosbag, "px4": autopilot, "ardupilot": autopilot}
NO_LOGS = {  # formats of other programs, and what makes a table of them
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "a spreadsheet; save its sheet as CSV"),
    **dict.fromkeys((".gpx", ".kml", ".kmz"), "a track of GPX or KML; make it a CSV table: time, lat, lon, height"),
    **dict.fromkeys((".json", ".geojson"), "JSON; write it as a CSV table"),
    **dict.fromkeys((".html", ".htm"), "a web page, not the log itself; download the file behind it"),
    **dict.fromkeys((".rar", ".7z", ".tar", ".tgz"), "an archive; unpack it and give the folder"),
    **dict.fromkeys((".obs", ".rnx", ".crx"), "raw GNSS observations (RINEX); RTKLIB makes a solution of them, .pos"),
    **dict.fromkeys((".mf4", ".mdf", ".blf"), "a CAN or measurement log; export its signals as CSV"),
    **dict.fromkeys((".pcap", ".pcapng"), "a capture of network packets; save the device's own log"),
}
# at the beginning of a line, where a logger's stamp may stand before it; elsewhere it is a column of a table
SENTENCE = re.compile(rb"(?:^|[\r\n])(?:[^$,;\t\r\n]*[,;\t])?[^$,;\t\r\n]*\$[A-Z]{2}(?:GGA|RMC|GNS),")
LARGEST_PEEK = 400  # lines
MOST_ABOVE = 60  # lines above a header
NAVEGO = {"imu": "fb_0", "gnss": "stdm_0"}  # a column of each of NaveGo's structures


@dataclass(frozen=True)
class Offer:
    """What a file, or a table in it, can give: ``specs`` of a mapping by kind, imu, gnss, speed, heading, baro, and
    accel or gyro where that sensor stands alone; ``refusal`` says why its fixes cannot be used as they are."""

    path: Path
    detail: str
    specs: dict[str, dict[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    table: str | None = None
    refusal: str = ""

    @property
    def name(self) -> str:
        """The file's name, and the table's where a file has several."""
        return self.path.name if self.table is None else f"{self.path.name}: {self.table}"


@dataclass(frozen=True)
class Contents:
    """What a file gives; ``held`` describes its content, for a line that refuses it, ``lost`` a table in it with
    positions of which no fixes can be made."""

    path: Path
    offers: list[Offer] = field(default_factory=list)
    held: str = ""
    lost: str = ""


def recognise_file(path: Path, known: Known = MappingProxyType({})) -> Contents:
    """What a file holds; ``known`` are a user's settings by kind, whose ``format`` and columns count for their file."""
    known = {kind: spec for kind, spec in known.items() if matches(path, spec.get("file"))}
    try:
        with path.open("rb") as file:
            begins = file.read(64)
    except OSError as error:
        return Contents(path, held=f"cannot be opened: {(error.strerror or str(error)).lower()}")
    if (other := NO_LOGS.get(".tar" if ".tar." in path.name.lower() else path.suffix.lower())) is not None:
        return Contents(path, held=other)
    if re.match(rb"\s*<(!doctype html|html)", begins, re.IGNORECASE):
        return Contents(path, held=NO_LOGS[".html"])
    if begins.startswith(b"PK\3\4"):
        return Contents(path, held="a .zip; give it as source, or unpack it")
    stated = [spec["format"] for spec in known.values() if spec.get("format") and spec.get("file")]
    name = stated[0] if stated else find_format(path)
    if name is None:
        return Contents(path, held="of no format that is known" if begins else "empty")
    if name == "matlab":
        return _offer_matlab(path, known)
    if name in PRESETS:
        return _offer_preset(path, name)
    try:
        options: dict[str, Any] = text_options(path) if name == "csv" else {}
        table = formats.read(name, path, kind="imu", table=None, text=options, where="reader")
    except InputError as error:
        return Contents(path, held=str(error).removeprefix(f"{path}: "))
    if (count := len(table.frame.columns)) > recognise.MOST_COLUMNS:
        return Contents(path, held=f"a table of {count} columns, which no log has")
    found = _offer_table(path, name, table, options, None, known)
    if not found:
        return Contents(path, held=recognise.describe_missing(table))
    return Contents(path, found, _describe_lone_sensor(table, found[0]), _describe_lost_fixes(table, found))


def matches(path: Path, file: Any) -> bool:
    """Whether a file is the one, or one of several, of a setting ``file``; any is of none."""
    return file is None or any(path.match(str(one)) for one in (file if isinstance(file, (list, tuple)) else [file]))


def _describe_lone_sensor(table: LogTable, offer: Offer) -> str:
    """What a table offers and which sensor it lacks of an IMU of which it has the other; empty where it has neither."""
    triads = vocabulary.find_triads([str(name) for name in table.frame.columns])
    alone = {*triads, *offer.specs} & {*recognise.COUNTERPARTS}
    if len(alone) != 1 or "imu" in offer.specs:
        return ""
    return f"{offer.detail}, without {recognise.COUNTERPARTS[alone.pop()]}"


def _describe_lost_fixes(table: LogTable, offers: list[Offer]) -> str:
    """What a table with a latitude has and lacks, where none of its offers has fixes; else empty."""
    frame = recognise.convert_numbers(table).frame
    names = [str(name) for name in frame.select_dtypes("number")]
    if vocabulary.find_column(names, "lat") is None or any("gnss" in offer.specs for offer in offers):
        return ""
    return recognise.describe_missing(table)


def _offer_preset(path: Path, name: str) -> Contents:
    base = read_preset("reader", name)
    source = {"file": path.name, "text": _preset_text(base)}
    lacks = {kind: _describe_lack(path, name, kind, base) for kind in ("imu", "gnss")}
    specs = {kind: {**base[kind], **source} for kind, why in lacks.items() if why is None}
    held = f"{name}, {', '.join(f'no {kind.upper()}{why}' for kind, why in lacks.items() if why is not None)}"
    module = WITH_AIDS.get(name)
    specs |= {kind: {**base[kind], **source} for kind in (module.aids(path) if module else ())}
    return Contents(path, [Offer(path, f"{name}, as reader={name}", leave_open(specs))] if specs else [], held)


def _describe_lack(path: Path, name: str, kind: str, base: Mapping[str, Any]) -> str | None:
    """Why a file of a preset's format gives no ``kind``, empty if there is no reason; None where it does."""
    if name == "rosbag":
        return None if rosbag.holds(path, kind) else f" among its topics ({rosbag.list_topics(path)})"
    if kind == "gnss":
        return None
    if name in GNSS_ONLY:
        return ""
    try:
        spec, options = base[kind], {**_preset_text(base), "lines": base[kind].get("lines")}
        table = formats.read(spec["format"], path, kind=kind, table=spec.get("table"), text=options, where="")
    except InputError as error:
        return f" ({str(error).removeprefix(f'{path}: ').partition('; set reader')[0]})"
    return None if len(table.frame) > 10 else f" (only {len(table.frame)} samples)"


def _offer_matlab(path: Path, known: Known) -> Contents:
    try:
        tables = matlab.frames(path)
    except InputError as error:
        return Contents(path, held=str(error).removeprefix(f"{path}: "))
    if all(mark in tables.get(kind, ()) for kind, mark in NAVEGO.items()):
        return _offer_preset(path, "navego")
    by_table = {
        name: _offer_table(path, "matlab", LogTable(frame, path), {}, name, known) for name, frame in tables.items()
    }
    lost = {name: _describe_lost_fixes(LogTable(tables[name], path), offers) for name, offers in by_table.items()}
    found = [offer for offers in by_table.values() for offer in offers]
    first = list(tables.items())[:4]
    said = "; ".join(f"{name}: {recognise.describe_missing(LogTable(frame, path))}" for name, frame in first)
    why = next((f"{name}: {text}" for name, text in lost.items() if text), "")
    return Contents(path, found, said or "no matrix and no structure of vectors", why)


def _offer_table(
    path: Path, name: str, table: LogTable, options: dict[str, Any], part: str | None, known: Known
) -> list[Offer]:
    table = recognise.convert_numbers(table)
    named = {kind: recognise.named_columns(table, spec) for kind, spec in known.items()}
    times = {kind: spec.get("time") or {} for kind, spec in known.items()}
    imu, gnss = recognise.imu_spec(table, named.get("imu", {}), times.get("imu", {})), None
    place = named.get("gnss", {})
    if imu is None or "position" in place or vocabulary.find_column(map(str, table.frame.columns), "lat"):
        gnss = recognise.gnss_spec(table, place, times.get("gnss", {}))
    local = stamps.find_zone_s(table, imu.spec["time"], gnss.spec["time"]) if imu and gnss else 0
    if local and imu is not None:
        imu.spec["time"]["offset_s"] = -local
    source: dict[str, Any] = {"format": name, "file": path.name, "text": options}
    source |= {"table": part} if part is not None else {}
    time = next((one.spec["time"] for one in (imu, gnss) if one is not None), None)
    taken = [str(c) for one in (imu, gnss) if one is not None for c in _columns(one.spec)]
    aids = recognise.aid_specs(table, part or path.stem, time, taken)
    found = {kind: one for kind, one in (("imu", imu), ("gnss", gnss)) if one is not None}
    if not found and not aids:
        aids = recognise.sensor_spec(table, part or path.stem)
    aids = {kind: {**spec, **source} for kind, spec in aids.items()}
    if len(found) == 2:
        source["rows"] = "filled"
    specs = {kind: {**source, **one.spec} for kind, one in found.items()}
    columns = ", ".join(dict.fromkeys(str(c) for spec in (specs or aids).values() for c in _columns(spec)))
    notes = tuple(note for one in found.values() for note in one.notes)
    if local:
        notes += (f"dates of {path.name}: {local / 3600:+g} h from UTC by the fixes' stamps, so they are local time",)
    specs = leave_open(specs | aids, stated=True)
    refusal = "" if gnss is None else gnss.refusal
    return [Offer(path, f"{name} with {columns}", specs, notes, part, refusal)] if specs else []


def find_format(path: Path) -> str | None:
    """Format of a file by its first bytes; None if it is none of those known."""
    try:
        with path.open("rb") as file:
            head = file.read(65_536)
    except OSError:
        return None
    if path.name == "metadata.yaml":
        return "rosbag" if b"rosbag2" in head else None
    for mark, name in ((b"#ROSBAG", "rosbag"), (b"\x89MCAP", "rosbag"), (b"PAR1", "parquet"), (b"ARROW1", "feather"),
                       (autopilot.ULOG, "px4"), (autopilot.DATAFLASH, "ardupilot")):  # fmt: skip
        if head.startswith(mark):
            return name
    if head.startswith((b"MATLAB", b"\x89HDF")):
        return "matlab"
    if b"\xb5b\x01\x07" in head:
        return "ubx"
    if len(SENTENCE.findall(head)) >= 3:
        return "nmea"
    if path.suffix == ".gz":
        return "csv"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
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
    """Separator, decimal mark, comment, lines above the header and header of a text table, by its first lines."""
    whole = text.decode_text(path, None).splitlines()[:LARGEST_PEEK]
    lines = [line for line in whole if line.strip()]
    options: dict[str, Any] = {}
    marked = [line.lstrip()[:1] in "#%" for line in lines]
    if sum(marked) > 1 or (marked and marked[0] and lines[0].lstrip()[0] == "%"):
        options["comment"] = lines[marked.index(True)].lstrip()[0]
        lines = [line for line, is_comment in zip(lines, marked) if not is_comment]
    if len(lines) < 2:
        return options
    body = lines[1 : min(len(lines), 50)]
    counts = {s: len(text._cells(body[-1], s)) for s in (";", "\t", ",", r"\s+")}
    few = 3 if counts[r"\s+"] > 1 else 1  # words between blanks may have a comma each
    separator = next((s for s in (";", "\t") if counts[s] > few), "," if counts[","] > min(few, 2) else r"\s+")
    options["separator"] = separator
    if above := _above_header(lines, separator):
        options["skip_rows"] = next(k for k, line in enumerate(whole) if line is lines[above])
        lines = lines[above:]
    if separator in (";", "\t", r"\s+") and any(re.search(r"\d,\d", line) for line in body):
        options["decimal"] = ","
    first = text._cells(lines[0].lstrip("#").strip(), separator)
    options["header"] = not any(text._is_number(c, options.get("decimal", ".")) for c in first)
    return options


def _above_header(lines: list[str], separator: str) -> int:
    """How many lines of text stand above the header: none of them has as many cells as the table, whose first row has
    names and whose second has numbers."""
    cells = [text._cells(line, separator) for line in lines[:MOST_ABOVE]]
    count = len(text._cells(lines[-1], separator))
    first = next((k for k, row in enumerate(cells) if len(row) == count), 0)
    if not first or first + 1 >= len(cells) or any(len(row) > count for row in cells[:first]):
        return 0
    numbers = [sum(text._is_number(c, ".") for c in row) for row in cells[first : first + 2]]
    return first if numbers[0] == 0 and numbers[1] > 1 else 0


def _preset_text(base: Mapping[str, Any]) -> dict[str, Any]:
    return {key: base[key] for key in ("separator", "decimal", "header", "comment") if key in base}


def leave_open(specs: Mapping[str, Any], stated: bool = False) -> dict[str, dict[str, Any]]:
    """Specs with everything that can be estimated left open, but an accelerometer's unit and that of
    the heights where a header ``stated`` them."""
    out = {kind: copy.deepcopy(dict(spec)) for kind, spec in specs.items()}
    for kind, spec in out.items():
        if kind == "imu":
            for key in ("accel", "gyro"):
                unit = spec[key].get("unit") if stated else None
                spec[key] = {**spec[key], "unit": unit or "auto", "axes": "auto"}
        elif kind not in ("accel", "gyro"):
            known = spec["time"].get("offset_s") if stated else None  # of samples' dates in local time
            spec["time"] = {**spec["time"], "offset_s": "auto" if known is None else known}
        if kind == "gnss":
            spec["time"]["drift_ppm"] = "auto"
            spec["velocity"] = {**(spec.get("velocity") or {}), "unit": "auto"}
            left = {"height_unit": "auto"} if stated else {}  # a preset's format defines it
            spec["position"] = {**left, **spec["position"], "zero": "none", "delay_s": "auto"}
    return out


def _columns(spec: Mapping[str, Any]) -> list[Any]:
    entries = [v for k, v in spec.items() if isinstance(v, Mapping) and k != "time"]
    return [c for entry in entries for c in entry.get("columns") or []]
