"""What a public function is given: one line for the first thing that is wrong, before any work."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from numbers import Real
from typing import Any

import numpy as np
import pandas as pd
import yaml

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError, did_you_mean

LONGEST_SHOWN = 80  # letters of a wrong value in a line
LONGEST_ARM_M = 30.0  # a lever arm beyond it is in another unit
OTHER_NAMES = {  # what people call the contract's columns
    "t": ("time", "timestamp", "time_s", "seconds", "stamp", "date"),
    "lat_deg": ("lat", "latitude"),
    "lon_deg": ("lon", "lng", "long", "longitude"),
    "height_m": ("height", "alt", "altitude", "h", "alt_m"),
    "speed": ("speed_mps", "velocity", "v", "speed_kmh"),
    "heading": ("heading_deg", "yaw", "course"),
    **{f"{s}_{a}": (f"{short}{a}", f"{short}_{a}", f"{s}{a}", f"{s[:3]}_{a}")
       for s, short in (("accel", "a"), ("gyro", "g")) for a in "xyz"},
}  # fmt: skip


def check_frames(imu: Any, gnss: Any, reference: Any = None, aids: Mapping[str, Any] | None = None) -> None:
    """InputError for what is no frame, has no rows, lacks columns, or has text or dates where numbers belong."""
    from dlkf.data.schema import AIDS, OPTIONAL, SCHEMAS

    frames = {"imu": imu, "gnss": gnss, "reference": reference, **(aids or {})}
    for name, frame in frames.items():
        if frame is None and name not in ("imu", "gnss"):
            continue
        if not isinstance(frame, pd.DataFrame):
            raise InputError(f"{name} is a {type(frame).__name__}, must be a pandas DataFrame")
    if imu is gnss:
        raise InputError("imu and gnss are the same frame")
    if "lat_deg" in imu and "accel_x" in gnss:
        raise InputError("imu and gnss look exchanged: imu has lat_deg, gnss has accel_x; imu comes first")
    for name, frame in frames.items():
        if frame is None:
            continue
        schema, more = {**SCHEMAS, **AIDS}[name], OPTIONAL[name]
        needed = ("t", "lat_deg", "lon_deg", "height_m") if name in ("gnss", "reference") else schema.names
        _check_columns(name, frame, needed)
        _check_numbers(name, frame, [c for c in (*schema.names, *more.names) if c in frame])
        if not len(frame):
            raise InputError(f"{name} has no rows")
        _check_seconds(name, frame["t"].to_numpy(float))


def _check_seconds(name: str, t: np.ndarray) -> None:
    """InputError for rows so far apart that their times count something smaller than seconds."""
    slowest = {"imu": 0.99, "speed": 50.0, "heading": 50.0, "baro": 50.0}.get(name, 99.0)
    step = float(np.median(np.abs(np.diff(t)))) if len(t) > 2 else 0.0
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if slowest < step <= slowest * factor:
            raise InputError(f"{name}: a row every {step:g} s: t looks like {unit}; divide it by {factor:.0e}")


def _check_columns(name: str, frame: pd.DataFrame, needed: Sequence[str]) -> None:
    columns = [str(c) for c in frame.columns]
    if twice := sorted({c for c in columns if columns.count(c) > 1}):
        raise InputError(f"{name}: column {twice[0]} appears twice; keep one")
    if not (missing := [c for c in needed if c not in columns]):
        return
    lower = {c.lower(): c for c in columns}
    found = {c: next((lower[o] for o in (c, *OTHER_NAMES.get(c, ())) if o in lower), None) for c in missing}
    renamed = {old: new for new, old in found.items() if old is not None}
    remedy = f"has {', '.join(columns[:12])}{', …' if len(columns) > 12 else ''}" if columns else "has no columns"
    if missing == ["t"] and frame.index.name == "t":
        remedy = f"t is its index; give {name}.reset_index()"
    elif len(renamed) == len(missing):
        remedy += f"; {name}.rename(columns={renamed}), units of the contract (dlkf.read_logs finds names and units)"
    else:
        remedy += "; dlkf.read_logs reads logs with other names and units"
    raise InputError(f"{name}: column {', '.join(missing)} missing; {remedy}")


def _check_numbers(name: str, frame: pd.DataFrame, columns: Iterable[str]) -> None:
    for column in columns:
        values = frame[column]
        if pd.api.types.is_bool_dtype(values) or (
            pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_complex_dtype(values)
        ):
            continue
        if column == "t" and pd.api.types.is_timedelta64_dtype(values):
            raise InputError(f"{name}: t is a time difference, must be seconds: {name}.t.dt.total_seconds()")
        if pd.api.types.is_datetime64_any_dtype(values):
            raise InputError(
                f"{name}: {column} is a date, must be seconds on one clock for all frames: "
                f'({name}.{column} - pd.Timestamp("2025-07-05")).dt.total_seconds()'
            )
        try:
            pd.to_numeric(values)
            known = True
        except (TypeError, ValueError):
            known = False
        if known and not values.isna().any():
            remedy = f"numbers as text; pd.to_numeric({name}.{column}) makes them numbers"
        elif known:
            continue  # numbers and None
        else:
            wrong = next(k for k, v in enumerate(values) if not _is_number(v))
            if column == "t" and _is_date(values.iloc[wrong]):
                raise InputError(
                    f"{name}: t has dates as text, must be seconds on one clock for all frames: "
                    f'(pd.to_datetime({name}.t) - pd.Timestamp("2025-07-05")).dt.total_seconds()'
                )
            remedy = f"row {wrong} has {values.iloc[wrong]!r}, must be a number, NaN where unknown"
        raise InputError(f"{name}: {column}: {remedy}")


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _is_date(value: Any) -> bool:
    return isinstance(value, str) and len(value) > 7 and pd.notna(pd.to_datetime(value, errors="coerce"))


def _shown(value: Any) -> str:
    """A wrong value in one short line: arrays and frames have several."""
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 1]}…"


def check_lever_arm(lever_arm: Any) -> tuple[float, float, float]:
    """Three finite numbers [m]."""
    try:
        arm = np.asarray(lever_arm, float)
    except (TypeError, ValueError):
        arm = np.empty(0)
    if arm.shape != (3,) or not np.isfinite(arm).all():
        raise InputError(
            f"lever_arm is {_shown(lever_arm)}, must be three numbers: IMU → antenna, Forward-Right-Down [m]"
        )
    if np.abs(arm).max() > LONGEST_ARM_M:
        raise InputError(f"lever_arm is {_shown(lever_arm)}: an antenna {np.abs(arm).max():g} m away; metres are meant")
    return (float(arm[0]), float(arm[1]), float(arm[2]))


def check_above_zero(**values: Any) -> None:
    """InputError for one that is no finite number above 0."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value) or value <= 0:
            raise InputError(f"{name} is {_shown(value)}, must be a number above 0")


def check_options(function: str, options: Iterable[str], of: Callable[..., Any], apart: Sequence[str]) -> None:
    """InputError for an option that ``of`` does not have, or has but ``apart`` from these."""
    known = [name for name in signature(of).parameters if name not in apart]
    if unknown := next((name for name in options if name not in known), None):
        near = did_you_mean(unknown, known) or ";"
        raise InputError(f"{function} has no option {unknown}{near} it has {', '.join(known)}")


def check_switch(name: str, value: Any) -> None:
    """InputError for what is neither true nor false."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} is {_shown(value)}, must be True or False")


def check_model(model: Any) -> str:
    """A filter's name; InputError for what is none."""
    if not isinstance(model, str):
        raise InputError(
            f"model is a {type(model).__name__}, must be a name such as 'plus', a folder, or 'module:Class'"
        )
    return model


def check_models(models: Any) -> list[str]:
    """One or several filters' names."""
    names = [models] if isinstance(models, str) else models
    if not isinstance(names, (list, tuple)) or not names:
        raise InputError(
            f"models is {_shown(models)}, must be a name or a list of names such as ['mbkf21_nhc', 'plus']"
        )
    return [check_model(name) for name in names]


def check_imu_type(imu_type: Any) -> None:
    """A preset of conf/imu, or what stands in one."""
    if isinstance(imu_type, Mapping):
        return
    if imu_type == "auto":
        raise InputError("imu_type='auto' is for dlkf navigate imu=auto alone; give a preset, or model='plus'")
    check_preset("imu", imu_type, "imu_type")


def check_whole(name: str, value: Any, least: int) -> int:
    """A whole number from ``least`` on."""
    if isinstance(value, bool) or not isinstance(value, Real) or value != math.floor(value) or value < least:
        raise InputError(f"{name} is {_shown(value)}, must be a whole number from {least} on")
    return int(float(value))


def check_preset(group: str, name: Any, argument: str = "") -> None:
    """InputError for a name that is no preset of ``conf/<group>``, with the closest."""
    known = sorted(f.stem for f in (config_dir() / group).glob("*.yaml") if not f.stem.startswith("_"))
    if not isinstance(name, str):
        raise InputError(f"{argument or group} is {_shown(name)}, must be the name of a preset: {', '.join(known)}")
    if name not in known:
        near = did_you_mean(name, known)
        raise InputError(f"unknown {group} preset {name!r}{near or ';'} known are {', '.join(known)}")


def read_preset(group: str, name: Any) -> dict[str, Any]:
    """The content of a preset of ``conf/<group>``."""
    check_preset(group, name)
    return yaml.safe_load((config_dir() / group / f"{name}.yaml").read_text())


def tuning_values(tuning: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The factors of a Kalman filter's noise: a preset of ``conf/tuning``, or such factors by name."""
    if isinstance(tuning, Mapping):
        return tuning
    check_preset("tuning", tuning)
    below = tuning_values("untuned") if tuning != "untuned" else {}
    return {**below, **{key: value for key, value in read_preset("tuning", tuning).items() if key != "defaults"}}


def imu_values(imu_type: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The values of an IMU's error model."""
    return imu_type if isinstance(imu_type, Mapping) else read_preset("imu", imu_type)
