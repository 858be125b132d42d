"""Findings about one recording: good, to be looked at, or bad for a filter."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from dlkf.base.errors import InputError
from dlkf.data.discovery.findings import Finding, discover, find_value
from dlkf.data.limits import horizontal_distance
from dlkf.data.schema import ACCEL, GYRO, QUALITIES
from dlkf.data.tables import Columns, DriveRow
from dlkf.data.validate import CheckedTables, read_drive, read_fixes, usable_fixes
from dlkf.navigation.earth import STANDARD_GRAVITY

GOOD, NOTE, BAD = "good", "note", "BAD"
STYLES = {GOOD: "green", NOTE: "yellow", BAD: "bold red"}
FASTEST_MOVE = 2.0  # m/s, from which on course is heading
STANDING = 0.15  # m/s
SUBJECTS = {  # of settings that are estimated
    "imu.axes": "pose of the sensor", "imu.time.offset_s": "offset of the clocks", "lever_arm_m": "lever arm",
    "gnss.time.drift_ppm": "drift of the clocks",
}  # fmt: skip
LARGE_STD = 100.0  # m, 1σ of positions: no receiver that is of use
OFFSET_S, DELAY_S, ANGLE_DEG = 0.05, 0.3, 3.0  # more is worth a word, is a wrong clock, is a turned sensor


class CheckupResult(NamedTuple):
    """One finding: good, note or BAD, and what was found, with the remedy where there is one."""

    grade: str
    text: str


def checkup(folder: str | Path, row: DriveRow) -> Iterator[CheckupResult]:
    """The findings about a drive; one that cannot be read is a single bad one.

    Clock offset, sensor pose and lever arm are estimated from the motion (:mod:`dlkf.data.discovery`).
    """
    try:
        tables = read_drive(folder, row, reference=True)
    except InputError as error:
        yield CheckupResult(BAD, str(error))
        return
    yield from imu_findings(tables.imu)
    yield from gnss_findings(tables.imu, tables.gnss)
    yield from motion_findings(tables.gnss)
    if tables.reference is None:
        text = "no reference: evaluate reference=smoothed scores against the drive's own smoothed solution"
        yield CheckupResult(NOTE, text)
    else:
        share = float(np.mean(tables.reference["valid"]))
        attitude = bool(np.isfinite(tables.reference["roll"]).any())
        text = f"reference: {share:.0%} of its rows valid, {'with' if attitude else 'without'} attitude"
        yield CheckupResult(GOOD if share > 0.5 and attitude else NOTE, text)
    yield from discover_findings(tables)


def imu_findings(imu: Columns) -> Iterator[CheckupResult]:
    """Rate, jitter, gaps, resolution, saturation, force at rest."""
    step = np.diff(imu["t"])
    usual = float(np.median(step))
    duration = float(imu["t"][-1] - imu["t"][0])
    jitter = float(np.std(step[step < 3 * usual]) / usual)
    rate = 1 / usual
    text = f"IMU: {duration:.0f} s at {rate:.4g} Hz, jitter {jitter:.1%}"
    slow = "" if rate >= 49 else "; 50 Hz or more is better"
    yield CheckupResult(GOOD if rate >= 49 and jitter < 0.05 else NOTE, text + slow)
    gaps = step[step > 1.5 * usual]
    if len(gaps):
        lost = float((gaps - usual).sum())
        text = f"IMU: {len(gaps)} gaps, the longest {gaps.max():.3g} s, {lost:.3g} s lost"
        yield CheckupResult(NOTE if gaps.max() < 0.25 else BAD, text)
    for names, unit in ((ACCEL, "m/s²"), (GYRO, "rad/s")):
        for name in names:
            x = imu[name]
            top = np.abs(x).max()
            if top > 0 and np.sum(np.abs(x) == top) > max(10, 0.001 * len(x)) and np.ptp(x) > 0:
                text = f"{name} stays at {top:.4g} {unit}: the sensor saturates; choose a larger range"
                yield CheckupResult(BAD, text)
            if np.ptp(x) == 0:
                yield CheckupResult(BAD, f"{name} never changes: {x[0]:.4g} {unit}")
    force = float(np.median(np.sqrt(sum(imu[n] ** 2 for n in ACCEL))))
    near = abs(force / STANDARD_GRAVITY - 1) < 0.03
    yield CheckupResult(GOOD if near else NOTE, f"IMU: median specific force {force:.4g} m/s² (gravity is 9.81)")


def gnss_findings(imu: Columns, gnss: Columns) -> Iterator[CheckupResult]:
    """Rate, gaps, shares of quality, velocities, 1σ, overlap with the IMU, jumps."""
    usable = usable_fixes(gnss)
    t = gnss["t"][usable]
    if len(t) < 2:
        yield CheckupResult(BAD, f"GNSS: {len(t)} usable fixes")
        return
    usual = float(np.median(np.diff(t)))
    fast = f"; epoch_s={usual:.3g} takes them all" if usual < 0.8 else ""
    yield CheckupResult(GOOD, f"GNSS: {len(t)} usable fixes, one every {usual:.3g} s{fast}")
    codes, counts = np.unique(gnss["quality"], return_counts=True)
    shares = ", ".join(f"{c / len(gnss['t']):.0%} {QUALITIES.get(q, f'quality {q}')}" for q, c in zip(codes, counts))
    best = float(np.mean(np.isin(gnss["quality"], (4, 5, 2, 9))))
    yield CheckupResult(GOOD if best > 0.5 else NOTE, f"GNSS: {shares}")
    gaps, most = np.diff(t), max(3 * usual, 2.0)
    if len(holes := gaps[gaps > most]):
        yield CheckupResult(NOTE, f"GNSS: gaps over {most:.3g} s: {len(holes)}, the longest {holes.max():.4g} s")
    overlap = (min(t[-1], imu["t"][-1]) - max(t[0], imu["t"][0])) / max(imu["t"][-1] - imu["t"][0], 1e-9)
    if overlap < 0.9:
        text = f"GNSS and IMU have only {max(overlap, 0):.0%} of the IMU's time in common"
        yield CheckupResult(NOTE if overlap > 0.5 else BAD, text)
    known = np.isfinite(gnss["vel_n"][usable]).mean()
    if known < 0.9:
        text = f"GNSS: {known:.0%} of the fixes have a velocity; alignment and outages are better with it"
        yield CheckupResult(NOTE, text)
    std = np.hypot(gnss["std_pos_n"], gnss["std_pos_e"])[usable]
    text = "GNSS: no 1σ in the file; the filter takes usual ones of the quality"
    if np.isfinite(std).any():
        text = f"GNSS: horizontal 1σ {np.nanmedian(std):.2g} m in the median, {np.nanmax(std):.2g} m at worst"
    large = np.isfinite(std).any() and np.nanmedian(std) > LARGE_STD
    if large:
        text += ": larger than those of usual receivers; is it in millimetres (reader.gnss.std_position.unit=mm)?"
    yield CheckupResult(GOOD if np.isfinite(std).any() and not large else NOTE, text)
    lat, lon = gnss["lat_deg"][usable], gnss["lon_deg"][usable]
    way = horizontal_distance(lat[:-1], lon[:-1], lat[1:], lon[1:])
    v = way / np.maximum(gaps, 1e-3)
    if (jumps := v > 100).any():
        k = int(np.argmax(v))
        text = f"GNSS: {jumps.sum()} jumps; at t = {t[k + 1]:.1f} s it moves {way[k]:.3g} m in {gaps[k]:.3g} s"
        yield CheckupResult(BAD, text)


def motion_findings(gnss: Columns) -> Iterator[CheckupResult]:
    """Speed and standstills: a filter needs motion to find its heading, and gains from rest."""
    usable = usable_fixes(gnss) & np.isfinite(gnss["vel_n"]) & np.isfinite(gnss["vel_e"])
    if not usable.any():
        return
    t, v = gnss["t"][usable], np.hypot(gnss["vel_n"], gnss["vel_e"])[usable]
    step = np.diff(t, append=t[-1])
    moving = float(step[v > FASTEST_MOVE].sum())
    rest = float(step[v < STANDING].sum())
    if moving < 10:
        yield CheckupResult(BAD, f"motion: {moving:.0f} s faster than {FASTEST_MOVE:g} m/s; a filter finds no heading")
    else:
        text = f"motion: {moving:.0f} s faster than {FASTEST_MOVE:g} m/s, up to {v.max() * 3.6:.0f} km/h"
        yield CheckupResult(GOOD, f"{text}; {rest:.0f} s at rest")


def discover_findings(tables: CheckedTables) -> Iterator[CheckupResult]:
    """Clock offset, pose of the sensor in the car, and lever arm estimated from the motion, against what is stored."""
    found = discover(tables.imu, read_fixes(tables.gnss), {*CLOCKS, "imu.axes"})
    autos = " ".join(f"reader.{name}=auto" for name in CLOCKS)
    late = float(find_value(found, "gnss.position.delay_s") or 0.0)
    for finding in found:
        if finding.setting == "gnss.position.delay_s" or (
            finding.setting == "gnss.time.drift_ppm" and not finding.value
        ):
            continue
        if not finding.sure:
            what = SUBJECTS.get(finding.setting, finding.setting)
            text = f"{what}: the motion does not determine it well enough ({finding.detail})"
            yield CheckupResult(NOTE, text)
        elif finding.setting == "gnss.time.drift_ppm":
            text = f"clocks: {finding.value:+.0f} {finding.detail}; {ESTIMATED}{autos}"
            yield CheckupResult(NOTE, text)
        elif finding.setting == "imu.time.offset_s":
            yield _grade_offset(finding, late, autos if all(x.sure for x in found if x.setting in CLOCKS) else "")
        elif finding.setting == "imu.axes":
            turn = Rotation.from_euler("ZYX", [finding.value[k] for k in ("yaw", "pitch", "roll")], degrees=True)
            angle = math.degrees(float(turn.magnitude()))
            fine = angle < ANGLE_DEG
            text = f"pose: the sensor is turned {angle:.1f}° against the car ({finding.detail})"
            remedy = "" if fine else "; ingest with reader.imu.accel.axes=auto reader.imu.gyro.axes=auto"
            yield CheckupResult(GOOD if fine else BAD, text + remedy)


def _grade_offset(finding: Finding, late: float, autos: str) -> CheckupResult:
    """The offset of the velocities, and that of positions which are ``late`` s older; ``autos`` would take both out."""
    off, apart = finding.value, abs(late) >= OFFSET_S
    if abs(off) < OFFSET_S and not apart:
        return CheckupResult(GOOD, f"clocks: IMU and GNSS agree ({finding.detail})")
    lead = f"add {off:+.3f} s to the IMU's stamps"
    if apart:
        age = "older" if late > 0 else "newer"
        lead += (
            f" for the velocities, {off + late:+.3f} s for the positions, which are {abs(late):.3f} s {age} than they"
        )
    remedy = ESTIMATED + (autos or f"reader.imu.time.offset_s={off:g}")
    if apart:
        both = autos or f"reader.gnss.position.delay_s={late:g}"
        remedy = f"one offset does not suit both: {ESTIMATED}{both}"
    grade = NOTE if abs(off) < DELAY_S else BAD  # receivers are late, clocks are wrong
    return CheckupResult(grade, f"clocks: {lead} ({finding.detail}); {remedy}")


CLOCKS = ("imu.time.offset_s", "gnss.time.drift_ppm", "gnss.position.delay_s")
ESTIMATED = "plus and filters with +receiver estimate this; for others ingest with "
