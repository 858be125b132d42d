"""A mapped table as one of the contract's tables: SI, Forward-Right-Down, degrees, North-East-Down."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import pymap3d
from scipy.spatial.transform import Rotation

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.limits import NOWHERE_DEG
from dlkf.data.readers import units
from dlkf.data.readers.mapping import Mapped
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, POSITION, STD, VELOCITY
from dlkf.data.validate import usable_fixes

LATE = {"end": 0.0, "middle": 0.5, "start": 1.0}  # of the interval, by which a stamp is early
LOST = 1.5  # usual steps: a longer one has lost rows (dlkf.data.resampling bridges it)
ANGLES = {"deg": 1.0, "rad": 1 / units.DEG, "1e-7deg": 1e-7, "ddmm": 1.0}  # degrees per unit


def imu_frame(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """Rates and specific forces over intervals that end at ``t``."""
    step = np.diff(t, prepend=np.nan)
    usual = float(np.median(step[1:])) if len(t) > 1 else float("nan")
    step[0] = usual
    out: dict[str, np.ndarray] = {}
    for key, names, known in (("gyro", GYRO, units.RATE), ("accel", ACCEL, units.ACCELERATION)):
        values = mapped.vector(key, (3,), nan=False) * mapped.scale(key, known)
        values = values * units.mirror(mapped.spec[key].get("mirror"), f"reader.imu.{key}.mirror")
        turn = units.rotation(mapped.spec[key].get("axes", "frd"), f"reader.imu.{key}.axes")
        if mapped.spec.get("increments"):
            gained = np.where(step > LOST * usual, usual, step)[:, None]  # in a step of its own after rows were lost
            with np.errstate(divide="ignore"):  # stamps that stand twice are refused with their row later
                values = np.where(gained > 0, values / gained, 0.0)
        out |= dict(zip(names, (values @ turn.T).T))
    stamp = mapped.spec.get("stamp") or "end"
    if stamp not in LATE:
        raise InputError(f"reader.imu.stamp={stamp}: must be end, middle or start of the sample's interval")
    return pd.DataFrame({"t": t + LATE[stamp] * usual, **out})


def gnss_frame(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """Fixes; decimated where ``every_s`` asks for it."""
    position = positions(mapped)
    frame = {"t": t, **position, **velocities(mapped, position)}
    stds = _stds(mapped, "std_position", units.LENGTH, position) + _stds(mapped, "std_velocity", units.SPEED, position)
    frame |= dict(zip(STD, stds))
    fixed = np.all([np.isfinite(frame[c]) for c in POSITION], axis=0)
    out = pd.DataFrame({**frame, "quality": np.where(fixed, _quality(mapped), 0).astype(np.int8)})
    late = float((mapped.spec.get("position") or {}).get("delay_s") or 0.0)
    if late:
        out = _carry_positions(out, late)
    every = mapped.spec.get("every_s")
    if every:
        turn = np.floor((t - t[0]) / float(every) + 1e-6)
        out = out[np.diff(turn, prepend=-1) > 0].reset_index(drop=True)
    return out


def drop_zero_stds(fixes: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Fixes with NaN for a 1σ of 0, which a source writes that does not fill it, and a line on how many there are."""
    zero = fixes[list(STD)] == 0
    count = int((zero.any(axis=1) & usable_fixes(fixes)).sum())
    if not count:
        return fixes, []
    known = fixes.assign(**{name: fixes[name].mask(zero[name]) for name in STD})
    return known, [f"a 1σ of 0 in {count} of {len(fixes)} fixes is taken as unknown: the quality gives it"]


def reference_frame(mapped: Mapped, t: np.ndarray) -> pd.DataFrame:
    """States of a reference."""
    position = positions(mapped)
    frame = {"t": t, **position, **velocities(mapped, position)}
    frame |= dict.fromkeys(ATTITUDE, np.full(len(t), np.nan))
    if mapped.has("attitude"):
        frame |= dict(zip(ATTITUDE, _attitudes(mapped).T))
    valid = np.all([np.isfinite(frame[c]) for c in (*POSITION, *VELOCITY)], axis=0)
    if mapped.has("valid"):
        marks = mapped.find_part("valid").column(mapped.spec["valid"]["column"], nan=True)
        good = mapped.spec["valid"].get("values")
        valid &= np.isin(marks, good) if good else np.nan_to_num(marks) != 0
    return pd.DataFrame({**frame, "valid": valid})


def positions(mapped: Mapped) -> dict[str, np.ndarray]:
    """Latitude and longitude [deg] and height above the ellipsoid [m], from those or from ECEF."""
    spec = mapped.spec.get("position") or {}
    zero = spec.get("zero") or "fix"
    if zero not in ("fix", "none"):
        where = f"reader.{mapped.kind}.position"
        raise InputError(f"{where}.zero={zero}: must be fix, or none where 0°/0° means no position")
    if mapped.option("position", "frame", "llh", "ecef") == "ecef":
        metre = 1.0 if spec.get("unit") == "deg" else mapped.scale("position", units.LENGTH)  # csv's preset: no length
        xyz = mapped.vector("position", (3,), nan=True) * metre
        lost = ~np.isfinite(xyz).all(-1) | (np.linalg.norm(xyz, axis=-1) < 1e6)
        with np.errstate(invalid="ignore"):
            lat, lon, height = pymap3d.ecef2geodetic(*np.where(lost[:, None], np.nan, xyz).T)
    else:
        angle, metre = mapped.scale("position", ANGLES), mapped.scale("position", units.LENGTH, "height_unit")
        lat, lon, height = _latitudes(mapped, spec.get("unit") == "ddmm")
        lat, lon, height = lat * angle, lon * angle, height * metre
        if spec.get("geoid") is not None:
            height = height + mapped.find_part("position").column(spec["geoid"], nan=True) * metre
    with np.errstate(invalid="ignore"):
        lost = (np.abs(lat) < NOWHERE_DEG) & (np.abs(lon) < NOWHERE_DEG) & (zero == "none")
    return dict(zip(POSITION, (np.where(lost, np.nan, x) for x in (lat, lon, height))))


def velocities(mapped: Mapped, position: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """North, East, Down [m/s]; NaN where the source has none."""
    if not mapped.has("velocity"):
        return dict.fromkeys(VELOCITY, np.full(len(mapped), np.nan))
    v = mapped.vector("velocity", (2, 3), nan=True)
    frame = mapped.option("velocity", "frame", "ned", "enu", "course", "ecef")
    speed = mapped.scale("velocity", units.SPEED)
    own = mapped.spec["velocity"].get("climb_unit") is not None
    climb = mapped.scale("velocity", units.SPEED, "climb_unit") if own else speed
    third = v[:, 2] * climb if v.shape[1] == 3 else np.full(len(v), np.nan)
    if frame == "course":  # speed over ground, course over ground [deg], climb
        v = np.where(v[:, :1] < 0, np.nan, v)  # a phone's −1 for an unknown speed
        course = v[:, 1] * units.DEG
        still = v[:, 0] * speed < 0.05  # receivers leave the course empty at rest
        course = np.where(np.isnan(course) & still, 0.0, course)
        return dict(zip(VELOCITY, (speed * v[:, 0] * np.cos(course), speed * v[:, 0] * np.sin(course), -third)))
    if frame == "ecef":
        if v.shape[1] != 3:
            raise InputError(f"reader.{mapped.kind}.velocity.columns has 2 names, must have 3 with frame=ecef")
        return dict(zip(VELOCITY, _to_ned(v * speed, position).T))
    north, east = (v[:, 1], v[:, 0]) if frame == "enu" else (v[:, 0], v[:, 1])
    return dict(zip(VELOCITY, (speed * north, speed * east, -third if frame == "enu" else third)))


def _latitudes(mapped: Mapped, minutes: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latitude, longitude, height in the file's units, signs from the hemispheres' columns."""
    spec = mapped.spec["position"]
    llh = mapped.vector("position", (3,), nan=True)
    part = mapped.find_part("position")
    if minutes and len(bad := np.argwhere(np.abs(llh[:, :2]) % 100 > 60)):
        row, k = map(int, bad[0])
        remedy = f"of minutes alone set reader.{mapped.kind}.position.unit=0.016666666666667"
        what = f"is {llh[row, k]:.10g}, which has more than 60 minutes and is no ddmm.mmmm; {remedy}"
        part.fail(row, spec["columns"][k], what)
    angles = units.degrees_minutes(llh[:, :2]) if minutes else llh[:, :2].copy()
    sides = spec.get("hemispheres")
    if sides is None:
        return angles[:, 0], angles[:, 1], llh[:, 2]
    if isinstance(sides, str) or len(sides) != 2:
        raise InputError(f"reader.{mapped.kind}.position.hemispheres={sides}: must be two columns, of N/S and of E/W")
    for k, (name, letters) in enumerate(zip(sides, ("NS", "EW"))):
        texts = part.texts(name).str.upper().to_numpy()
        known = np.isin(texts, list(letters)) | ~np.isfinite(angles[:, k])
        if not known.all():
            row = int(np.flatnonzero(~known)[0])
            part.fail(row, name, f"is {texts[row]!r}, must be {letters[0]} or {letters[1]}")
        angles[:, k] *= np.where(texts == letters[1], -1.0, 1.0)
    return angles[:, 0], angles[:, 1], llh[:, 2]


def _to_ned(vectors: np.ndarray, position: Mapping[str, np.ndarray]) -> np.ndarray:
    """ECEF vectors (rows, 3) in North-East-Down at the positions."""
    east, north, up = pymap3d.ecef2enuv(*vectors.T, lat0=position["lat_deg"], lon0=position["lon_deg"])
    return np.stack((north, east, -up), -1)


def _stds(mapped: Mapped, key: str, known: Mapping[str, float], position: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """North, East, Down from three columns, or from one for all, or from horizontal and vertical."""
    if not mapped.has(key):
        return [np.full(len(mapped), np.nan)] * 3
    s = mapped.vector(key, (1, 2, 3), nan=True) * mapped.scale(key, known)
    s = np.where(s < 0, np.nan, s)  # phones and receivers write −1 for unknown values
    frame = mapped.option(key, "frame", "ned", "enu", "ecef")
    if frame == "ecef" and s.shape[1] == 3:  # variances turned, correlations unknown
        axes = [_to_ned(np.broadcast_to(unit, s.shape), position) for unit in np.eye(3)]
        return list(np.sqrt(sum((s[:, [k]] * axis) ** 2 for k, axis in enumerate(axes))).T)
    columns = {1: [0, 0, 0], 2: [0, 0, 1], 3: [1, 0, 2] if frame == "enu" else [0, 1, 2]}
    return [s[:, k] for k in columns[s.shape[1]]]


def _quality(mapped: Mapped) -> np.ndarray:
    """NMEA GGA codes: through ``map`` where one is given, else the column as it is, else ``default``."""
    spec: Any = mapped.spec.get("quality") or {}
    name, default = spec.get("column"), spec.get("default")
    if name is None and spec.get("map"):
        raise InputError(f"reader.{mapped.kind}.quality.map needs the column that it is for: give quality.column")
    if name is None:
        return np.full(len(mapped), 1 if default is None else _code(default, "default"))
    part = mapped.find_part("quality")
    if not spec.get("map"):
        return np.nan_to_num(part.column(name, nan=True)).astype(np.int64)
    codes = {str(k): _code(v, f"map.{k}") for k, v in spec["map"].items()}
    texts = part.texts(name)
    unknown = sorted(set(texts) - set(codes))
    if unknown and default is None:
        raise InputError(
            f"{part.table.path}: quality {unknown[0]!r} is not in reader.gnss.quality.map; add it, "
            f"or set reader.gnss.quality.default for all that are not"
        )
    return texts.map(codes).fillna(_code(default or 0, "default")).to_numpy().astype(np.int64)


def _code(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 9:
        raise InputError(f"reader.gnss.quality.{where} is {value!r}, must be a code of NMEA's GGA, 0 to 9")
    return value


def _attitudes(mapped: Mapped) -> np.ndarray:
    """Roll, pitch, yaw [rad] of Forward-Right-Down in North-East-Down, from angles or quaternions (body → n)."""
    convention = mapped.option("attitude", "convention", "ned", "enu")
    order = mapped.option("attitude", "order", "wxyz", "xyzw")
    values = mapped.vector("attitude", (3, 4), nan=True)
    if values.shape[1] == 3:
        rpy = values * mapped.scale("attitude", units.ANGLE)
        if convention == "enu":  # Forward-Left-Up in East-North-Up, yaw counter-clockwise from East
            rpy = np.stack((rpy[:, 0], -rpy[:, 1], np.pi / 2 - rpy[:, 2]), -1)
    else:
        known = np.isfinite(values).all(-1) & (np.linalg.norm(np.nan_to_num(values), axis=-1) > 0.5)
        scalar_last = values[:, [1, 2, 3, 0]] if order == "wxyz" else values
        turn = Rotation.from_quat(np.where(known[:, None], scalar_last, [0.0, 0, 0, 1])).as_matrix()
        if convention == "enu":
            turn = units.rotation("rfu", "") @ turn @ units.rotation("flu", "").T
        yaw_pitch_roll = Rotation.from_matrix(turn).as_euler("ZYX")
        rpy = np.where(known[:, None], yaw_pitch_roll[:, ::-1], np.nan)
    rpy[:, 2] = wrap_angle(rpy[:, 2])
    return rpy


def _carry_positions(gnss: pd.DataFrame, late: float) -> pd.DataFrame:
    """Positions that are ``late`` [s] older than the velocities beside them, carried on by these."""
    north, east, down = (np.nan_to_num(gnss[c]) for c in VELOCITY)
    out = gnss.copy()
    out["lat_deg"], out["lon_deg"], out["height_m"] = pymap3d.enu2geodetic(
        east * late, north * late, -down * late, gnss["lat_deg"], gnss["lon_deg"], gnss["height_m"]
    )
    return out
