"""What the columns of a table are: by their names, else by their numbers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from dlkf.data.discovery.units import time_unit
from dlkf.data.readers.frames import Table
from dlkf.navigation.earth import STANDARD_GRAVITY as G

Spec = dict[str, Any]

SENSOR = {
    "accel": r"((total |linear )?acc(el(eration|erometer)?)?|specific ?force|force|f|a|fb)",
    "gyro": r"(gyro?(scope)?|omega|w|g|ang(ular)? ?(velocity|vel|rate)|rate|(rotation|turn) ?rate|wb)",
}
ONE = {
    "lat": r"(gps |gnss )?lat(itude)?( deg| rad)?",
    "lon": r"(gps |gnss )?(lon|lng|long)(gitude)?( deg| rad)?",
    "height": r"(gps |gnss )?(h|hgt|height|alt|altitude|ellip\w*|h ell|height ell\w*)( m)?",
    "north": r"(gps |gnss )?v(el)?(ocity)?( ?n| north)(orth)?( mps| m s)?",
    "east": r"(gps |gnss )?v(el)?(ocity)?( ?e| east)(ast)?( mps| m s)?",
    "down": r"(gps |gnss )?v(el)?(ocity)?( ?d| down)(own)?( mps| m s)?",
    "up": r"(gps |gnss )?v(el)?(ocity)?( ?u| up)(p)?( mps| m s)?",
    "speed": r"(gps |gnss |ground )?(speed|sog|g ?speed|velocity|spd)( mps| m s| kn\w*| kt| km ?h| kph| mph)?",
    "course": r"(gps |gnss )?(course|cog|bearing|track|heading|direction|head ?mot|course over ground)( deg)?",
    "quality": r"(gps |gnss )?(quality|fix ?quality|gga ?quality)",
    "geoid": r"(geoid|undulation|geoid ?sep\w*|sep|geoid ?height)( m)?",
}
QUALITY_TEXT = r"(gps |gnss )?(quality|fix|fix ?(type|quality|status|mode)|status|mode|sol(ution)?( ?type)?)"
QUALITY_WORDS = {
    0: ("", "none", "no fix", "nofix", "no solution", "invalid"),
    1: ("single", "spp", "sps", "autonomous", "standalone", "3d", "3d fix"),
    2: ("dgps", "dgnss", "sbas", "differential"),
    4: ("rtk", "rtk fix", "rtk fixed", "fixed", "rtk int", "int"),
    5: ("float", "rtk float"),
}
TIME = (
    r"#?(t|time|time ?stamp|tow|sow|gps ?(time|sow|tow)|unix ?(time)?|utc|stamp|epoch|secs?|seconds|date ?time"
    r"|ms|us|ns|milli(s|seconds)?|micro(s|seconds)?|nano(s|seconds)?|ticks|sample ?time"
    r"|ros ?time|itow|utc ?time|seconds ?elapsed)( s| sec| ms| us| ns| unix| utc| gps)*"
)


def imu_spec(table: Table) -> Spec | None:
    """The mapping of a table that holds an IMU; None if it does not."""
    frame = _numeric(table.frame)
    names = [str(c) for c in frame.columns]
    triads = {key: _triad(names, pattern) for key, pattern in SENSOR.items()}
    if triads["accel"] and triads["gyro"]:
        time = _time(table, frame[triads["accel"] + triads["gyro"]].notna().all(axis=1), slowest=0.21, fastest=2e-4)
        if time is None:
            return None
        return {"time": time, "accel": {"columns": triads["accel"]}, "gyro": {"columns": triads["gyro"]}}
    return _imu_by_numbers(frame) if all(n.isdigit() for n in names) else None


def gnss_spec(table: Table) -> Spec | None:
    """The mapping of a table that holds fixes; None if it does not."""
    frame = _numeric(table.frame)
    names = [str(c) for c in frame.columns]
    found = {key: _named(names, pattern) for key, pattern in ONE.items()}
    if found["lat"] is None or found["lon"] is None:
        return _gnss_by_numbers(frame) if all(n.isdigit() for n in names) else None
    time = _time(table, frame[[found["lat"], found["lon"]]].notna().all(axis=1), slowest=12.0, fastest=0.02)
    if time is None or found["height"] is None:
        return None
    position: Spec = {"columns": [found["lat"], found["lon"], found["height"]], "unit": _angle_unit(frame, found)}
    if found["geoid"] is not None:
        position["geoid"] = found["geoid"]
    out: Spec = {"time": time, "position": position, "velocity": _velocity(found) or {"columns": None}}
    for key, stem in (("std_position", "pos"), ("std_velocity", "vel")):
        stds = [_named(names, rf"(std|sd|sigma) ?{stem} ?{axis}( m| mps)?") for axis in "ned"]
        if all(stds):
            out[key] = {"columns": stds}
    if found["quality"] is not None and _is_codes(frame[found["quality"]]):
        out["quality"] = {"column": found["quality"]}
    elif quality := _quality_in_words(table.frame):
        out["quality"] = quality
    return out


def velocity_spec(table: Table) -> tuple[Spec, Spec] | None:
    """Time and velocities of a table that has these and no positions; None if it does not."""
    names = [str(c) for c in _numeric(table.frame).columns]
    velocity = _velocity({key: _named(names, pattern) for key, pattern in ONE.items()})
    every = pd.Series(True, table.frame.index)
    time = None if velocity is None else _time(table, every, slowest=12.0, fastest=0.02)
    return None if velocity is None or time is None else (time, velocity)


def _velocity(found: dict[str, str | None]) -> Spec | None:
    north, east, third = found["north"], found["east"], found["down"] or found["up"]
    if north and east:
        if third is None or found["down"]:
            return {"columns": [north, east, *([third] if third else [])], "frame": "ned"}
        return {"columns": [east, north, third], "frame": "enu"}
    both = [found["speed"], found["course"]]
    return {"columns": both, "frame": "course"} if all(both) else None


def _words(name: str) -> str:
    """``Accel X [m/s^2]`` → ``accel x``; ``accX`` → ``acc x``; ``vel_n_mps`` → ``vel n mps``."""
    bare = re.sub(r"[\[(].*?[\])]", " ", name)
    bare = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", bare)
    return re.sub(r"[^a-z0-9#]+", " ", bare.lower()).strip()


def _named(names: Sequence[str], pattern: str) -> str | None:
    """The only column whose name fits; the first of several."""
    return next((n for n in names if re.fullmatch(pattern, _words(n))), None)


def _triad(names: Sequence[str], stem: str) -> list[str] | None:
    for axes in ("xyz", "012"):
        unit = r"( mps2| m s2| g| mg| rps| rad s| rad| dps| deg s| deg)?"
        found = [_named(names, rf"(imu )?{stem} ?{a}{unit}") for a in axes]
        if all(found):
            return [str(f) for f in found]
    return None


def _numeric(frame: pd.DataFrame) -> pd.DataFrame:
    keep = {}
    for name in frame.columns:
        values = frame[name]
        filled = values.notna()
        if not pd.api.types.is_numeric_dtype(values):
            filled &= values.astype(str).str.strip() != ""
            values = pd.to_numeric(values, errors="coerce")
        if values.notna().sum() > 0.5 * filled.sum():  # of what stands there: rows of another kind leave it empty
            keep[name] = values
    return pd.DataFrame(keep)


def _time(table: Table, rows: pd.Series, slowest: float, fastest: float) -> Spec | None:
    frame = table.frame[rows]
    names = [str(c) for c in frame.columns]
    column = _named(names, TIME) or _only_rising(frame)
    week = _named(names, r"(gps )?(week|wn|week ?(number|no))")
    if column is None or frame.empty:
        return None
    values = frame[column]
    if not pd.api.types.is_numeric_dtype(values):
        texts = values.astype(str)
        if not bool(texts.str.match(r"^\s*\d{4}[-/]\d{1,2}[-/]\d{1,2}[T ]").iloc[:20].all()):
            return None
        return {"column": column, "unit": "iso", "clock": "utc"}
    unit = time_unit(values.to_numpy(), slowest, fastest)
    if unit is None:
        return None
    ticks = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    spec: Spec = {"column": column, "unit": unit}
    if week is not None:
        spec["week"] = week
    elif float(np.nanmedian(values)) / ticks > 1.2e9:
        spec["clock"] = "unix"
    return spec


def _only_rising(frame: pd.DataFrame) -> str | None:
    """The column that rises all the way, whatever its name, where there is one and it does not merely count rows."""
    numbers = _numeric(frame)
    steps = {str(name): np.diff(numbers[name].to_numpy(float)) for name in numbers.columns}
    rising = [name for name, step in steps.items() if len(step) > 1 and np.all(step >= 0) and np.median(step) > 0]
    clocks = [name for name in rising if not np.all(steps[name] == 1)]
    return clocks[0] if len(clocks) == 1 else None


def _angle_unit(frame: pd.DataFrame, found: dict[str, str | None]) -> str:
    lat, lon = (np.abs(frame[found[k]].dropna().to_numpy()) for k in ("lat", "lon"))
    largest = float(max(lat.max(), lon.max()))
    if largest > 20_000:
        return "1e-7deg"
    if largest > 180.5:
        return "ddmm"
    named_deg = any("deg" in _words(str(found[k])) for k in ("lat", "lon"))
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
    return spread > 0 and way > 0 and abs(np.log(spread * 6.37e6 / way)) < abs(np.log(spread * 1.11e5 / way))


def _is_codes(values: pd.Series) -> bool:
    known = values.dropna()
    return bool((known == known.round()).all() and known.between(0, 9).all())


def _quality_in_words(frame: pd.DataFrame) -> Spec | None:
    """GGA codes of the words of a column; None where there is none, one of them is not known, or they are numbers."""
    column = _named([str(c) for c in frame.columns], QUALITY_TEXT)
    if column is None:
        return None
    words = [str(word) for word in frame[column].dropna().unique()]
    codes = {w: code for w in words for code, known in QUALITY_WORDS.items() if _words(w) in known}
    return {"column": column, "map": codes} if len(codes) == len(words) and any(_words(w) for w in words) else None


def _imu_by_numbers(frame: pd.DataFrame) -> Spec | None:
    """No header: stamps rise, three neighbours have gravity's size, three beside them are rates."""
    values = frame.to_numpy(float)
    rising = [k for k in range(values.shape[1]) if np.all(np.diff(values[:, k]) > 0)]
    if not rising or values.shape[1] < 7:
        return None
    column = rising[0]
    unit = time_unit(values[:, column], 0.21, 2e-4)
    if unit is None:
        return None
    step = float(np.median(np.diff(values[:, column]))) / {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    starts = [k for k in range(values.shape[1] - 2) if not {column} & {k, k + 1, k + 2}]

    def apart(k: int) -> tuple[float, bool]:
        size = np.linalg.norm(values[:, k : k + 3], axis=1)
        middle = float(np.median(size))
        spread = float(np.median(np.abs(size - middle))) / max(middle, 1e-12)
        whole = min(abs(np.log(max(middle, 1e-12) / g)) for g in (G, 1.0, 1000.0, 100 * G))
        gained = min(abs(np.log(max(middle / step, 1e-12) / g)) for g in (G, 1.0))
        return (spread if min(whole, gained) < 0.08 else np.inf), gained < whole

    accel = min(starts, key=lambda k: apart(k)[0])
    if not np.isfinite(apart(accel)[0]) or apart(accel)[0] > 0.2:
        return None
    beside = [k for k in (accel - 3, accel + 3) if k in starts and np.ptp(values[:, k : k + 3]) > 0]
    if not beside:
        return None
    triads = {"accel": accel, "gyro": beside[0]}
    out: Spec = {key: {"columns": [str(frame.columns[k + j]) for j in range(3)]} for key, k in triads.items()}
    return {"time": {"column": str(frame.columns[column]), "unit": unit}, "increments": bool(apart(accel)[1]), **out}


def _gnss_by_numbers(frame: pd.DataFrame) -> Spec | None:
    """No header: stamps, then latitude, longitude and height as neighbours."""
    values = frame.to_numpy(float)
    rising = [k for k in range(values.shape[1]) if np.all(np.diff(values[:, k]) > 0)]
    if not rising or values.shape[1] < 4:
        return None
    column = rising[0]
    unit = time_unit(values[:, column], 12.0, 0.02)
    k = column + 1
    if unit is None or k + 2 >= values.shape[1]:
        return None
    lat, lon, height = values[:, k], values[:, k + 1], values[:, k + 2]
    near = np.nanmax(np.abs(lat)) <= 90 and np.nanmax(np.abs(lon)) <= 180 and np.nanmax(np.abs(height)) < 9000
    still = max(np.nanmax(np.abs(np.diff(lat))), np.nanmax(np.abs(np.diff(lon)))) < 0.01
    if not (near and still and np.ptp(lat) > 0):
        return None
    names = [str(frame.columns[k + j]) for j in range(3)]
    time = {"column": str(frame.columns[column]), "unit": unit}
    return {"time": time, "position": {"columns": names, "unit": "deg"}, "velocity": {"columns": None}}
