"""What the columns of a table are: by their names, else by their numbers."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from dlkf.data.bursts import MANY, share_at_once
from dlkf.data.discovery.units import accel_units
from dlkf.data.limits import DEGREE_M, EARTH_M
from dlkf.data.readers import by_numbers, stamps, units, vocabulary
from dlkf.data.readers.aids import COUNTS
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.qualities import quality_spec
from dlkf.data.readers.receivers import choose_receiver, find_geoid, find_velocity
from dlkf.data.resampling import DEFAULT_STD
from dlkf.navigation.earth import STANDARD_GRAVITY as G

Spec = dict[str, Any]
SLOWEST_IMU_S, FASTEST_IMU_S = 0.21, 2e-4
SLOWEST_FIX_S, FASTEST_FIX_S = 12.0, 0.02
SLOWEST_AID_S, FASTEST_AID_S = 2.0, 9e-4
PRESSURES = {"pa": (6e4, 1.1e5), "hpa": (600.0, 1100.0), "kpa": (60.0, 110.0)}
SPEED_UNITS = ("km/h", "mph", "m/s", "knots", "rpm")
MOST_COLUMNS = 500  # no log of a car has more; each is looked at in many ways
NEAR_GRAVITY = 0.08
NONE_NAMED: Mapping[str, list[str]] = MappingProxyType({})
COUNTERPARTS = {"accel": "a gyroscope", "gyro": "an accelerometer"}  # what a table with one sensor alone lacks
COARSE = 0.2  # of the samples, with the stamp of the one before: the clock is coarser than the rate


class Recognised(NamedTuple):
    """The mapping of a table, and lines on what was taken for what; ``refusal`` says why it cannot be used as it is."""

    spec: Spec
    notes: tuple[str, ...] = ()
    refusal: str = ""


def named_columns(table: LogTable, known: Mapping[str, Any]) -> dict[str, list[str]]:
    """The columns that a user's settings name for each entry of a mapping, of those entries that a table has whole."""
    entries = {key: spec["columns"] for key, spec in known.items() if isinstance(spec, Mapping) and spec.get("columns")}
    _, names = _select_numeric(table)
    return {key: [str(c) for c in columns] for key, columns in entries.items() if {*map(str, columns)} <= {*names}}


def imu_spec(
    table: LogTable, named: Mapping[str, list[str]] = NONE_NAMED, named_time: Mapping[str, Any] = stamps.NONE_NAMED
) -> Recognised | None:
    """The mapping of a table that holds an IMU, in the columns that are ``named`` by entry (:func:`named_columns`) or
    known by their names or numbers, at the stamps of the settings ``named_time``; None if it does not."""
    frame, names = _select_numeric(table)
    triads = vocabulary.find_triads(names) | {key: named[key] for key in vocabulary.SENSORS if key in named}
    if len(triads) == 2:
        known = frame[triads["accel"] + triads["gyro"]].notna().all(axis=1)
        time = stamps.time_spec(table, known, SLOWEST_IMU_S, FASTEST_IMU_S, named_time)
        if time is None:
            return None
        sensors = {key: {"columns": columns} for key, columns in triads.items()}
        sensors["accel"] |= _find_stated_unit(frame, triads["accel"])
        notes = _spread(frame[known], time)
        return Recognised({"time": time, **sensors}, notes)
    if triads or vocabulary.find_column(names, "lat"):
        return None
    spec = by_numbers.imu_spec(frame)
    if spec is None:
        return None
    spec |= _find_named_time(table, SLOWEST_IMU_S, FASTEST_IMU_S, named_time)
    columns = [*spec["accel"]["columns"], *spec["gyro"]["columns"]]
    notes = () if _are_unnamed(names) else (f"took {', '.join(columns[:3])} for the accelerometers by gravity, "
                                        f"{', '.join(columns[3:])} for the gyroscopes",)  # fmt: skip
    return Recognised(spec, notes)


def _spread(frame: pd.DataFrame, time: Spec) -> tuple[str, ...]:
    """Asks for samples of one stamp, or of one packet, to be spread: a clock coarser than the rate, or a host's."""
    column = time.get("column")
    if not isinstance(column, str) or column not in frame or not pd.api.types.is_numeric_dtype(frame[column]):
        return ()
    t = frame[column].to_numpy(float)
    same, packed = float((np.diff(t) == 0).mean()) if len(t) > 1 else 0.0, share_at_once(t)
    if same < COARSE and packed < MANY:
        return ()
    time["respace"] = True
    said = (
        f"{100 * same:.0f} % of the samples have the stamp of the one before"
        if same >= COARSE
        else f"{100 * packed:.0f} % of the samples came in a packet with the one before"
    )
    return (f"{said}: spread evenly (time.respace=true)",)


def sensor_spec(table: LogTable, called: str) -> dict[str, Spec]:
    """The mapping, by ``accel`` or ``gyro``, of a table that holds that sensor alone; ``called`` is the table's name,
    which counts where the columns are plain x, y, z."""
    frame, names = _select_numeric(table)
    for key, stem in vocabulary.SENSORS.items():
        columns = vocabulary.find_triads(names).get(key)
        if columns is None and vocabulary.has(called, rf"\b{stem}\b"):
            columns = vocabulary.triad(names, "(?:)") or vocabulary.triad(names, r"\w*")
        if columns is None:
            continue
        known = frame[columns].notna().all(axis=1)
        time = stamps.time_spec(table, known, SLOWEST_IMU_S, FASTEST_IMU_S)
        if time is not None:
            return {key: {"time": time, key: {"columns": columns}}}
    return {}


def gnss_spec(
    table: LogTable, named: Mapping[str, list[str]] = NONE_NAMED, named_time: Mapping[str, Any] = stamps.NONE_NAMED
) -> Recognised | None:
    """The mapping of a table that holds fixes, in the columns and at the stamps that are named as an IMU's; None if it
    does not."""
    frame, names = _select_numeric(table)
    receiver = choose_receiver(frame, [str(n) for n in table.frame.columns], named.get("position", ()))
    found = receiver.found
    lat, lon, height = (found[key] for key in ("lat", "lon", "height"))
    if (lat is None or lon is None) and vocabulary.find_triads(names):
        return None
    if lat is None or lon is None:
        spec = by_numbers.gnss_spec(table)
        if spec is None:
            return None
        spec |= _find_named_time(table, SLOWEST_FIX_S, FASTEST_FIX_S, named_time)
        columns = ", ".join(spec["position"]["columns"])
        more = "; found others by the way between the positions" if spec["velocity"].get("columns") else ""
        note = f"took {columns} for latitude, longitude, height{more}"
        return Recognised(spec, () if _are_unnamed(names) else (note,))
    known = frame[[lat, lon]].notna().all(axis=1)
    clock = stamps.find_named(table.frame, named_time)
    if not clock and (clock := vocabulary.match_columns(names, vocabulary.SINCE_1970)[:1]):
        named_time = {**named_time, "column": clock[0]}
    rows, held = stamps.find_repeated(table.frame[known], [lat, lon], clock)
    known[known] = ~held
    time = stamps.time_spec(table, known, SLOWEST_FIX_S, FASTEST_FIX_S, named_time)
    if time is None or height is None:
        return None
    position: Spec = {"columns": [lat, lon, height], "unit": _angle_unit(frame, found)}
    if (unit := vocabulary.find_unit(height)) in units.LENGTH:
        position["height_unit"] = unit
    more = []
    if (geoid := find_geoid(frame, receiver)) is not None:
        position["geoid"] = geoid
        more = [f"added {geoid} to {height}; reader.gnss.position.geoid=null if that is above the ellipsoid already"]
    if (sides := _hemispheres(table.frame[known])) is not None:
        position["hemispheres"] = sides
    velocity = find_velocity([name for name in receiver.names if name in frame], receiver.called)
    if "velocity" in named:
        velocity = {"columns": named["velocity"], "frame": "ned"}
    elif velocity is None:
        velocity = _velocity_by_numbers(table, frame[known], time, position)
        if columns := velocity["columns"]:
            more += [f"took {', '.join(columns)} for the velocities by the way between the positions"]
    out: Spec = {"time": time, "position": position, "velocity": velocity}
    out |= _accuracies(frame, found, raw=position["unit"] == "1e-7deg")
    quality, notes = quality_spec(
        table.frame[known], _quality_column(table.frame[receiver.names]), _accuracy_m(frame, out)
    )
    if quality is not None:
        out["quality"] = quality
    if "std_position" not in out and found["hdop"] is not None:
        spec, note = _dilutions(table.frame[known], found, quality)
        out |= spec
        notes.append(note)
    if rows is not None:
        out["rows"] = rows
        what = {"changed": "position", "once": "stamp and position"}[rows]
        notes.append(f"took {int(known.sum())} of {len(held)} rows for fixes: the others repeat the {what} before")
    return Recognised(out, (*more, *notes), receiver.refusal)


def _find_named_time(table: LogTable, slowest: float, fastest: float, named: Mapping[str, Any]) -> Spec:
    """The entry ``time`` of a mapping by the settings; empty where they name no column of the table."""
    if not stamps.find_named(table.frame, named):
        return {}
    time = stamps.time_spec(table, pd.Series(True, table.frame.index), slowest, fastest, named)
    return {} if time is None else {"time": time}


def _velocity_by_numbers(table: LogTable, frame: pd.DataFrame, time: Spec, position: Spec) -> Spec:
    """Velocities under names that are not known: columns that agree with the way between the positions."""
    t = stamps.read_seconds(LogTable(table.frame.loc[frame.index], table.path, table.row), time)
    scale = {"deg": 1.0, "1e-7deg": 1e-7, "rad": 180 / np.pi}.get(position["unit"])
    if scale is None:
        return {"columns": None}
    taken = {*position["columns"], *(time["column"] if isinstance(time["column"], list) else [time["column"]])}
    lat, lon = (scale * frame[c].to_numpy(float) for c in position["columns"][:2])
    others = [c for c in frame.columns if str(c) not in taken and not vocabulary.is_wheel(str(c))]
    return by_numbers.velocities(t, lat, lon, frame[others])


def _hemispheres(frame: pd.DataFrame) -> list[str] | None:
    """The columns that have N or S, and E or W, in every row; None where a table has not both."""
    texts = [str(n) for n in frame.columns if not pd.api.types.is_numeric_dtype(frame[n])]
    letters = {n: set(frame[n].astype(str).str.strip().str.upper()) for n in texts}
    sides = [next((n for n in texts if letters[n] <= both), None) for both in ({"N", "S"}, {"E", "W"})]
    return [side for side in sides if side is not None] if all(sides) and len(frame) else None


def aid_specs(table: LogTable, called: str, time: Spec | None = None, taken: Collection[str] = ()) -> dict[str, Spec]:
    """The mapping of every aid in a table: wheel speed, heading and barometer by the columns' names, a pressure by its
    size too.

    ``called`` is the table's name, ``time`` the mapping of its stamps where an IMU or fixes in it have set it. The
    speed of a receiver is none of a wheel: it is among the columns ``taken``, stands beside a latitude without a
    wheel's name, or is called so.
    """
    numbers, names = _select_numeric(table)
    places = vocabulary.find_column(names, "lat") is not None
    found: dict[str, Spec] = {}
    wheels = vocabulary.wheel_columns([n for n in names if n not in taken], "" if places else called)
    if wheels:
        found["speed"] = {"value": _wheel_value(numbers, wheels)}
    headings = [n for n in names if vocabulary.has(n, vocabulary.HEADING)]
    compass = any(vocabulary.has(n, vocabulary.COMPASS) for n in names)
    if not headings and not places and not compass and vocabulary.has(called, rf"{vocabulary.HEADING}|^heading$"):
        headings = [n for n in names if n == vocabulary.find_column([n], "course")]
    if headings:
        degrees = float(np.nanmax(np.abs(numbers[headings[0]]))) > 2 * np.pi + 0.01
        found["heading"] = {"value": {"columns": headings[:1], "unit": "deg" if degrees else "rad"}}
    if pressures := vocabulary.match_columns(names, vocabulary.PRESSURE):
        size = float(np.nanmedian(numbers[pressures[0]]))
        if unit := next((u for u, (least, most) in PRESSURES.items() if least < size < most), None):
            found["baro"] = {"pressure": {"columns": pressures[:1], "unit": unit}}
    elif heights := vocabulary.match_columns(names, vocabulary.BARO_HEIGHT):
        found["baro"] = {"pressure": {"columns": None}, "height": {"columns": heights[:1], "unit": "m"}}
    out = {}
    for name, spec in found.items():
        column = (spec.get("value") or spec["pressure"])["columns"] or spec["height"]["columns"]
        known = time or stamps.time_spec(table, numbers[column[0]].notna(), SLOWEST_AID_S, FASTEST_AID_S)
        if known is not None:
            out[name] = {"time": {"offset_s": "auto", **known}, "rows": "filled", **spec}
    return out


def _wheel_value(numbers: pd.DataFrame, columns: list[str]) -> Spec:
    """Columns with the unit that their name states, else left to GNSS; what never falls and is called so counts on."""
    unit = vocabulary.find_unit(columns[0])
    counted = vocabulary.has(columns[0], vocabulary.COUNTED) and unit not in SPEED_UNITS
    if counted and unit not in COUNTS:
        rises = bool((numbers[columns[0]].dropna().diff() >= 0).mean() > 0.9)
        return {"columns": columns, "unit": "auto", "counts": rises}
    return {"columns": columns, "unit": unit if unit in SPEED_UNITS and unit != "rpm" else "auto"}


def velocity_spec(table: LogTable) -> tuple[Spec, Spec] | None:
    """Time and velocities of a table that has these and no positions; None if it does not."""
    _, names = _select_numeric(table)
    velocity = find_velocity(names)
    if velocity is None:
        return None
    every = pd.Series(True, table.frame.index)
    time = stamps.time_spec(table, every, SLOWEST_FIX_S, FASTEST_FIX_S)
    return None if time is None else (time, velocity)


def describe_missing(table: LogTable) -> str:
    """What a table has and what it lacks, in words, for a line that refuses it."""
    table = convert_numbers(table)
    _, names = _select_numeric(table)
    has = list(vocabulary.find_triads(names))
    has += ["positions"] if vocabulary.find_column(names, "lat") else []
    columns = [str(c) for c in table.frame.columns]
    text = f"columns {', '.join(columns[:12])}{', …' if len(columns) > 12 else ''}"
    if not has:
        lat = vocabulary.find_column(columns, "lat")
        if lat is not None and len(table.frame):
            return f"{text}: {lat} has text such as {table.frame[lat].iloc[0]}, must be decimal degrees"
        return f"{text}, of which none is known"
    lacks = [] if len(has) > 1 or "positions" in has else [COUNTERPARTS[has[0]]]
    if "positions" in has:
        lacks += [] if vocabulary.find_column(names, "lon") else ["a longitude"]
        lacks += [] if vocabulary.find_column(names, "height") else ["a height (one number in all rows will do)"]
    rows = pd.Series(True, table.frame.index)
    if stamps.time_spec(table, rows, SLOWEST_FIX_S, FASTEST_IMU_S) is None:
        times = [n for n in vocabulary.match_columns(columns, vocabulary.TIME) if n not in names]
        of_day = times and table.frame[times[0]].astype(str).iloc[:20].str.match(units.OF_DAY).all()
        lacks.append("a date beside the times of day" if of_day else "stamps that can be read")
    return f"{text}: has {' and '.join(has)}" + (f", lacks {' and '.join(lacks)}" if lacks else "")


def convert_numbers(table: LogTable) -> LogTable:
    """The table as all else here takes it: columns whose cells are numbers for the most part as numbers."""
    frame = table.frame.iloc[:, :MOST_COLUMNS].copy(deep=False)
    for name in frame.columns:
        values = frame[name]
        filled = values.notna()
        if not pd.api.types.is_numeric_dtype(values):
            filled &= values.astype(str).str.strip() != ""
            values = pd.to_numeric(values, errors="coerce")
        # of what stands there: rows of another kind leave it empty
        frame[name] = values if values.notna().sum() > 0.5 * filled.sum() else frame[name].astype(object)
    return replace(table, frame=frame)


def _select_numeric(table: LogTable) -> tuple[pd.DataFrame, list[str]]:
    """The columns with numbers, and their names."""
    frame = table.frame.loc[:, [pd.api.types.is_numeric_dtype(kind) for kind in table.frame.dtypes]]
    return frame, [str(c) for c in frame.columns]


def _are_unnamed(names: list[str]) -> bool:
    return all(name.isdigit() for name in names)


def _find_stated_unit(frame: pd.DataFrame, columns: list[str]) -> Spec:
    """The accelerometers' unit where the header states it, gravity does not object and would not find it alone: a unit
    that gravity finds may have the opposite sign, as some phones give it."""
    unit = vocabulary.find_unit(columns[0])
    if unit not in units.ACCELERATION:
        return {}
    size = float(np.median(np.linalg.norm(frame[columns].dropna().to_numpy(), axis=1)))
    near = size > 0 and abs(np.log(size * units.ACCELERATION[unit] / G)) < NEAR_GRAVITY
    return {"unit": unit} if near and accel_units(size, units.ACCELERATION) != [unit] else {}


def _accuracies(frame: pd.DataFrame, found: dict[str, str | None], raw: bool) -> Spec:
    """1σ of positions and velocities: of each axis, or horizontal and vertical; of velocities one for all axes.

    ``raw``: positions are u-blox' numbers, so that accuracies without a unit are in mm and mm/s.
    """
    out: Spec = {}
    for key, stem, others in (
        ("std_position", "pos", [found["hacc"], found["vacc"]]),
        ("std_velocity", "vel", [found["sacc"]]),
    ):
        axes = [found[f"std_{stem}_{axis}"] for axis in "ned"]
        columns = [str(c) for c in (axes if all(axes) else [c for c in others if c is not None])]
        if not columns or (not all(axes) and others[0] is None):
            continue
        known = units.LENGTH if stem == "pos" else units.SPEED
        out[key] = {"columns": columns} | ({"unit": u} if (u := vocabulary.find_unit(columns[0])) in known else {})
        if "unit" not in out[key] and (raw or float(frame[columns[0]].median()) > 500):  # half a km is no accuracy
            out[key]["unit"] = "mm" if stem == "pos" else "mm/s"  # as u-blox has them
    return out


def _accuracy_m(frame: pd.DataFrame, spec: Spec) -> float:
    """The median of the horizontal accuracy [m], NaN where there is none."""
    if (std := spec.get("std_position")) is None:
        return float("nan")
    return float(frame[std["columns"][0]].median()) * units.LENGTH[std.get("unit", "m")]


def _quality_column(frame: pd.DataFrame) -> str | None:
    """The column of the fix quality; of u-blox' two the carrier solution, where every row has a fix."""
    names = [str(c) for c in frame.columns[:MOST_COLUMNS]]
    name, carrier = vocabulary.find_column(names, "quality"), vocabulary.match_columns(names, vocabulary.CARRIER)
    if name is not None and carrier and name not in carrier:
        kind, solution = (pd.to_numeric(frame[n], errors="coerce") for n in (name, carrier[0]))
        return carrier[0] if bool((kind > 0).all() and (solution > 0).any()) else name
    return name


def _dilutions(frame: pd.DataFrame, found: dict[str, str | None], quality: Spec | None) -> tuple[Spec, str]:
    """Standard deviations of dilutions of precision: of a fix of that quality times the dilution."""
    columns = [str(c) for c in (found["hdop"], found["vdop"]) if c is not None]
    code = 1
    if quality is not None:
        seen = frame[quality["column"]].mode().iloc[0]
        code = quality.get("map", {}).get(str(int(seen)) if isinstance(seen, (int, float)) else str(seen), seen)
    std = DEFAULT_STD.get(int(code), DEFAULT_STD[1])[0]
    if len(columns) == 1:
        columns = columns * 2
    said = f"1σ of positions: {std:g} m times {' and '.join(dict.fromkeys(columns))}; reader.gnss.std_position.unit=…"
    return {"std_position": {"columns": columns, "unit": std}}, said


def _angle_unit(frame: pd.DataFrame, found: dict[str, str | None]) -> str:
    lat, lon = (np.abs(frame[found[k]].dropna().to_numpy()) for k in ("lat", "lon"))
    largest = float(max(lat.max(), lon.max()))
    if largest > 20_000:
        return "1e-7deg"
    if largest > 180.5:
        return "ddmm"
    named_deg = any(vocabulary.find_unit(str(found[k])) == "deg" for k in ("lat", "lon"))
    # a car covers more than 10 km within a drive only rarely, and no pole or meridian has it this near by chance
    small = largest <= np.pi + 1e-9 and lat.max() <= np.pi / 2
    return "rad" if small and not named_deg and _moves_like_radians(frame, found) else "deg"


def _moves_like_radians(frame: pd.DataFrame, found: dict[str, str | None]) -> bool:
    """Whether the way is one of a car in radians, and not in degrees (1 m is 1.6e-7 rad, 9e-6 deg)."""
    lat = frame[found["lat"]].to_numpy(float)
    spread = float(np.nanmax(lat) - np.nanmin(lat))
    if found["north"] is None and found["speed"] is None:
        return False
    name = found["north"] or found["speed"]
    way = float(np.nansum(np.abs(frame[name].to_numpy(float))))
    return spread > 0 and way > 0 and abs(np.log(spread * EARTH_M / way)) < abs(np.log(spread * DEGREE_M / way))
