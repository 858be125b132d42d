"""A drive in one line, to see whether an import is right."""

from __future__ import annotations

import numpy as np
import pandas as pd

from dlkf.data.discovery.motion import RESTING
from dlkf.data.limits import EARTH_M
from dlkf.data.masks import find_runs
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.schema import QUALITIES, driven_distance, way_with_imu
from dlkf.data.tables import Columns
from dlkf.data.validate import usable_fixes

AIDS = {"speed": "wheel speed", "heading": "heading", "baro": "barometer"}
MISSING = 0.02  # share of the IMU's samples, from which on it is worth a word
COVERED, LEFT_S = 0.8, 10.0  # of the longer of two logs by the shorter; less, and so many seconds, is worth a line
STANDS_S = 2.0  # less is a creeping car


def drive_line(drive: DriveFrames) -> str:
    """Duration, rates, distance, share of fixes by quality, largest gaps of a drive."""
    t = drive.imu["t"].to_numpy()
    step = np.diff(t)
    missing = 1 - len(step) * np.median(step) / (t[-1] - t[0])
    lost = f", {100 * missing:.2g} % of its samples missing" if missing > MISSING else ""
    detail = [_duration(t[-1] - t[0]), f"IMU {1 / np.median(step):.4g} Hz{lost}, largest gap {_short(step.max())}"]
    gnss = None if drive.gnss is None else way_with_imu(drive.gnss, drive.imu)
    if gnss is None or not len(gnss):
        return ", ".join((*detail, "no GNSS"))
    at, quality = gnss["t"].to_numpy(), gnss["quality"].to_numpy()
    shares = {int(q): float(np.mean(quality == q)) for q in np.unique(quality)}
    named = (f"{QUALITIES.get(q, f'quality {q}')} {100 * share:.3g} %" for q, share in shares.items())
    fixed = at[usable_fixes(gnss)]
    gaps = np.diff(fixed)
    rate = f"{1 / np.median(np.diff(at)):.3g} Hz" if len(at) > 1 else "a single row"
    detail.append(f"GNSS {rate}, {len(fixed)} fixes ({', '.join(named)})")
    if len(gaps):
        detail.append(f"largest gap {_short(gaps.max())}")
    if count_and_time := _standstills(gnss):
        detail.append("stands {} for {:.0f} s in all".format(*count_and_time))
    detail.insert(1, f"{_way(gnss) / 1000:.2f} km")
    detail += [_aid(name, table) for name, table in drive.aids.items()]
    if drive.reference is not None:
        detail.append(f"reference {100 * float(drive.reference['valid'].mean()):.3g} % valid")
    return ", ".join(detail)


def describe_cover(imu: Columns, fixes: Columns) -> str | None:
    """A line where one of IMU and fixes ends well before the other, or begins after it; None where they do not."""
    spans = {"the IMU": (imu["t"][0], imu["t"][-1]), "the fixes": (fixes["t"][0], fixes["t"][-1])}
    shared = min(last for _, last in spans.values()) - max(first for first, _ in spans.values())
    for one, other in (("the IMU", "the fixes"), ("the fixes", "the IMU")):
        whole = spans[other][1] - spans[other][0]
        if whole - shared > max(LEFT_S, (1 - COVERED) * whole):
            return f"{one} cover{'s' if one == 'the IMU' else ''} {shared:.0f} of {whole:.0f} s of {other}"
    return None


def _aid(name: str, table: pd.DataFrame) -> str:
    """The name and the rate of a further sensor."""
    step = np.diff(table["t"].to_numpy())
    rate = f" {1 / np.median(step):.3g} Hz" if len(step) else ""
    return f"{AIDS[name]}{rate}"


def _standstills(gnss: pd.DataFrame) -> tuple[str, float] | None:
    """How often and how long the fixes' speed rests for ``STANDS_S``; None where it never does, or is not known."""
    t, speed = gnss["t"].to_numpy(), np.hypot(gnss["vel_n"].to_numpy(), gnss["vel_e"].to_numpy())
    resting = speed < RESTING
    spans = [float(t[last - 1] - t[first]) for first, last in find_runs(resting)]
    long = [span for span in spans if span >= STANDS_S]
    return ("once" if len(long) == 1 else f"{len(long)} times", sum(long)) if long else None


def _way(gnss: pd.DataFrame) -> float:
    """Length of the way [m] from velocities, or between fixes at least 5 m apart."""
    speed = np.hypot(gnss["vel_n"].to_numpy(), gnss["vel_e"].to_numpy())
    if np.isfinite(speed).mean() > 0.5:
        return driven_distance(gnss)
    lat, lon = (np.radians(gnss[c].dropna().to_numpy()) for c in ("lat_deg", "lon_deg"))
    if not len(lat):
        return 0.0
    north, east = EARTH_M * (lat - lat[0]), EARTH_M * np.cos(lat[0]) * (lon - lon[0])
    way, last = 0.0, (north[0], east[0])
    for here in zip(north, east):
        if (moved := float(np.hypot(here[0] - last[0], here[1] - last[1]))) > 5.0:
            way, last = way + moved, here
    return way


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def _short(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 0.095 else f"{1000 * seconds:.3g} ms"
