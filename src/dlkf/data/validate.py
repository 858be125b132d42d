"""Checks of a dataset: one clear line for the first thing that is wrong, with drive, file, row and remedy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.data.aid_checks import check_aid
from dlkf.data.aid_tables import STANDARD, AidTable
from dlkf.data.bursts import MANY, share_at_once
from dlkf.data.dead_sensors import check_frozen, check_repeated_fixes
from dlkf.data.discovery.motion import find_motion
from dlkf.data.limits import FULL_SCALE, NONE_REFUSED, Refused, screen_fixes, within_full_scale
from dlkf.data.plausibility import check_clocks, check_gnss_units, check_imu_units, check_way
from dlkf.data.readers.units import DAY_S, GPS_EPOCH_UNIX, WEEK_S
from dlkf.data.reference_checks import check_attitude, check_same_clock, check_same_place
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, POSITION, STD, VELOCITY, stack_columns
from dlkf.data.tables import Columns, DriveRow, read_drives, read_table, refuse_rows
from dlkf.data.turn_checks import check_turns

STAMPS = "give the sensor's own stamps, or spread the samples evenly (reader.imu.time.respace=true)"
GNSS_QUALITIES = (1, 2, 3, 4, 5, 9)  # NMEA GGA codes that are a satellite fix; 6, 7, 8 are not
RATES_HZ = {"imu": (1.0, 1e4), "gnss": (1e-3, 500.0)}
UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9}  # of time, in a second
MOST_SAME = 0.2  # of the rows, with the stamp of the row before: more are a rounded clock
MOST_REFUSED = (0.01, 0.2)  # of the samples, of the fixes; more are no accident
MOST_SWITCH_M = 10_000.0  # m: fixes that go on so far off make two drives of one
MOST_HOURS = 14  # between time zones
LEAST_SPAN_S, LEAST_SHARED = 10.0, (1.0, 0.02)  # of fixes; by them and the IMU: seconds, share of the shorter
NEAR_WRAP_S = 60.0
COUNTERS_S = (2**16 / 1e3, 2**32 / 1e6, 2**32 / 1e3)  # of ms in 16 bits; of us, of ms in 32
LEAST_WRAP, MOST_WRAPS = 5.0, 0.9  # usual steps in a counter's turn; share of its jumps back that are of one size
SET_BACK_S, MOST_SET_BACK = 5.0, 10  # stamps that go back by more, but not often, are of a clock that was set back


@dataclass(frozen=True)
class Limits:
    """What is still accepted: an IMU gap is one longer than both ``gap_s`` and ``gap_samples`` intervals."""

    gap_s: float = 0.25
    gap_samples: float = 5.0


LIMITS = Limits()


@dataclass(frozen=True)
class CheckedTables:
    """The checked tables of one drive."""

    row: DriveRow
    imu: Columns
    gnss: Columns
    reference: Columns | None
    aids: Mapping[str, Columns] = field(default_factory=dict)  # of further sensors, by name
    refused: Refused = NONE_REFUSED  # samples and fixes that were left out because they are beyond physical limits


def validate_dataset(folder: str | Path, *, reference: bool = True) -> list[DriveRow]:
    """Check every drive of a dataset and return their rows; raises InputError for the first fault.

    With ``reference=False`` the folder ``reference/`` is not opened.
    """
    rows = read_drives(folder)
    for row in rows:
        read_drive(folder, row, reference=reference)
    return rows


def read_drive(
    folder: str | Path,
    row: DriveRow,
    *,
    reference: bool = True,
    aids: Collection[AidTable] | None = None,
    limits: Limits = LIMITS,
) -> CheckedTables:
    """Read and check the tables of one drive; raises InputError for the first fault.

    ``aids`` are those of further sensors that count, None: all of the contract that the drive has. Others are not
    opened.
    """
    name = row.name
    imu = read_table(folder, "imu", name)
    gnss = read_table(folder, "gnss", name)
    assert imu is not None and gnss is not None  # read_table raises for these two
    truth = read_table(folder, "reference", name) if reference else None
    wanted = STANDARD.values() if aids is None else aids
    others = {aid.name: read_table(folder, aid.name, name, aid.column) for aid in wanted}
    found = {kind: table for kind, table in others.items() if table is not None}
    return check_tables(CheckedTables(row, imu, gnss, truth, found), limits)


def check_tables(tables: CheckedTables, limits: Limits = LIMITS) -> CheckedTables:
    """The same tables without what is beyond physical limits; raises InputError for their first fault."""
    name, imu, gnss, truth = tables.row.name, tables.imu, tables.gnss, tables.reference
    imu = _check_imu(imu, _where(name, "imu"), limits)
    gnss = _check_gnss(gnss, imu, _where(name, "gnss"))
    refused = Refused(len(tables.imu["t"]) - len(imu["t"]), len(tables.gnss["t"]) - len(gnss["t"]))
    if any(refused):
        tables = replace(tables, imu=imu, gnss=gnss, refused=refused)
    fixes = read_fixes(gnss)
    check_frozen(imu, fixes, _where(name, "imu"))
    check_repeated_fixes(fixes, _where(name, "gnss"))
    check_turns(imu, fixes, _where(name, "imu"))
    check_way(fixes, _where(name, "gnss"), unexplained=True)
    check_clocks(imu, fixes, _where(name, "imu"))
    if truth is not None:
        _check_reference(truth, imu, fixes, _where(name, "reference"))
    moved = find_motion(fixes)
    for kind, table in tables.aids.items():
        check_time(table["t"], _where(name, kind), kind)
        check_aid(kind, table, imu, moved, _where(name, kind))
    return tables


def read_imu(folder: str | Path, drive: str, limits: Limits = LIMITS) -> Columns:
    """Read and check the IMU of a drive alone, with GNSS or without; raises InputError for the first fault."""
    imu = read_table(folder, "imu", drive)
    assert imu is not None  # read_table raises for this one
    return _check_imu(imu, _where(drive, "imu"), limits)


def read_fixes(gnss: Columns) -> Columns:
    """The usable rows."""
    usable = usable_fixes(gnss)
    return {column: values[usable] for column, values in gnss.items()}


def usable_fixes(gnss: Columns | pd.DataFrame) -> np.ndarray:
    """Rows whose quality is that of a satellite fix and whose position is finite."""
    return np.isin(gnss["quality"], GNSS_QUALITIES) & np.isfinite([gnss[c] for c in POSITION]).all(0)


def find_gaps(t: np.ndarray, limits: Limits) -> np.ndarray:
    """Rows before which the IMU has a gap."""
    if len(t) < 2:
        return np.zeros(0, dtype=np.int64)
    step = np.diff(t)
    if step.max() <= limits.gap_s:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(step > max(limits.gap_s, limits.gap_samples * float(np.median(step)))) + 1


def _where(drive: str, kind: str) -> str:
    return f"drive {drive}, {kind}/drive={drive}"


def _describe_rounding(t: np.ndarray) -> str:
    """How stamps of which many are the same were rounded, and the remedy."""
    if (t == np.floor(t)).all():
        return "t has whole seconds; give its decimals"
    if (t == t.astype(np.float32)).all():
        return f"t has the {np.spacing(np.float32(np.abs(t).max())):g} s of float32; keep it in float64"
    return "t is rounded; give more decimals"


def check_time(t: np.ndarray, where: str, kind: str = "imu", name_row: Callable[[int], str] = "row {}".format) -> None:
    """InputError for stamps that do not rise from row to row; ``name_row`` calls a row as a user finds it."""
    refuse_rows({"t": t}, ("t",), lambda x: ~np.isfinite(x), where, "remove the row or give its time in seconds")
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        k = int(back[0])
        if (same := int((np.diff(t) == 0).sum())) > MOST_SAME * len(t):
            rounding = _describe_rounding(t)
            remedy = (
                rounding
                if kind == "imu"
                else f"remove duplicate rows (reader.{kind}.rows=once); if there are none, {rounding}"
            )
            raise InputError(
                f"{where}: {same} of {len(t)} rows have the stamp of the row before: {remedy} "
                f"(reader.{kind}.time.respace=true spreads such rows evenly)"
            )
        if t[k + 1] == t[k]:
            coarse = " (of an IMU with a coarse clock: reader.imu.time.respace=true)" if kind == "imu" else ""
            rows = {"imu": "samples", "gnss": "fixes"}.get(kind, "rows")
            raise InputError(
                f"{where}: {name_row(k + 1)}: t = {t[k]:.6f} appears twice; remove duplicate {rows}{coarse}"
            )
        raise InputError(
            f"{where}: {name_row(k + 1)}: t goes back from {t[k]:.6f} to {t[k + 1]:.6f}; {_explain_return(t, k, kind)}"
        )


def _explain_return(t: np.ndarray, k: int, kind: str) -> str:
    """What stamps that go back after row ``k`` may be: of the next day, of a clock that was set back, out of order."""
    back = t[k] - t[k + 1]
    if (wraps_s := _find_wrap(t)) is not None:
        return f"they start again every {wraps_s:.6g} s: reader.{kind}.time.wraps_s={wraps_s:.10g}"
    for wraps_s, name in ((DAY_S, "at midnight"), (WEEK_S, "at the end of a week")):
        if abs(back - wraps_s) < NEAR_WRAP_S:
            return f"they start again {name}: add {wraps_s} s from there on (reader.{kind}.time.wraps_s={wraps_s})"
    if back > SET_BACK_S and int((np.diff(t) < 0).sum()) <= MOST_SET_BACK:
        return "the clock was set back there: make two drives of it; sorting would mix them"
    return "sort the rows"


def _find_wrap(t: np.ndarray) -> float | None:
    """The seconds after which a counter starts again: jumps back of that of a counter, or most of one size in which all
    stamps lie; None where they are not."""
    step = np.diff(t)
    usual = float(np.median(step))
    wraps = usual - step[step < 0]
    near = [size for size in COUNTERS_S if (np.abs(wraps - size) <= 2 * usual).all()]
    if near:
        return near[0]
    wrap = float(np.median(wraps))
    if len(wraps) < 2 or wrap < LEAST_WRAP * usual or np.ptp(t) > wrap + 2 * usual:
        return None
    if np.mean(np.abs(wraps - wrap) <= 2 * usual) < MOST_WRAPS:
        return None
    return round(wrap) if abs(wrap - round(wrap)) <= 0.2 * usual and round(wrap) else wrap


def _check_rate(t: np.ndarray, where: str, kind: str) -> None:
    """Stamps in another unit make a rate that no device has."""
    slowest, fastest = RATES_HZ[kind]
    rate = 1 / float(np.median(np.diff(t))) if len(t) > 1 else fastest
    if not slowest <= rate <= fastest:
        unit = _find_unit(1 / rate, 1 / fastest, 1 / slowest)
        raise InputError(
            f"{where}: {rate:.3g} rows a second, {'an IMU' if kind == 'imu' else 'a receiver'} has {slowest:g} to "
            f"{fastest:g}: {_say_unit(unit, kind) if unit else f't is not in seconds; reader.{kind}.time.unit'}"
        )


def _find_unit(length: float, shortest: float, longest: float) -> str:
    """The unit smaller than seconds of which ``length`` are from ``shortest`` to ``longest`` seconds, if any."""
    return next((unit for unit, count in UNITS.items() if shortest <= length / count <= longest), "")


def _say_unit(unit: str, kind: str) -> str:
    return f"t looks like {unit}, must be seconds; divide it by {UNITS[unit]:g} (reader.{kind}.time.unit={unit})"


def _check_imu(imu: Columns, where: str, limits: Limits) -> Columns:
    """The samples within full scale, where the others are few."""
    t = imu["t"]
    check_time(t, where)
    if (share := share_at_once(t)) > MANY:
        raise InputError(
            f"{where}: {100 * share:.0f} % of the samples came with the one before, as in packets that a host stamps; "
            f"{STAMPS}"
        )
    remedy = "remove the row or split the drive there"
    refuse_rows(imu, (*GYRO, *ACCEL), lambda x: ~np.isfinite(x), where, remedy)
    if len(t) < 2:
        raise InputError(f"{where}: has a single sample; leave the drive out or give its data")
    _check_rate(t, where, "imu")
    check_imu_units(imu, where)
    keep = _check_scale(imu)
    beyond = np.flatnonzero(~keep)
    if len(beyond) > max(MOST_REFUSED[0] * len(t), 2):
        raise InputError(
            f"{where}: {len(beyond)} of {len(t)} samples, the first in row {beyond[0]}, are beyond "
            f"{FULL_SCALE[0]:g} m/s², {FULL_SCALE[1]:g} rad/s: damaged, or in another unit; remove them"
        )
    gaps = find_gaps(t[keep], limits)
    if len(gaps):
        k = int(np.flatnonzero(keep)[gaps[0]])
        before = t[keep][gaps[0] - 1]
        left_out = "" if not len(beyond) else f" ({len(beyond)} samples beyond full scale are left out)"
        remedy = "split the drive there (dlkf.ingest split_gaps=true)"
        if _come_at_once(t, k, t[k] - before):
            remedy = f"its samples come at once after it, as a host stamps them that was busy; {STAMPS}"
        raise InputError(
            f"{where}: row {k}: IMU gap of {t[k] - before:.3f} s after t = {before:.3f}{left_out}; {remedy}"
        )
    return imu if not len(beyond) else {column: values[keep] for column, values in imu.items()}


def _come_at_once(t: np.ndarray, k: int, gap_s: float) -> bool:
    """Whether nine of ten samples that a gap before row ``k`` lacks come in the tenth of its length after it."""
    missing = 0.9 * gap_s / float(np.median(np.diff(t)))
    return int(np.searchsorted(t, t[k] + 0.1 * gap_s)) - k >= missing


def _check_scale(imu: Columns) -> np.ndarray:
    """Samples within full scale; usually all are, which their extremes show."""
    if all(np.abs((imu[c].min(), imu[c].max())).max() <= most for s, most in zip((ACCEL, GYRO), FULL_SCALE) for c in s):
        return np.ones(len(imu["t"]), bool)
    return within_full_scale(stack_columns(imu, ACCEL), stack_columns(imu, GYRO))


def _check_gnss(gnss: Columns, imu: Columns, where: str) -> Columns:
    """All rows but the fixes that no car can have reached, where those are few."""
    check_time(gnss["t"], where, "gnss")
    _check_rate(gnss["t"], where, "gnss")
    refuse_rows(gnss, (*POSITION, *VELOCITY, *STD), np.isinf, where, "write NaN where it is unknown")
    fix = usable_fixes(gnss)
    if not fix.any():
        _check_fixes_there(gnss, where)
        raise InputError(f"{where}: no GNSS fix at all (position NaN or quality 0 in every row); leave the drive out")
    refuse_rows(gnss, STD, lambda x: x < 0, where, "must be ≥ 0, or NaN if unknown")
    t, first, last = gnss["t"][fix], imu["t"][0], imu["t"][-1]
    if not ((t > first) & (t <= last + 1)).any():
        span = f"fixes from t = {t[0]:.3f} to {t[-1]:.3f}" if len(t) > 1 else f"the only fix, at t = {t[0]:.3f},"
        raise InputError(
            f"{where}: {span} lie{'' if len(t) > 1 else 's'} outside the IMU's {first:.3f} to {last:.3f}; "
            + _explain_outside(t, first, last)
        )
    span, shared = t[-1] - t[0], min(t[-1], last) - max(t[0], first)
    if span > LEAST_SPAN_S and shared < max(LEAST_SHARED[0], LEAST_SHARED[1] * min(span, last - first)):
        raise InputError(
            f"{where}: fixes from t = {t[0]:.3f} to {t[-1]:.3f} share {max(shared, 0.0):.1f} s with the IMU, from "
            f"{first:.3f} to {last:.3f}; give logs of the same drive, on one clock"
        )
    fixes = {name: values[fix] for name, values in gnss.items()}
    check_gnss_units(fixes, where)
    screened = screen_fixes(fixes)
    count = int((~screened.keep).sum())
    if count > max(MOST_REFUSED[1] * len(screened.keep), 2):
        raise InputError(
            f"{where}: {count} of {len(screened.keep)} fixes are impossible, the first at {screened.first}; give them "
            "quality 0, or correct units and columns"
        )
    far = [(t, way) for t, way in screened.switched if way > MOST_SWITCH_M]
    if far:
        raise InputError(
            f"{where}: positions jump by {far[0][1] / 1000:.0f} km before t = {far[0][0]:.1f} s and stay there; split "
            "the drive there, or give the wrong fixes quality 0"
        )
    if not count:
        return gnss
    keep = np.ones(len(fix), bool)
    keep[np.flatnonzero(fix)[~screened.keep]] = False
    return {name: values[keep] for name, values in gnss.items()}


def _explain_outside(t: np.ndarray, first: float, last: float) -> str:
    """What fixes that lie outside the IMU's time may count."""
    if len(t) == 1 and first - 1 <= t[0] <= last + 1:
        return "give fixes all along the drive, or leave it out"
    if abs(abs(t[0] - first) - GPS_EPOCH_UNIX) < DAY_S:
        clock = "one counts from 1970, the other from 1980; give time.clock to both or to neither"
        return f"both need the same clock: {clock}"
    seconds = 3600 * round((first + last - t[0] - t[-1]) / 2 / 3600)
    if 0 < abs(seconds) <= 3600 * MOST_HOURS and ((t + seconds > first) & (t + seconds <= last + 1)).any():
        return (
            f"both need the same clock: they are {abs(seconds) // 3600} h apart, as time zones are; add {seconds} s to "
            f"t of gnss (reader.gnss.time.offset_s={seconds})"
        )
    if unit := _find_unit(np.ptp(t) / max(last - first, 1.0), 0.5, 2.0):
        return _say_unit(unit, "gnss")
    return "both need the same clock (reader.gnss.time.offset_s=auto estimates the offset)"


def _check_fixes_there(gnss: Columns, where: str) -> None:
    """Why there is no fix, where that is not because the receiver had none."""
    placed = np.isfinite(gnss["lat_deg"]) & np.isfinite(gnss["lon_deg"])
    codes = np.unique(gnss["quality"])
    if placed.any() and not np.isfinite(gnss["height_m"]).any():
        raise InputError(f"{where}: height_m is NaN in every row; give one number for all where it is not known")
    if placed.any() and not np.isin(codes, range(10)).any():
        raise InputError(f"{where}: quality is {codes[0]} in row 0; must be a code of NMEA: 1, 2, 4, 5, 0 for no fix")


def _check_reference(reference: Columns, imu: Columns, fixes: Columns, where: str) -> None:
    check_time(reference["t"], where, "reference")
    refuse_rows(reference, (*POSITION, *VELOCITY, *ATTITUDE), np.isinf, where, "write NaN where it is unknown")
    known = reference["valid"] & np.isfinite(reference["lat_deg"]) & np.isfinite(reference["lon_deg"])
    if not known.any():
        return
    rows = {name: values[known] for name, values in reference.items()}
    check_gnss_units(rows, where)
    check_same_clock(rows, fixes, where)
    check_same_place(rows, fixes, where)
    check_attitude(rows, imu, where)
