"""What a public function is given: one line for the first thing that is wrong, before any work."""

from __future__ import annotations

import math
import operator
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from dlkf.base.config import preset_names, read_preset
from dlkf.base.errors import InputError, did_you_mean
from dlkf.data.limits import LEVER_ARM_M

if TYPE_CHECKING:
    from dlkf.filters.tuning import Prior

LONGEST_SHOWN = 80  # letters of a wrong value in a line
CODES = range(10)  # of NMEA's GGA sentence
NOT_IN_PYTHON = (("imu", "auto"), ("simulated", "semi_real"))  # presets of commands alone
SHOWN = 12  # columns in a line
OTHER_NAMES = {  # what people call the contract's columns, beside what the readers know (dlkf.data.readers.vocabulary)
    "t": ("time", "timestamp", "time_s", "seconds", "stamp", "date"),
    "speed": ("speed_mps", "velocity", "v", "speed_kmh"),
    "heading": ("heading_deg", "yaw", "course"),
    **{f"{s}_{a}": (f"{short}{a}", f"{short}_{a}", f"{s}{a}", f"{s[:3]}_{a}")
       for s, short in (("accel", "a"), ("gyro", "g")) for a in "xyz"},
}  # fmt: skip
QUANTITIES = {"lat_deg": "lat", "lon_deg": "lon", "height_m": "height"}
OPTIONAL_OF_GNSS = {  # what the readers call a quantity: the contract's column for it
    **dict.fromkeys(("north", "east", "down", "up", "speed", "course"), "vel_n"),
    **dict.fromkeys(("hacc", "vacc", "std_pos_n", "std_pos_e", "std_pos_d"), "std_pos_n"),
    **dict.fromkeys(("sacc", "std_vel_n", "std_vel_e", "std_vel_d"), "std_vel_n"),
    "quality": "quality",
}


def check_frames(imu: Any, gnss: Any, reference: Any = None, aids: Mapping[str, Any] | None = None) -> None:
    """InputError for what is no frame, has no rows, lacks columns, or has text or dates where numbers belong."""
    from dlkf.data.schema import AIDS, OPTIONAL, SCHEMAS, VELOCITY

    others = {"reference": reference, **(aids or {})}
    frames = {"imu": imu, "gnss": gnss, **{name: frame for name, frame in others.items() if frame is not None}}
    for name, frame in frames.items():
        if not isinstance(frame, pd.DataFrame):
            raise InputError(f"{name} is a {type(frame).__name__}, must be a pandas DataFrame{_as_pandas(name, frame)}")
    if imu is gnss:
        raise InputError("imu and gnss are the same frame")
    if "lat_deg" in imu and "accel_x" in gnss:
        raise InputError("imu and gnss look exchanged: imu has lat_deg, gnss has accel_x; imu comes first")
    for name, frame in frames.items():
        schema, more = {**SCHEMAS, **AIDS}[name], OPTIONAL[name]
        needed = ("t", "lat_deg", "lon_deg", "height_m") if name in ("gnss", "reference") else schema.names
        check_columns(name, frame, needed)
        _check_numbers(name, frame, [c for c in (*schema.names, *more.names) if c in frame])
        if not len(frame):
            raise InputError(f"{name} has no rows")
    if reference is not None and (unknown := [c for c in VELOCITY if c not in reference or reference[c].isna().all()]):
        raise InputError(
            f"reference: {', '.join(unknown)} missing; errors are measured against positions and velocities, and "
            "without reference= against the drive smoothed with its fixes"
        )
    _check_seconds({name: frames[name]["t"].to_numpy(float) for name in ("gnss", *frames)})
    _check_quality(gnss)
    if len(horizontal := [c for c in ("vel_n", "vel_e") if c in gnss]) == 1:
        raise InputError(f"gnss: has {horizontal[0]} alone; give vel_n and vel_e, or neither without velocities")
    warn_of_other_columns(gnss)


def check_columns(name: str, frame: pd.DataFrame, needed: Sequence[str]) -> None:
    """InputError for columns that are missing, with what is there in their place, or stand twice."""
    if frame.columns.nlevels > 1:
        raise InputError(f"{name}: its columns have {frame.columns.nlevels} levels, must be plain names")
    columns = [str(c) for c in frame.columns]
    if twice := sorted({c for c in columns if columns.count(c) > 1}):
        raise InputError(f"{name}: column {twice[0]} appears twice; keep one")
    if not (missing := [c for c in needed if c not in columns]):
        return
    renamed = other_names(columns, missing)
    remedy = f"has {', '.join(columns[:SHOWN])}{', …' if len(columns) > SHOWN else ''}" if columns else "has no columns"
    if missing == ["t"] and frame.index.name == "t":
        remedy = f"t is its index; give {name}.reset_index()"
    elif {c.strip() for c in columns} >= set(needed):
        remedy = f"its names have blanks around them; {name}.rename(columns=str.strip)"
    elif len(renamed) == len(missing):
        remedy += f"; {name}.rename(columns={renamed}) if its units are those of docs: Data; else dlkf.read_logs"
    else:
        remedy += "; dlkf.read_logs reads logs with other names and units"
    raise InputError(f"{name}: column {', '.join(missing)} missing; {remedy}")


def other_names(columns: Sequence[str], missing: Iterable[str]) -> dict[str, str]:
    """Which columns are likely to be the missing ones: ``{"ax": "accel_x"}``."""
    from dlkf.data.readers.vocabulary import SENSORS, find_column, triad

    lower = {c.lower(): c for c in columns}
    found = {c: next((lower[o] for o in (c, *OTHER_NAMES.get(c, ())) if o in lower), None) for c in missing}
    for sensor, stem in SENSORS.items():
        three = triad(columns, stem) or ()
        found |= {f"{sensor}_{a}": c for a, c in zip("xyz", three) if found.get(f"{sensor}_{a}", c) is None}
    for column, quantity in QUANTITIES.items():
        if column in found and found[column] is None:
            found[column] = find_column(columns, quantity)
    return {old: new for new, old in found.items() if old is not None}


def warn_of_other_columns(gnss: pd.DataFrame) -> None:
    """A warning for columns of a fix that the contract has under another name: they are not used."""
    from dlkf.data.readers.vocabulary import find_column

    others: list[Any] = [c for c in gnss.columns if c not in ("t", *QUANTITIES, *OPTIONAL_OF_GNSS.values())]
    unused = {
        column: wanted
        for quantity, wanted in OPTIONAL_OF_GNSS.items()
        if wanted not in gnss and (column := find_column(map(str, others), quantity)) is not None
    }
    if unused:
        names, wanted = ", ".join(unused), ", ".join(dict.fromkeys(unused.values()))
        line = f"gnss: columns {names} are not used; a dataset has the names {wanted}, … (docs: Data)"
        warnings.warn(line, UserWarning, stacklevel=6)


def _as_pandas(name: str, given: Any) -> str:
    """How what was given becomes a pandas frame, where that is known."""
    if isinstance(given, (str, Path)):
        return f"; pd.read_csv({str(given)!r}) or dlkf.read_logs make one of a file"
    for method in ("to_pandas", "toPandas"):
        if hasattr(given, method):
            return f": give {name}.{method}()"
    return ""


def _check_seconds(times: Mapping[str, np.ndarray]) -> None:
    """InputError for rows so far apart that their times count something smaller than seconds, or nothing but rows."""
    for name, t in times.items():
        slowest = {"imu": 0.99, "speed": 50.0, "heading": 50.0, "baro": 50.0}.get(name, 99.0)
        steps = np.diff(t)
        step = float(np.median(steps)) if len(t) > 2 and (steps > 0).all() else 0.0
        if name == "imu" and 0.99 < step < 10 and len(times["gnss"]) and t[-1] - t[0] < 2 * np.ptp(times["gnss"]):
            raise InputError(f"imu: a row every {step:g} s; a car's IMU has at least 5 a second: give all its samples")
        for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
            if slowest < step <= slowest * factor:
                count = ", or the numbers of the rows" if step == 1 else ""
                raise InputError(
                    f"{name}: a row every {step:g} s: t looks like {unit}{count}; divide it by {factor:g}"
                    + (", or by the rate in Hz" if count else "")
                )


def _check_quality(gnss: pd.DataFrame) -> None:
    """InputError for a quality that is no code of NMEA; NaN is unknown."""
    if "quality" not in gnss:
        return
    values = pd.to_numeric(gnss["quality"]).to_numpy(float, na_value=np.nan)
    bad = np.flatnonzero(np.isfinite(values) & ~np.isin(values, CODES))
    if len(bad):
        raise InputError(
            f"gnss: quality: row {bad[0]} has {values[bad[0]]:g}, must be a code of NMEA: 1 single, 2 DGNSS, 4 RTK "
            "fixed, 5 RTK float, 0 no fix, NaN where unknown"
        )


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
        if pd.api.types.is_complex_dtype(values):
            raise InputError(f"{name}: {column}: complex numbers, must be real")
        values = values.astype(object)
        try:
            pd.to_numeric(values)
            known = True
        except (TypeError, ValueError):
            known = False
        if known and not any(isinstance(value, str) for value in values):
            continue  # numbers and None
        if known:
            remedy = f"numbers as text; pd.to_numeric({name}.{column}) makes them numbers"
        else:
            wrong, value = next((k, v) for k, v in enumerate(values) if not _is_number(v))
            is_text = isinstance(value, str) and len(value) > 7
            if column == "t" and is_text and pd.notna(pd.to_datetime(value, errors="coerce")):
                raise InputError(
                    f"{name}: t has dates as text, must be seconds on one clock for all frames: "
                    f'(pd.to_datetime({name}.t) - pd.Timestamp("2025-07-05")).dt.total_seconds()'
                )
            remedy = f"row {wrong} has {value!r}, must be a number, NaN where unknown"
        raise InputError(f"{name}: {column}: {remedy}")


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _shorten(value: Any) -> str:
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
            f"lever_arm is {_shorten(lever_arm)}, must be three numbers: IMU → antenna, Forward-Right-Down [m]"
        )
    if np.abs(arm).max() > LEVER_ARM_M:
        far = f"{np.abs(arm).max():g} m"
        raise InputError(f"lever_arm is {_shorten(lever_arm)}: the antenna would be {far} from the IMU; give metres")
    return (float(arm[0]), float(arm[1]), float(arm[2]))


def check_above_zero(**values: Any) -> None:
    """InputError for one that is no finite number above 0."""
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value) or value <= 0:
            raise InputError(f"{name} is {_shorten(value)}, must be a number above 0")


def check_options(function: str, options: Iterable[str], of: Callable[..., Any], apart: Sequence[str]) -> None:
    """InputError for an option that ``of`` does not have, or has but ``apart`` from these."""
    known = [name for name in signature(of).parameters if name not in apart]
    if unknown := next((name for name in options if name not in known), None):
        near = did_you_mean(unknown, known) or ";"
        raise InputError(f"{function} has no option {unknown}{near} it has {', '.join(known)}")


def check_switch(name: str, value: Any) -> None:
    """InputError for what is neither true nor false."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} is {_shorten(value)}, must be True or False")


def check_model(model: Any) -> str:
    """A filter's name, or its folder's path as text; InputError for what is none."""
    if isinstance(model, Path):
        return str(model)
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
            f"models is {_shorten(models)}, must be a name or a list of names such as ['mbkf21_nhc', 'plus']"
        )
    checked = [check_model(name) for name in names]
    if twice := sorted({name for name in checked if checked.count(name) > 1}):
        raise InputError(f"models: {', '.join(twice)} stands twice; name each filter once")
    return checked


def check_aids(aids: Any) -> list[str]:
    """One or several sensors' names."""
    names = [aids] if isinstance(aids, str) else aids
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) for name in names):
        raise InputError(f"aids is {_shorten(aids)}, must be a name or a list of names such as ['speed']")
    return list(names)


def check_whole(name: str, value: Any, least: int) -> int:
    """A whole number from ``least`` on."""
    if isinstance(value, Integral) and not isinstance(value, bool):
        number = operator.index(value)  # exact, where a float is not
    elif isinstance(value, Real) and not isinstance(value, bool) and float(value).is_integer():
        number = int(float(value))
    else:
        number = least - 1
    if number < least:
        raise InputError(f"{name} is {_shorten(value)}, must be a whole number from {least} on")
    return number


def check_preset(group: str, name: Any, argument: str = "") -> None:
    """InputError for a name that is no preset of ``conf/<group>``, with the closest."""
    known = [name for name in preset_names(group) if (group, name) not in NOT_IN_PYTHON]
    if not isinstance(name, str):
        raise InputError(f"{argument or group} is {_shorten(name)}, must be the name of a preset: {', '.join(known)}")
    if name not in known:
        near = did_you_mean(name, known)
        raise InputError(f"unknown {group} preset {name!r}{near or ';'} known are {', '.join(known)}")


def tuning_values(tuning: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The factors of a Kalman filter's noise: a preset of ``conf/tuning``, or such factors by name."""
    return _preset_values("tuning", tuning)


def prior_values(prior: Mapping[str, Sequence[float]] | None) -> Prior | None:
    """What is known of an IMU error before the drive."""
    from dlkf.filters.tuning import Prior

    if prior is None:
        return None
    fine = isinstance(prior, Mapping) and set(prior) == {"mean", "std"}
    try:
        numbers = {k: tuple(np.asarray(prior[k], float).reshape(-1).tolist()) for k in prior} if fine else None
    except (TypeError, ValueError):
        numbers = None
    if numbers is None:
        raise InputError(f"prior is {prior!r}, must be {{'mean': numbers, 'std': numbers}}")
    return Prior(**numbers)


def imu_values(imu_type: str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The values of an IMU's error model: a preset of ``conf/imu``, or what stands in one."""
    if isinstance(imu_type, str) and imu_type == "auto":
        raise InputError(
            "imu_type='auto': only the command dlkf navigate finds the noise (imu=auto); give a preset, or model='plus'"
        )
    return _preset_values("imu", imu_type, "imu_type")


def _preset_values(group: str, given: str | Mapping[str, Any], argument: str = "") -> Mapping[str, Any]:
    if isinstance(given, Mapping):
        return given
    check_preset(group, given, argument)
    return read_preset(group, given)
