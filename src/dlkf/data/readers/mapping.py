"""A table of a log and the part of the mapping that explains it: columns as numbers, vectors, stamps."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError, did_you_mean, list_some
from dlkf.data.bursts import follow_at_once
from dlkf.data.readers import units, vocabulary
from dlkf.data.readers.frames import LogTable

Spec = Mapping[str, Any]
TABULAR = (None, "csv", "parquet", "feather", "matlab")  # formats whose columns and stamps are a user's own
MOST_NAMED = 24
SOURCE = ("format", "file", "table", "lines", "rows", "text", "time")
TIME = ("column", "unit", "week", "week_number", "day", "order", "wraps_s", "clock", "offset_s", "drift_ppm", "respace")
GROUPS = {
    "imu": ("accel", "gyro", "increments", "stamp"),
    "gnss": ("position", "velocity", "std_position", "std_velocity", "quality", "every_s"),
    "reference": ("position", "velocity", "attitude", "valid"),
    "speed": ("value", "std"),
    "heading": ("value", "std"),
    "baro": ("pressure", "height", "std"),
}
ENTRIES = {
    "accel": ("columns", "unit", "axes", "mirror"),
    "gyro": ("columns", "unit", "axes", "mirror"),
    "position": ("columns", "unit", "height_unit", "frame", "geoid", "hemispheres", "zero", "delay_s"),
    "velocity": ("columns", "unit", "climb_unit", "frame"),
    "std_position": ("columns", "unit", "frame"),
    "std_velocity": ("columns", "unit", "frame"),
    "quality": ("column", "map", "default"),
    "attitude": ("columns", "unit", "convention", "order"),
    "valid": ("column", "values"),
    "value": ("columns", "unit", "counts", "per_metre", "per_turn", "radius_m", "convention", "antennas_deg"),
    "pressure": ("columns", "unit"),
    "height": ("columns", "unit"),
    "std": ("columns",),
}
NUMBERS = ("week_number", "wraps_s", "offset_s", "drift_ppm", "delay_s", "every_s", "per_metre", "per_turn")
NUMBERS += ("radius_m", "antennas_deg")  # or auto, where that is allowed
OPTIONAL = ("velocity", "std_position", "std_velocity", "quality", "attitude", "valid", "std")
POSITIVE = ("week_number", "wraps_s", "every_s", "per_metre", "per_turn", "radius_m")
SWITCHES = ("respace", "increments", "counts")


def check_keys(spec: Spec, kind: str) -> None:
    """InputError for a key of ``imu``, ``gnss`` or ``reference`` that means nothing."""
    _check_known(spec, (*SOURCE, *GROUPS[kind]), f"reader.{kind}")
    _check_known(spec.get("time"), TIME, f"reader.{kind}.time")
    for name in GROUPS[kind]:
        if name in ENTRIES:
            _check_known(spec.get(name), (*ENTRIES[name], *SOURCE), f"reader.{kind}.{name}")
            _check_known((spec.get(name) or {}).get("time"), TIME, f"reader.{kind}.{name}.time")


def _check_known(spec: Any, known: tuple[str, ...], where: str) -> None:
    if spec is None:
        return
    if not isinstance(spec, Mapping):
        raise InputError(f"{where} is {spec!r}, must be a mapping of {', '.join(known)}")
    if unknown := [str(key) for key in spec if key not in known]:
        near = did_you_mean(unknown[0], known)
        raise InputError(f"{where}: unknown key {unknown[0]}{near or ';'} known are {', '.join(known)}")
    for key in NUMBERS:
        if spec.get(key) not in (None, "auto") and units.number(spec[key], f"{where}.{key}") <= 0 and key in POSITIVE:
            raise InputError(f"{where}.{key} is {spec[key]}, must be above 0")
    for key in SWITCHES:
        if not isinstance(spec.get(key), (bool, type(None))):
            raise InputError(f"{where}.{key} is {spec[key]!r}, must be true or false")


DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Mapped:
    """A table with the mapping of its ``kind`` (imu, gnss, reference).

    ``parts`` are entries that come from another table, its rows already brought to the rows of this one.
    """

    table: LogTable
    spec: Spec
    kind: str
    parts: Mapping[str, Mapped] = field(default_factory=dict)

    @property
    def time(self) -> Spec:
        """What the mapping says of the stamps."""
        return self.spec.get("time") or {}

    def __len__(self) -> int:
        return len(self.table.frame)

    def column(self, name: str | int, *, nan: bool) -> np.ndarray:
        """A column as numbers; empty cells are NaN where ``nan`` allows."""
        values = self._cells(name)
        if not pd.api.types.is_numeric_dtype(values) or pd.api.types.is_bool_dtype(values):
            texts = values.astype(str).str.strip()
            numbers = pd.to_numeric(texts, errors="coerce")
            empty = values.isna() | texts.str.lower().isin(["", "nan", "na", "none", "null"])
            bad = np.flatnonzero((numbers.isna() & ~empty).to_numpy())
            if len(bad):
                remedy = "correct the line"
                if np.mean(numbers.isna()) > 0.5 and str(name) == str(self.time.get("column")):
                    remedy = f"set reader.{self.kind}.time.unit=iso if that is a date and time"
                if DECIMAL_COMMA.fullmatch(texts.iloc[bad[0]]):
                    remedy = f"set reader.decimal=',' (+reader.{self.kind}.text.decimal=',' for this file alone)"
                self.fail(int(bad[0]), name, f"is {values.iloc[bad[0]]!r}, not a number; {remedy}")
            values = numbers
        if not nan and bool(values.isna().any()):
            row = int(np.flatnonzero(values.isna())[0])
            remedy = f"correct or remove the line, or leave such rows out with reader.{self.kind}.rows=filled"
            self.fail(row, name, f"has no value; {remedy}")
        if not nan and len(beyond := np.flatnonzero(np.isinf(values.to_numpy(np.float64)))):
            self.fail(int(beyond[0]), name, f"is {values.iloc[beyond[0]]}; correct or remove the line")
        return values.to_numpy()

    def texts(self, name: str | int) -> pd.Series:
        """A column as stripped texts; whole numbers without a point."""
        values = self._cells(name)
        whole = values.map(lambda v: str(int(v)) if isinstance(v, float) and v.is_integer() else str(v))
        return whole.str.strip()

    def vector(self, key: str, count: tuple[int, ...], *, nan: bool) -> np.ndarray:
        """The columns of an entry of the mapping, as floats (rows, n)."""
        names = self.spec[key]["columns"]
        if isinstance(names, str) or len(names) not in count:
            many = " or ".join(str(c) for c in count)
            has = "a single name" if isinstance(names, str) else f"{len(names)} names"
            height = "; a log without a height needs a column with that of the place in all rows"
            height = height if key == "position" and len(names) == 2 else ""
            raise InputError(f"reader.{self.kind}.{key}.columns has {has}, must have {many}{height}")
        part = self.find_part(key)
        return np.stack([part.column(n, nan=nan).astype(float) for n in names], -1)

    def find_part(self, key: str) -> Mapped:
        """The table that an entry's columns are in."""
        return self.parts.get(key, self)

    def has(self, key: str) -> bool:
        """Whether the mapping explains an optional entry."""
        entry = self.spec.get(key)
        if not entry:
            return False
        return entry.get("columns") is not None or entry.get("column") is not None

    def stamps(self) -> tuple[np.ndarray, np.ndarray]:
        """Whole seconds and the rest of the rows' times, offset and drift included."""
        where = f"reader.{self.kind}.time"
        whole, part = self.own_stamps()
        offset = units.number(self.time.get("offset_s") or 0.0, f"{where}.offset_s")
        if drift := units.number(self.time.get("drift_ppm") or 0.0, f"{where}.drift_ppm"):
            part = part + 1e-6 * drift * ((whole - whole[0]) + (part - part[0]))
        jump = math.floor(offset)
        return whole + jump, part + (offset - jump)

    def first_gps_s(self) -> float | None:
        """GPS time of the first row [s since 1980] by the table's own clock; None where that has no date."""
        whole, part = self.own_stamps()
        first = float(whole[0]) + float(part[0])
        known = units.clock_by_size(first)
        if known is not None and any(self.time.get(key) is not None for key in ("clock", "week", "week_number")):
            known = "gps"
        return None if known is None else float(units.gps_seconds(first)) if known == "unix" else first

    def own_stamps(self) -> tuple[np.ndarray, np.ndarray]:
        """Whole seconds and the rest of the rows' times on the table's own clock, as GPS time where that is given."""
        time, where = self.time, f"reader.{self.kind}.time"
        name, unit = time.get("column"), time.get("unit") or "s"
        if name is None:
            raise InputError(f"{where}.column is missing; name the column of the stamps")
        wraps_s = time.get("wraps_s")
        if unit == units.ISO:
            names = [name] if isinstance(name, (str, int)) else list(name)
            values = self._cells(names[0]).astype(str)
            for more in names[1:]:
                values = values.str.cat(self._cells(more).astype(str), sep=" ")
            values = values.to_numpy()
            if (of_day := units.nanoseconds_of_day(values, where)) is not None:
                values, unit, wraps_s = of_day, "ns", wraps_s or units.DAY_S
            elif wraps_s is not None:
                raise InputError(f"{where}.wraps_s={wraps_s}: stamps with a date do not start again; leave it out")
        else:
            values, unit = self._numbers(name, unit)
        day = None if time.get("day") is None else str(time["day"])
        if unit == units.HHMMSS:
            values, unit = units.seconds_of_day(values), "s"
            day = units.day_of_number(self._cells(name[0]).iloc[0]) if isinstance(name, list) else day
        if unit in units.DAYS:
            values, unit = (values - units.DAYS[unit]) * 86_400.0, "s"
        if wraps_s is not None:
            values = units.unwrap_stamps(values, float(wraps_s), units.TIME.get(unit, 1))
        week = self.column(time["week"], nan=False) if time.get("week") is not None else None
        if time.get("week_number") is not None:
            week = np.full(len(self), int(time["week_number"]))
        order = None if time.get("order") is None else str(time["order"])
        return units.seconds(values, unit, week, time.get("clock"), f"{self.table.path}, {where}", day, order)

    def first_count_s(self) -> float:
        """The first row's stamp [s] as the table has it, of numbers."""
        values, unit = self._numbers(self.time["column"], self.time.get("unit") or "s")
        return float(values[0]) / units.TIME[unit]

    def _numbers(self, name: Any, unit: str) -> tuple[np.ndarray, str]:
        """A column of stamps and its unit, the last of several; of two columns of numbers (not of hhmmss) the sum of
        whole seconds and of the rest, in ``unit`` or in that of its name."""
        names = name if isinstance(name, list) else [name]
        if len(names) != 2 or unit == units.HHMMSS or not pd.api.types.is_numeric_dtype(self._cells(names[0])):
            return self.column(names[-1], nan=False), unit
        (first, second), where = names, f"reader.{self.kind}.time"
        of_rest = vocabulary.find_fraction(str(second)) if unit == "s" else unit
        if of_rest is None:
            raise InputError(
                f"{where}.unit is {unit}, must be ms, us or ns: of {second!r}, beside the seconds in {first!r}"
            )
        whole, rest = (self.column(one, nan=False) for one in (first, second))
        ticks = units.factor(of_rest, units.TIME, f"{where}.unit")
        if len(bad := np.flatnonzero(whole % 1 != 0)):
            self.fail(int(bad[0]), first, f"is {whole[bad[0]]}, must be whole seconds beside {second!r}")
        if len(bad := np.flatnonzero((rest < 0) | (rest >= ticks))):
            limit = f"must be below {ticks:.0f} ({of_rest} beside the seconds in {first!r})"
            self.fail(int(bad[0]), second, f"is {rest[bad[0]]}, {limit}")
        billion = units.TIME["ns"]
        return whole.astype(np.int64) * billion + np.round(rest * (billion / ticks)).astype(np.int64), "ns"

    def scale(self, key: str, table: Mapping[str, float], name: str = "unit") -> float:
        """SI per unit of an entry; the first unit of the table if the entry has none."""
        unit = self.spec[key].get(name)
        where = f"reader.{self.kind}.{key}.{name}"
        return units.factor(next(iter(table)) if unit is None else unit, table, where)

    def option(self, key: str, name: str, *known: str) -> str:
        """A word in an entry, the first of those known where it has none; InputError for any other."""
        word = (self.spec.get(key) or {}).get(name) or known[0]
        if word not in known:
            *most, last = known
            raise InputError(f"reader.{self.kind}.{key}.{name}={word}: must be {', '.join(most)} or {last}")
        return word

    def rows(self, keep: np.ndarray) -> Mapped:
        """Some rows, of the parts too."""
        parts = {key: part.rows(keep) for key, part in self.parts.items()}
        return replace(self, table=replace(self.table, frame=self.table.frame[keep]), parts=parts)

    def name_row(self, row: int) -> str:
        """A row by its number in the file, with its stamp as it stands there."""
        column = self.time.get("column")
        names = [str(one) for one in (column if isinstance(column, list) else [column]) if one is not None]
        there = [f"{name} {self.table.frame[name].iloc[row]}" for name in names if name in self.table.frame]
        return f"{self.table.row} {self.table.frame.index[row]}" + (f" ({', '.join(there)})" if there else "")

    def fail(self, row: int, name: str | int, what: str) -> None:
        """Raise InputError for a row, by its number in the file."""
        number = self.table.frame.index[row]
        raise InputError(f"{self.table.path}: {self.table.row} {number}: column {str(name)!r} {what}")

    def _cells(self, name: str | int) -> pd.Series:
        """A column; of alternatives (``A | B``) the first that is there."""
        name = next((one for one in (str(name), *str(name).split(" | ")) if one in self.table.frame), str(name))
        if name not in self.table.frame:
            have = [str(c) for c in self.table.frame.columns]
            raise InputError(
                f"{self.table.path}: no column {name!r}; has {list_some(have, MOST_NAMED)}; {self._entry_to_set(name)}"
            )
        return self.table.frame[name]

    def _entry_to_set(self, name: str) -> str:
        """The key that names a column which is not there; an entry that a log need not have may be null."""
        for key in ("time", *GROUPS[self.kind]):
            entry = self.spec.get(key)
            for word in ("columns", "column"):
                named = entry.get(word) if isinstance(entry, Mapping) else None
                if name in ([named] if isinstance(named, (str, int)) else [str(n) for n in named or ()]):
                    place = f"reader.{self.kind}.{key}.{word}"
                    return f"set {place}" + (f", {place}=null if the log has none" if key in OPTIONAL else "")
        return f"set it in reader.{self.kind}"


def select_rows(mapped: Mapped) -> Mapped:
    """The rows that ``rows`` chooses: ``{column: …, is: [...]}``; ``filled``: those whose columns are not empty;
    ``changed``: of these, those whose position is not that of the row before; ``once``: those that do not have
    the stamp and all columns of the row before."""
    rows = mapped.spec.get("rows")
    where = f"reader.{mapped.kind}.rows"
    if rows is None:
        return mapped
    if rows in ("filled", "changed", "once"):
        entries = ("accel", "gyro", "position", "pressure", "height")
        names = {str(n) for key in entries for n in _names(mapped, key)}
        time = mapped.time.get("column")
        names |= {str(n) for n in ([time] if isinstance(time, (str, int)) else time or [])}
        frame = mapped.table.frame
        keep = ~_find_empty(frame[[c for c in frame.columns if c in names]]).any(axis=1).to_numpy()
        some = [c for c in frame.columns if c in {str(n) for n in _names(mapped, "value")}]
        if some:  # of several wheels one is enough
            keep &= ~_find_empty(frame[some]).all(axis=1).to_numpy()
        if rows == "changed":
            place = frame.loc[keep, [c for c in frame.columns if c in {str(n) for n in _names(mapped, "position")}]]
            keep[keep] = (place != place.shift()).any(axis=1).to_numpy()
        elif rows == "once":
            cells = frame.loc[keep, [c for c in frame.columns if c in names or c in some]]
            keep[keep] = (cells != cells.shift()).any(axis=1).to_numpy()
    elif isinstance(rows, Mapping) and set(rows) == {"column", "is"}:
        values = rows["is"] if isinstance(rows["is"], (list, tuple)) else [rows["is"]]
        keep = mapped.texts(rows["column"]).isin([str(v) for v in values]).to_numpy()
    else:
        raise InputError(f"{where} is {rows!r}, must be filled, changed, once or {{column: …, is: [...]}}")
    if not keep.any():
        raise InputError(f"{mapped.table.path}: no row is left by {where}={rows}; set it right")
    return mapped.rows(keep)


def _find_empty(cells: pd.DataFrame) -> pd.DataFrame:
    return cells.isna() | cells.astype(str).apply(lambda c: c.str.strip() == "")


def spread_stamps(t: np.ndarray) -> np.ndarray:
    """Rows of one stamp, or of one packet, spread evenly over the time since the stamp before (a clock coarser than the
    rate, or that of a host)."""
    first = np.flatnonzero(~follow_at_once(t))
    count = np.diff(first, append=len(t))
    t = np.repeat(t[first + count - 1], count)  # of a packet's end
    steps = np.diff(t[first])
    usual = float(np.median(steps / count[1:])) if len(steps) else 0.0
    since = np.concatenate(([usual * count[0]], np.minimum(steps, 3 * usual * count[1:]))) if len(first) else steps
    place = np.arange(len(t)) - np.repeat(first, count) + 1
    return t - np.repeat(since, count) * (1 - place / np.repeat(count, count))


def list_unused(mapped: Mapping[str, Mapped]) -> list[str]:
    """A line for each text table, matrix or file of columns on those that no entry of the mapping takes."""
    used: dict[str, set[str]] = {}
    there: dict[str, list[str]] = {}
    for whole in mapped.values():
        for part in (whole, *whole.parts.values()):
            if part.spec.get("format") not in TABULAR:
                continue
            name = f"{part.table.path.name}{'' if not part.spec.get('table') else ': ' + str(part.spec['table'])}"
            there.setdefault(name, [str(c) for c in part.table.frame.columns])
            used.setdefault(name, set()).update(_column_names(part.spec))
    left = {name: [c for c in columns if c not in used[name]] for name, columns in there.items()}
    some = {name: list_some(columns, MOST_NAMED) for name, columns in left.items() if columns}
    return [f"columns of {name} that are not used: {columns}" for name, columns in some.items()]


def _column_names(spec: Any) -> set[str]:
    """Every name of a column in a mapping, alternatives (``A | B``) apart."""
    if not isinstance(spec, Mapping):
        return set()
    found: set[str] = set()
    for key, value in spec.items():
        if key in ("columns", "column", "week", "geoid", "hemispheres") and value is not None:
            for name in [value] if isinstance(value, (str, int)) else value:
                found |= {str(name), *str(name).split(" | ")}
        else:
            found |= _column_names(value)
    return found


def _names(mapped: Mapped, key: str) -> list[Any]:
    entry = mapped.spec.get(key) or {}
    return [] if key in mapped.parts else list(entry.get("columns") or [])
