"""What the columns of a table without usable names are: gravity, what rises, what looks like degrees, what moves so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.angles import wrap_angle
from dlkf.data.discovery.units import time_unit
from dlkf.data.limits import EARTH_M
from dlkf.data.readers import stamps, vocabulary
from dlkf.data.readers.frames import LogTable
from dlkf.navigation.earth import STANDARD_GRAVITY as G

Spec = dict[str, Any]
FARTHEST_STEP_DEG = 0.01  # of a car between two fixes
FARTHEST_WAY_DEG = 5.0  # of a drive
SPEED_AGREES = 0.97  # correlation of a column with the speed between positions
COURSE_AGREES_DEG = 8.0
SLOWEST_COURSE = 3.0  # m/s: below, positions give no course
FASTEST_S = 0.04  # between fixes; what comes faster is an IMU's
SMALL_M = 100.0  # standard deviations are smaller


def imu_spec(frame: pd.DataFrame) -> Spec | None:
    """Stamps rise, three neighbours have gravity's size, three beside them are rates."""
    values = frame.to_numpy(float)
    time = stamps.find_pair(frame, 0.21, 2e-4) or _rising(frame)
    if time is None or values.shape[1] < 7:
        return None
    t = stamps.read_seconds(LogTable(frame, Path()), time)
    if t is None:
        return None
    step = float(np.median(np.diff(t)))
    last = time["column"][-1] if isinstance(time["column"], list) else time["column"]
    column = [str(name) for name in frame.columns].index(last)
    starts = [k for k in range(values.shape[1] - 2) if not {column} & {k, k + 1, k + 2}]
    ends = "".join(vocabulary.words(str(name))[-1:] or "-" for name in frame.columns)
    starts = [k for k in starts if ends[k : k + 3] == "xyz"] or starts

    def apart(k: int) -> tuple[float, bool]:
        size = np.linalg.norm(values[:, k : k + 3], axis=1)
        middle = float(np.median(size))
        spread = float(np.median(np.abs(size - middle))) / max(middle, 1e-12)
        whole = min(abs(np.log(max(middle, 1e-12) / g)) for g in (G, 1.0, 1000.0, 100 * G))
        gained = min(abs(np.log(max(middle / step, 1e-12) / g)) for g in (G, 1.0))
        return (spread if min(whole, gained) < 0.08 else np.inf), gained < whole

    # a level drive's (ay, az, gx) has gravity's size too, and is steadier: triads follow each other from the stamps on
    accel = min(starts, key=lambda k: (not apart(k)[0] < 0.2, (k - column - 1) % 3 != 0, apart(k)[0]))
    if not np.isfinite(apart(accel)[0]) or apart(accel)[0] > 0.2:
        return None
    beside = [k for k in (accel - 3, accel + 3) if k in starts and np.ptp(values[:, k : k + 3]) > 0]
    if not beside:
        return None
    triads = {"accel": accel, "gyro": beside[0]}
    out: Spec = {key: {"columns": [str(frame.columns[k + j]) for j in range(3)]} for key, k in triads.items()}
    return {"time": time, "increments": bool(apart(accel)[1]), **out}


def _rising(frame: pd.DataFrame) -> Spec | None:
    """Stamps in a column that rises with every row by an IMU's steps; one that counts rows is the last choice."""
    values = {str(name): frame[name].to_numpy(float) for name in frame.columns}
    rising = {name: x for name, x in values.items() if np.all(np.diff(x) > 0)}
    fits = {name: unit for name, x in rising.items() if (unit := time_unit(x, 0.21, 2e-4)) is not None}
    clocks = [name for name in fits if not np.all(np.diff(values[name]) == 1) or len(fits) == 1]
    return {"column": clocks[0], "unit": fits[clocks[0]]} if clocks else None


def gnss_spec(table: LogTable) -> Spec | None:
    """Stamps, then latitude, longitude and height as neighbours; then velocities that agree with the way between."""
    frame = table.frame.select_dtypes("number")
    time = stamps.time_spec(table, pd.Series(True, table.frame.index), 12.0, FASTEST_S) or _first_rising(frame)
    if time is None or len(frame) < 5:
        return None
    taken = time["column"] if isinstance(time["column"], list) else [time["column"]]
    names = [str(c) for c in frame.columns if str(c) not in taken]
    values = frame[names].to_numpy(float)
    t = stamps.read_seconds(table, time)
    fits = []  # degrees, or u-blox' 1e-7 of them; latitude first, or longitude
    for scale, unit in ((1.0, "deg"), (1e-7, "1e-7deg")):
        for place in range(len(names) - 2):
            three = values[:, place : place + 3] * (scale, scale, 1e-3 if scale < 1 else 1.0)
            for lat, lon in ((0, 1), (1, 0)):
                if _are_places(three[:, [lat, lon, 2]]):
                    rest = frame[names[:place] + names[place + 3 :]]
                    fits.append((place, lat, lon, unit, velocities(t, three[:, lat], three[:, lon], rest)))
        if fits:
            break
    if not fits:
        return None
    place, lat, lon, unit, found = next((fit for fit in fits if fit[-1]["columns"]), fits[0])
    columns = [names[place + lat], names[place + lon], names[place + 2]]
    spec: Spec = {"time": time, "position": {"columns": columns, "unit": unit}, "velocity": found}
    if unit != "deg":
        spec["position"]["height_unit"] = "mm"
    after = names[place + 3 : place + 6]
    if len(after) == 3 and not set(found["columns"] or ()) & set(after):
        stds = values[:, place + 3 : place + 6]
        if np.nanmin(stds) > 0 and np.nanmax(stds) < SMALL_M and np.all(np.abs(np.diff(stds, axis=0)) < SMALL_M / 10):
            spec["std_position"] = {"columns": after}  # as KF-GINS and others write them
    return spec


def _first_rising(frame: pd.DataFrame) -> Spec | None:
    """Stamps in the first column that rises with every row: a car may go North all the way too."""
    for name in frame.columns:
        values = frame[name].to_numpy(float)
        if np.all(np.diff(values) > 0) and (unit := time_unit(values, 12.0, FASTEST_S)) is not None:
            return {"column": str(name), "unit": unit}
    return None


def _are_places(three: np.ndarray) -> bool:
    """Whether three columns are latitude, longitude and height of a car on its way."""
    lat, lon, height = three.T
    if not np.isfinite(three).mean() > 0.5:
        return False
    near = np.nanmax(np.abs(lat)) <= 90 and np.nanmax(np.abs(lon)) <= 180 and np.nanmax(np.abs(height)) < 9000
    steps = [np.abs(np.diff(x)) for x in (lat, lon)]
    still = max(np.nanmax(s) for s in steps) < FARTHEST_STEP_DEG and max(np.nanmax(s) for s in steps) > 0
    within = max(np.nanmax(x) - np.nanmin(x) for x in (lat, lon)) < FARTHEST_WAY_DEG
    whole = all(np.array_equal(x[np.isfinite(x)], np.round(x[np.isfinite(x)])) for x in (lat, lon))
    somewhere = abs(np.nanmedian(lat)) > 0.01 or abs(np.nanmedian(lon)) > 0.01
    return bool(near and still and within and not whole and somewhere and (np.abs(lat) > 1).any())


def velocities(t: np.ndarray | None, lat: np.ndarray, lon: np.ndarray, others: pd.DataFrame) -> Spec:
    """Columns among the ``others`` that agree with the way between positions [deg] at times ``t`` [s]: North and East,
    or speed and course [deg]; none without times."""
    names, values = [str(c) for c in others.columns], others.to_numpy(float)
    if t is None or len(t) < 3 or not names:
        return {"columns": None}
    rest = range(len(names))
    span = t[2:] - t[:-2]
    north = EARTH_M * np.radians(lat[2:] - lat[:-2]) / span
    east = EARTH_M * np.cos(np.radians(lat[1:-1])) * np.radians(lon[2:] - lon[:-2]) / span
    speed, course = np.hypot(north, east), np.degrees(np.arctan2(east, north))
    moving = np.isfinite(speed) & (speed > SLOWEST_COURSE)

    def correlate(k: int, with_what: np.ndarray) -> float:
        good = np.isfinite(values[1:-1, k]) & np.isfinite(with_what)
        if good.sum() < 10 or np.ptp(values[1:-1, k][good]) == 0 or np.ptp(with_what[good]) == 0:
            return 0.0
        return float(np.corrcoef(values[1:-1, k][good], with_what[good])[0, 1])

    by = {name: max(rest, key=lambda k: correlate(k, what), default=None) for name, what in
          (("north", north), ("east", east), ("speed", speed))}  # fmt: skip
    k, j = by["north"], by["east"]
    if k is not None and j not in (None, k) and min(correlate(k, north), correlate(j, east)) > SPEED_AGREES:
        return {"columns": [names[k], names[j]], "frame": "ned"}

    def course_error(k: int) -> float:
        apart = wrap_angle(values[1:-1, k] - course, 180)
        apart = np.abs(apart[moving & np.isfinite(apart)])
        return float(np.median(apart)) if len(apart) > 10 else np.inf

    heading = min((k for k in rest if k != by["speed"]), key=course_error, default=None)
    k = by["speed"]
    if k is None or heading is None or correlate(k, speed) < SPEED_AGREES or course_error(heading) > COURSE_AGREES_DEG:
        return {"columns": None}
    return {"columns": [names[k], names[heading]], "frame": "course"}
