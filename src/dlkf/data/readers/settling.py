"""What a mapping leaves to be found out (``auto``), settled from the drive itself."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.base.settings import is_number
from dlkf.data.dead_sensors import check_dead_axes
from dlkf.data.discovery.findings import Finding, Sure, discover, find_accel_unit, find_value
from dlkf.data.discovery.motion import find_motion
from dlkf.data.discovery.units import CLIMBS_ALIKE, compare_climbs, nearest_unit, speed_factor
from dlkf.data.limits import within_full_scale
from dlkf.data.readers import units, vocabulary
from dlkf.data.readers.contract import gnss_frame, imu_frame, positions
from dlkf.data.readers.mapping import Mapped
from dlkf.data.readers.sharing import read_value, set_value, write_value
from dlkf.data.schema import ACCEL, GYRO, stack_columns
from dlkf.data.spikes import find_spikes
from dlkf.data.tables import Columns
from dlkf.data.validate import MOST_REFUSED, check_time, usable_fixes

AUTO = "auto"
AXES = {"imu.accel.axes", "imu.gyro.axes"}
NEUTRAL: dict[str, Any] = {  # settings that may be auto, and what stands there until they are known
    **dict.fromkeys(("imu.accel.unit", "imu.gyro.unit", "gnss.velocity.unit"), 1.0),
    **dict.fromkeys(("gnss.velocity.climb_unit", "gnss.position.height_unit"), 1.0),
    **dict.fromkeys(AXES, "frd"),
    **dict.fromkeys(("imu.time.offset_s", "gnss.time.offset_s", "gnss.time.drift_ppm", "gnss.position.delay_s"), 0.0),
}
USUAL = {
    "imu.accel.unit": "m/s2 (or g)",
    "imu.gyro.unit": "rad/s (or deg/s)",
    "gnss.velocity.unit": "m/s (or km/h)",
    "gnss.time.drift_ppm": "0 (if both files have one clock)",
}
MOSTLY = 0.8  # of the fixes
FEWEST_FIXES = 3  # below, no finding has a spread
HIGHEST_M = 9000.0  # of a road
SURE_SCALE = 0.05  # 1σ of a unit by number that may be given so
METRIC = ("m/s", "cm/s", "mm/s")
MOST_TURN = (0.999, 10.0)  # share of the rates; rad/s that no car turns by
STATED_SIGMA = 5.0  # by which turns contradict a unit that a name states
LEAST_GRAVITY = 0.5  # of the mean force: the length of the mean; with gravity in it nearly 1


class Unsure(InputError):
    """What was left open cannot be estimated from a drive; others of the same IMU, with the same ``layout``, may do.

    ``offset_s`` and its 1σ are its own estimate of the clocks.
    """

    layout: str = ""
    offset_s: tuple[float, float] = (math.nan, math.nan)


def open_settings(specs: Mapping[str, Any], lever_arm_m: Any) -> set[str]:
    """Settings that are ``auto``."""
    wanted = {name for name in NEUTRAL if read_value(specs, name) == AUTO}
    return wanted | ({"lever_arm_m"} if lever_arm_m == AUTO else set())


def placeholders(specs: Mapping[str, Any]) -> dict[str, Any]:
    """The specs with neutral values for every ``auto``."""
    out = _plain(specs)
    for name, value in NEUTRAL.items():
        if read_value(out, name) == AUTO:
            set_value(out, name, value)
    return out


def settle(
    mapped: Mapping[str, Mapped], t: Mapping[str, np.ndarray], wanted: set[str], sure: Sure, where: str, arm: Any
) -> tuple[dict[str, Any], tuple[float, float, float], list[str]]:
    """Find out what is wanted of a drive, its tables mapped with neutral values: specs without ``auto``, the lever arm,
    a line per finding.

    ``t`` are the stamps of the tables. InputError where an answer is not sure.
    """
    specs = {kind: _plain(part.spec) for kind, part in mapped.items()}
    if "gnss" not in mapped and wanted == {"imu.accel.unit"}:
        finding, _ = find_accel_unit(stack_columns(imu_frame(mapped["imu"], t["imu"]), ACCEL), increments=False)
        _refuse_doubt([finding], wanted, where, t)
        set_value(specs, "imu.accel.unit", finding.value)
        return specs, arm, _describe_findings([finding], wanted)
    if "gnss" not in mapped:
        raise InputError(f"{where}: reader.{sorted(wanted)[0]}=auto needs GNSS to compare with; give the value")
    if (count := len(t["gnss"])) < FEWEST_FIXES:
        log = mapped["gnss"].table
        why = "".join(f"; {note}" for note in log.notes)
        raise InputError(
            f"{where}: {log.path} has {count} {'fix' if count == 1 else 'fixes'}, which are not the "
            f"motion of a car{why}; copy the log again, or leave the drive out"
        )
    for kind in ("imu", "gnss"):
        check_time(t[kind], f"{where}, {mapped[kind].table.path.name}", kind, mapped[kind].name_row)
    found: list[Finding] = []
    if "gnss.velocity.unit" in wanted:
        found.append(_speed_unit(mapped["gnss"], t["gnss"]))
        _refuse_doubt(found, wanted, where, t)
        specs["gnss"]["velocity"]["unit"] = found[0].value
    imu = _leave_out_damage(imu_frame(mapped["imu"], t["imu"]), wanted, bool(mapped["imu"].spec.get("increments")))
    if "imu.accel.unit" in wanted:
        _refuse_without_gravity(imu, where)
    gnss = gnss_frame(replace(mapped["gnss"], spec=specs["gnss"]), t["gnss"])
    metre, climb_known = 1.0, "gnss.velocity.climb_unit" not in wanted
    if "gnss.position.height_unit" in wanted:
        found.append(_height_unit(gnss, climb_known))
        metre = units.LENGTH[found[-1].value]
    if not climb_known:
        found.append(_climb_unit(gnss, metre, specs["gnss"]["velocity"].get("unit")))
        gnss["vel_d"] *= units.factor(found[-1].value, units.SPEED, "reader.gnss.velocity.climb_unit")
    samples, fixes = _keep_rising(imu), _keep_rising(gnss[usable_fixes(gnss)])
    check_dead_axes(samples, find_motion(fixes), f"{where}, {mapped['imu'].table.path.name}", frd=False)
    found += discover(
        samples,
        fixes,
        wanted | ({"imu.axes"} if AXES & wanted else set()),
        sure,
        increments=bool(mapped["imu"].spec.get("increments")),
        drift_given="gnss.time.drift_ppm" not in wanted and read_value(specs, "gnss.time.drift_ppm") is not None,
    )
    found = [_take_stated_unit(one, mapped["imu"].spec) for one in found]
    _refuse_doubt(found, wanted, where, t)
    for name in wanted & set(NEUTRAL):
        value = copy.deepcopy(find_value(found, "imu.axes" if name.endswith("axes") else name))
        if value is not None:
            set_value(specs, name, value)
    lever = find_value(found, "lever_arm_m") if "lever_arm_m" in wanted else arm
    x, y, z = (float(a) for a in lever)
    return specs, (x, y, z), _describe_findings(found, wanted)


def _take_stated_unit(finding: Finding, imu: Mapping[str, Any]) -> Finding:
    """The gyroscopes' unit in the names of their columns, where the turns leave it open and do not contradict."""
    stated = vocabulary.find_unit(str((imu["gyro"].get("columns") or [""])[0]))
    if finding.setting != "imu.gyro.unit" or finding.sure or imu.get("increments") or stated not in units.RATE:
        return finding
    if is_number(finding.value) and abs(finding.value - units.RATE[stated]) > STATED_SIGMA * finding.std:
        return finding
    return Finding(finding.setting, stated, True, f"as the columns' names state; {finding.detail}")


def _leave_out_damage(imu: pd.DataFrame, wanted: set[str], increments: bool) -> pd.DataFrame:
    """The samples without those beyond full scale and spikes, where they are few, as loading leaves them out.

    A unit that is not known yet is about that of gravity, and of the gyroscopes °/s where they turn by more than
    ``MOST_TURN``.
    """
    accel, gyro = (stack_columns(imu, names) for names in (ACCEL, GYRO))
    accel = accel * (find_accel_unit(accel, increments)[1] if "imu.accel.unit" in wanted else 1.0)
    in_degrees = "imu.gyro.unit" in wanted and np.quantile(np.abs(gyro), MOST_TURN[0]) > MOST_TURN[1]
    gyro = gyro * (units.DEG if in_degrees else 1.0)
    keep = np.flatnonzero(within_full_scale(accel, gyro))
    keep = np.delete(keep, find_spikes([*accel[keep].T, *gyro[keep].T]))
    few = len(imu) - len(keep) <= max(MOST_REFUSED[0] * len(imu), 2)
    return imu.iloc[keep] if few else imu


def _refuse_without_gravity(imu: pd.DataFrame, where: str) -> None:
    """InputError for accelerations from which gravity was taken: they point everywhere, and have no mean."""
    force = imu[list(ACCEL)].to_numpy()
    if np.linalg.norm(force.mean(0)) < LEAST_GRAVITY * np.linalg.norm(force, axis=-1).mean():
        raise InputError(
            f"{where}: there is no gravity in the accelerations (linear acceleration?); give those of the accelerometer"
        )


def _keep_rising(frame: pd.DataFrame) -> Columns:
    """The columns of the rows that are later than the row before."""
    rows = frame[np.diff(frame["t"], prepend=-np.inf) > 0]
    return {str(name): rows[name].to_numpy() for name in rows}


def _speed_unit(gnss: Mapped, t: np.ndarray) -> Finding:
    v = gnss.vector("velocity", (2, 3), nan=True) if gnss.has("velocity") else np.full((1, 3), np.nan)
    if not np.isfinite(v).any():
        return Finding("gnss.velocity.unit", "m/s", True, "no velocities")
    speed = v[:, 0] if gnss.spec["velocity"].get("frame") == "course" else np.hypot(v[:, 0], v[:, 1])
    place = positions(gnss)
    finding = _unit_by_way(t, place["lat_deg"], place["lon_deg"], speed)
    if not finding.sure and _unit_by_way(t, place["lon_deg"], place["lat_deg"], speed).sure:
        remedy = "latitude and longitude look swapped: exchange them in reader.gnss.position.columns"
        return replace(finding, value=None, remedy=remedy)
    return finding


def _height_unit(gnss: pd.DataFrame, climb_known: bool) -> Finding:
    """By a vertical velocity of known unit; without one metres, but mm as u-blox has them where no road is as high."""
    setting, heights = "gnss.position.height_unit", gnss["height_m"].to_numpy()
    climb = compare_climbs(*(gnss[name].to_numpy() for name in ("t", "height_m", "vel_d"))) if climb_known else None
    unit = None if climb is None else nearest_unit(1 / climb.slope, climb.std / climb.slope**2, units.LENGTH)
    if unit is not None and climb is not None:
        return Finding(setting, unit, True, f"they change {climb.slope:.3g} ± {climb.std:.1g} times as vel_d says")
    size = float(np.nanmedian(np.abs(heights)))
    if size > HIGHEST_M:
        return Finding(setting, "mm", True, f"{size:.0f} in the median, as u-blox has them; no vel_d tells")
    return Finding(setting, "m", True, "no vel_d tells another unit")


def _climb_unit(gnss: pd.DataFrame, metre: float, speed_unit: Any) -> Finding:
    """The unit of the speed or m/s, whichever agrees with the heights of ``metre`` m; m/s where these do not tell."""
    t, height, down = (gnss[name].to_numpy() for name in ("t", "height_m", "vel_d"))
    climb = compare_climbs(t, metre * height, down)
    setting, usual = "gnss.velocity.climb_unit", speed_unit if speed_unit in METRIC else "m/s"
    if climb is None or climb.slope <= 0 or climb.alike < CLIMBS_ALIKE:
        return Finding(setting, usual, True, "no heights tell another unit")
    size = climb.slope / climb.alike  # noise of the climb makes the slope less
    factors = {unit: units.factor(unit, units.SPEED, setting) for unit in ("m/s", speed_unit or "m/s")}
    best = min(factors, key=lambda unit: abs(np.log(size / factors[unit])))
    return Finding(setting, best, True, f"heights change {climb.slope:.3g} ± {climb.std:.1g} m per unit and second")


def _unit_by_way(t: np.ndarray, lat_deg: np.ndarray, lon_deg: np.ndarray, speed: np.ndarray) -> Finding:
    factor, spread = speed_factor(t, lat_deg, lon_deg, speed)
    apart = {name: abs(np.log(factor / f)) if factor > 0 else np.inf for name, f in units.SPEED.items()}
    best = min(apart, key=lambda name: apart[name])
    certain = apart[best] < 0.08 and spread < 0.2 * factor
    detail = f"positions move {factor:.3g} ± {spread:.1g} m per unit" if factor > 0 else "the car hardly moves"
    return Finding("gnss.velocity.unit", best, bool(certain), detail)


def _refuse_doubt(found: list[Finding], wanted: set[str], where: str, t: Mapping[str, np.ndarray]) -> None:
    doubts = [one for one in found if not one.sure]
    if not doubts:
        return
    doubt = doubts[0]
    offsets = [(float(one.value), one.std) for one in found if "offset_s" in one.setting and one.value is not None]
    setting = doubt.setting.replace("imu.axes", "imu.accel.axes and .gyro.axes")
    poor = doubt.setting.endswith(("offset_s", "axes")) and not doubt.wide  # no more than a guess of noise
    best = "" if doubt.value is None or poor else f"; the best guess is {write_value(doubt.value)}"
    if doubt.setting.endswith("drift_ppm") and doubt.setting not in wanted:
        raise InputError(
            f"{where}: the clocks drift apart, {write_value(doubt.value)} {doubt.detail}; reader.{setting}=auto"
        )
    remedy = f"give {_describe_by_hand(doubts, wanted, t)}, or a longer drive, with turns, starts and stops"
    if doubt.remedy:
        remedy = doubt.remedy
    elif all(one.wide for one in doubts):
        remedy = f"give it, or a longer drive, or take it as it is: {' '.join(one.wide for one in doubts)}"
    unsure = Unsure(f"{where}: not sure of reader.{setting} ({doubt.detail}){best}; {remedy}")
    unsure.offset_s = offsets[0] if offsets else unsure.offset_s
    raise unsure


def _describe_by_hand(doubts: list[Finding], wanted: set[str], t: Mapping[str, np.ndarray]) -> str:
    """The settings of everything in doubt, with their usual values and when these are right."""
    said = []
    for doubt in doubts:
        setting = doubt.setting
        if setting.endswith("offset_s"):
            within = (t["gnss"] >= t["imu"][0]) & (t["gnss"] <= t["imu"][-1])
            overlap = np.mean(within) > MOSTLY
            value = "0 (if both files have one clock)" if overlap else "… (seconds to be added to its stamps)"
            said.append(f"reader.{setting}={value}")
        elif setting == "imu.axes":
            names = sorted(wanted & AXES)
            said.append(f"{' '.join(f'reader.{name}=frd' for name in names)} (if x is forward, y right, z down)")
        elif is_number(doubt.value) and not doubt.std > SURE_SCALE * doubt.value:
            said.append(f"reader.{setting}={doubt.value}")  # counts, or g of a scale of its own
        else:
            said.append(f"reader.{setting}={USUAL.get(setting, '…')}")
    return " ".join(said)


def _describe_findings(found: list[Finding], wanted: set[str]) -> list[str]:
    """A line per setting."""
    out = []
    for one in found:
        names = sorted(wanted & AXES) if one.setting == "imu.axes" else [one.setting]
        details = (one.detail, "the same")
        out += [f"found reader.{name}={write_value(one.value)}  ({why})" for name, why in zip(names, details)]
    return out


def _plain(spec: Any) -> Any:
    if isinstance(spec, Mapping):
        return {key: _plain(value) for key, value in spec.items()}
    return [_plain(x) for x in spec] if isinstance(spec, (list, tuple)) else spec
