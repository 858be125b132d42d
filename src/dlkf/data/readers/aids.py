"""Further sensors of a drive as tables of the contract: wheel speed, heading, barometer; and their clocks and units."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.clock import describe_offset
from dlkf.data.discovery.motion import Motion, find_motion
from dlkf.data.discovery.wheel import Wheel, find_force_lag, find_wheel
from dlkf.data.limits import FASTEST_M_S
from dlkf.data.readers import units
from dlkf.data.readers.counters import count_rates
from dlkf.data.readers.mapping import Mapped
from dlkf.data.validate import usable_fixes

AUTO = "auto"
PRESSURE = {"pa": 1.0, "hpa": 100.0, "mbar": 100.0, "kpa": 1000.0}
TURNS = {"rpm": 1 / 60, "turns": 1.0}  # turns (a second), with radius_m
COUNTS = ("ticks", "turns", "m")  # what has been gained since the beginning; its rate is the speed
UNKNOWN = -1  # of a column that has no other number below zero
MOST_BEYOND = 0.05  # of a wheel's rows, faster than any car: more are of another unit
LATE_S = 0.3  # by which the speed of GNSS is seen to differ from the IMU
NEAR = 0.15  # of a wheel's scale from a known unit: tyres differ by some per cent


def aid_frame(name: str, mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """The contract's table of an aid at times ``t``; rows without a value are left out."""
    frame = {"speed": _speed, "heading": _heading, "baro": _baro}[name](mapped, t)
    values = [c for c in frame if c not in ("t", "std")]
    known = frame[values].notna().any(axis=1) & (frame["t"].diff().fillna(1.0) > 0)
    return frame[known].reset_index(drop=True)


def read_aids(
    mapped: Mapping[str, Mapped],
    zero: int,
    imu: pd.DataFrame,
    gnss: Mapped | None,
    fixes: pd.DataFrame | None,
    where: str,
) -> tuple[dict[str, pd.DataFrame], dict[str, Any], list[str]]:
    """Tables, specs without ``auto``, and what was found, of the aids of a drive that counts from the second ``zero``.

    ``gnss`` and ``fixes`` are the fixes' mapping and table on the drive's clock, by which a wheel's clock and unit are
    found; ``imu`` is that of the samples, by which the speed of the fixes is checked. InputError where they are not
    clear.
    """
    frames, specs, notes = {}, {}, []
    moved = None if fixes is None or len(fixes) < 3 else find_motion(fixes[usable_fixes(fixes)])
    for name, part in mapped.items():
        spec, found = _settle_auto(name, part, zero, imu, gnss, moved, f"{where}: {part.table.path.name}")
        done = replace(part, spec=spec)
        frames[name], specs[name] = aid_frame(name, done, _times(done, zero)), spec
        if name == "speed":
            frames[name], beyond = _drop_impossible(frames[name], part.table.path.name)
            found += beyond
        if not len(frames[name]):
            raise InputError(f"{where}: {part.table.path.name} has no value of {name}; set reader.{name}.file=null")
        notes += found
    return frames, specs, notes


def _drop_impossible(frame: pd.DataFrame, name: str) -> tuple[pd.DataFrame, list[str]]:
    """The rows of a wheel that some car can drive, and a line on the others; all where many are beyond that."""
    beyond = frame["speed"].abs() > FASTEST_M_S
    if not 0 < beyond.mean() <= MOST_BEYOND:
        return frame, []
    said = f"left out {int(beyond.sum())} of {len(frame)} speeds of {name}, beyond {FASTEST_M_S:g} m/s"
    return frame[~beyond].reset_index(drop=True), [said]


def _times(mapped: Mapped, zero: int) -> np.ndarray:
    """Seconds on the drive's clock, with what is left ``auto`` as zero."""
    time = dict(mapped.time)
    time["offset_s"] = None if time.get("offset_s") == AUTO else time.get("offset_s")
    whole, part = replace(mapped, spec={**mapped.spec, "time": time}).stamps()
    return (whole - zero) + part


def _settle_auto(
    name: str, mapped: Mapped, zero: int, imu: pd.DataFrame, gnss: Mapped | None, moved: Motion | None, where: str
) -> tuple[dict[str, Any], list[str]]:
    """Offset and unit that are left ``auto``: of a table beside the fixes as those have it, of a wheel by its speed."""
    spec: dict[str, Any] = copy.deepcopy(dict(mapped.spec))
    time, notes = spec.get("time") or {}, []
    spec["time"] = time
    if time.get("offset_s") == AUTO and gnss is not None and gnss.table.path == mapped.table.path:
        said = gnss.time
        drift = float(said.get("drift_ppm") or 0.0)
        (whole, part), (first, rest) = (one.own_stamps() for one in (mapped, gnss))
        later = float(whole[0] - first[0]) + float(part[0] - rest[0])
        time |= {"offset_s": float(said.get("offset_s") or 0.0) + 1e-6 * drift * later, "drift_ppm": drift}
    elif time.get("offset_s") == AUTO and name != "speed":
        time["offset_s"] = 0.0
        notes.append(f"took reader.{name}.time.offset_s=0: nothing relates its clock to that of the IMU")
    value = spec.get("value") if name == "speed" else None
    if value is None or AUTO not in (time.get("offset_s"), value.get("unit")):
        return spec, notes
    if moved is None:
        raise InputError(f"{where}: reader.speed.…=auto needs GNSS to compare with; give value.unit and time.offset_s")
    one = {**value, "unit": 1.0} if value.get("unit") == AUTO else value
    neutral = replace(mapped, spec={**spec, "value": one})
    raw = aid_frame(name, neutral, _times(neutral, zero))
    wheel = find_wheel(raw["t"].to_numpy(), raw["speed"].to_numpy(), moved)
    if wheel is None or not wheel.clear:
        why = "too little in common" if wheel is None else f"they agree to {wheel.alike:.2f} of 1 at best"
        raise InputError(
            f"{where}: not sure that this is the speed of a wheel: against the speed of GNSS {why}; give "
            "reader.speed.time.offset_s and reader.speed.value.unit, or leave it out with reader.speed.file=null"
        )
    if time.get("offset_s") == AUTO:
        time["offset_s"], detail = _offset(wheel, raw, imu)
        notes.append(f"found reader.speed.time.offset_s={time['offset_s']}  ({detail})")
    if value.get("unit") == AUTO:
        value["unit"], detail = _unit(wheel, _counts(neutral))
        notes.append(f"found reader.speed.value.unit={value['unit']}  ({detail})")
    return spec, notes


def _offset(wheel: Wheel, raw: pd.DataFrame, imu: pd.DataFrame) -> tuple[float, str]:
    """The offset by GNSS; where the IMU shows that the speed of GNSS is early or late, that by the IMU."""
    found = 0.0 if abs(wheel.lag_s) < 3 * wheel.lag_std else round(wheel.lag_s, 4)
    by_gnss = f"{wheel.lag_s:+.3f} ± {wheel.lag_std:.3f} s, speeds agree to {wheel.alike:.3f} of 1"
    t, speed = raw["t"].to_numpy() + wheel.lag_s, wheel.scale * raw["speed"].to_numpy()
    force = find_force_lag(t, speed, imu["t"].to_numpy(), imu["accel_x"].to_numpy())
    if force is None or abs(force[0]) < LATE_S:
        return found, by_gnss + describe_offset(wheel.lag_s)
    late = f"that speed is {abs(force[0]):.1f} s {'late' if force[0] < 0 else 'early'}"
    by_imu = f"by the IMU's forward acceleration, which agrees to {force[1]:.2f} of 1"
    by_gnss += describe_offset(wheel.lag_s)
    return round(wheel.lag_s + force[0], 2), f"{by_imu}; by the speed of GNSS {by_gnss}: {late}"


def _unit(wheel: Wheel, counts: bool) -> tuple[str | float, str]:
    """The unit of about a scale; a number where it is none of those known: of ticks, whose scale is lost so."""
    detail = f"{wheel.scale:.4g} ± {wheel.scale_std:.1g} m/s of GNSS per unit"
    near = {name: abs(np.log(wheel.scale / value)) for name, value in units.SPEED.items()} if wheel.scale > 0 else {}
    best = min(near, key=lambda name: near[name], default=None)
    if best is not None and near[best] < NEAR and not counts:
        return best, detail
    return float(f"{wheel.scale:.5g}"), f"{detail}: no unit that is known, so a number by GNSS"


def _speed(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """Forward speed [m/s]: the mean of the columns (wheels of one axle), or of what they gained between two rows,
    which is the speed in the middle between them."""
    entry = mapped.spec["value"]
    values = mapped.vector("value", tuple(range(1, 9)), nan=True)
    backward = ((values < 0) & (values != UNKNOWN)).any(0)
    values = np.where((values == UNKNOWN) & ~backward, np.nan, values)
    unit = entry.get("unit") or "m/s"
    if _counts(mapped):
        values = np.stack([count_rates(t, one) for one in values.T], -1)
        t = (t[1:] + t[:-1]) / 2
    known = np.isfinite(values)
    values = np.where(known, values, 0.0).sum(1) / np.where(known.any(1), known.sum(1), np.nan)
    scale = _metres_per_unit(entry, unit)
    return pd.DataFrame({"t": t, "speed": values * scale, **(_std(mapped, scale) if len(t) == len(mapped) else {})})


def _counts(mapped: Mapped) -> bool:
    """Whether the columns count on, by the unit, by ``counts``, or as a reader's own column of ticks does."""
    entry = mapped.spec["value"]
    if entry.get("counts") is not None or entry.get("unit") in COUNTS:
        return bool(entry.get("counts", True)) or entry.get("unit") in COUNTS
    first = str(entry["columns"][0]).split(" | ")
    return next((name for name in first if name in mapped.table.frame), "") == "ticks"


def _metres_per_unit(entry: Mapping[str, Any], unit: Any) -> float:
    """Metres (a second) per unit: of ticks by ``per_metre``, or by ``per_turn`` and ``radius_m``; of turns by the
    radius."""
    where = "reader.speed.value"
    if unit == "m":
        return 1.0
    if unit == "ticks" and entry.get("per_metre"):
        return 1.0 / float(entry["per_metre"])
    if unit == "ticks" or unit in TURNS:
        needed = ("radius_m", "per_turn") if unit == "ticks" else ("radius_m",)
        if missing := [key for key in needed if not entry.get(key)]:
            more = " (or per_metre)" if unit == "ticks" else ""
            raise InputError(
                f"{where}.{missing[0]} is missing; unit={unit} needs {' and '.join(needed)}{more}, or auto"
            )
        around = 2 * np.pi * float(entry["radius_m"])
        return around * TURNS[unit] if unit in TURNS else around / float(entry["per_turn"])
    return units.factor(unit, {**units.SPEED, "ticks": 1.0, "turns": 1.0, "rpm": 1.0}, f"{where}.unit")


def _heading(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """Heading of the car [rad] clockwise from North, ``antennas_deg`` (their bearing in the car) taken off."""
    entry = mapped.spec["value"]
    scale = mapped.scale("value", units.ANGLE)
    angle = mapped.vector("value", (1,), nan=True)[:, 0] * scale
    if (entry.get("convention") or "ned") == "enu":
        angle = np.pi / 2 - angle
    angle = angle - units.DEG * float(entry.get("antennas_deg") or 0.0)
    return pd.DataFrame({"t": t, "heading": wrap_angle(angle), **_std(mapped, scale)})


def _baro(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """Pressure [Pa], or height [m]."""
    entries = (("pressure", "pressure", PRESSURE), ("height", "height_m", units.LENGTH))
    found = {
        name: mapped.vector(key, (1,), nan=True)[:, 0] * mapped.scale(key, known)
        for key, name, known in entries
        if mapped.has(key)
    }
    if not found:
        raise InputError("reader.baro has neither pressure nor height; name one's columns")
    return pd.DataFrame({"t": t, **found, **_std(mapped, 1.0)})


def _std(mapped: Mapped, scale: float) -> dict[str, np.ndarray]:
    """The column of 1σ, where there is one, in SI."""
    return {"std": mapped.vector("std", (1,), nan=True)[:, 0] * scale} if mapped.has("std") else {}
