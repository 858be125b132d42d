"""Units, pose, clock offset, delays and lever arm of a log, estimated from a drive, each with its 1σ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dlkf.base.settings import Ranged
from dlkf.data.discovery.clock import ImuSums, Lag, describe_offset, find_lag
from dlkf.data.discovery.drift import compare_ends, ends_std, find_drifting_pose, find_step, middle
from dlkf.data.discovery.motion import MOVING, Floats, Motion, find_motion, position_delay
from dlkf.data.discovery.orientation import Pose
from dlkf.data.discovery.units import accel_units, nearest_unit, unit_left
from dlkf.data.readers.units import ACCELERATION, RATE
from dlkf.data.schema import ACCEL, GYRO, stack_columns
from dlkf.data.tables import Columns
from dlkf.navigation.earth import STANDARD_GRAVITY as G

LEAST_EXPLAINED, AGREE = 0.8, (0.8, 1.25)
FARTHEST_DOWN = math.radians(6.0)


@dataclass(frozen=True)
class Sure(Ranged, where="reader.sure", least=0, greatest=1e6):
    """What is sure enough: 2.5σ of the pose [deg] and of the clock offset at the drive's ends [s] lie below."""

    angle_deg: float = 2.0
    time_s: float = 0.025


@dataclass(frozen=True)
class Finding:
    """A ``setting`` of the reader with its value; ``detail`` are the numbers behind it, ``wide`` would be sure enough,
    ``remedy`` is what else mends it, ``std`` the 1σ of a number."""

    setting: str
    value: Any
    sure: bool
    detail: str
    wide: str = ""
    remedy: str = ""
    std: float = math.nan


def find_value(found: Sequence[Finding], setting: str) -> Any:
    """The value of a setting, None if it was not looked for or not found."""
    return next((f.value for f in found if f.setting == setting), None)


def find_accel_unit(accel: Floats, increments: bool) -> tuple[Finding, float]:
    """The accelerometers' unit by gravity, and its m/s²; of ``increments`` any number is sure."""
    size = float(np.median(np.linalg.norm(accel, axis=-1)))
    names = accel_units(size, ACCELERATION)
    unit = names[0] if len(names) == 1 else None
    factor = ACCELERATION[unit] if unit else G / max(size, 1e-9)
    taken = "" if unit else f": {' or '.join(names) or 'no known unit'}, so a number by gravity"
    certain = size > 0 and (len(names) > 0 or increments)
    value = unit or (float(f"{factor:.5g}") if size > 0 else None)
    return Finding("imu.accel.unit", value, certain, f"median force {size:.4g}{taken}"), factor


def discover(
    imu: Columns,
    gnss: Columns,
    wanted: set[str],
    sure: Sure = Sure(),
    *,
    increments: bool = False,
    drift_given: bool = False,
) -> list[Finding]:
    """Find the settings in ``wanted`` (as ``imu.accel.unit``, ``imu.axes``, ``time.offset_s``, ``lever_arm_m``, …).

    ``imu`` is a table of the contract in the sensor's own axes, and of accelerations or rates whose unit is wanted in
    that unit; ``gnss`` one of usable fixes. With ``drift_given`` the stamps have the clocks' drift taken out: a rest of
    it does not count as doubtful.
    """
    out: list[Finding] = []
    t, accel, gyro = imu["t"], stack_columns(imu, ACCEL), stack_columns(imu, GYRO)
    factor = 1.0
    if "imu.accel.unit" in wanted:
        finding, factor = find_accel_unit(accel, increments)
        out.append(finding)
    moved = find_motion(gnss)
    away = "imu.time.offset_s" in wanted or "gnss.time.offset_s" in wanted
    lag = find_lag(ImuSums.of(t, accel, gyro), moved, None if away else 2.0)
    if "imu.accel.unit" in wanted:  # some devices give the reaction's opposite
        other = find_lag(ImuSums.of(t, -accel, gyro), moved, None if away else 2.0)
        if other is not None and (lag is None or other.gain > 1.5 * lag.gain) and other.yaw > 0.7:
            lag, factor = other, -factor
            out[0] = replace(out[0], value=factor, sure=True, detail=out[0].detail + ", its sign turned round")
    if lag is not None and away and _is_mirrored(t, accel, gyro, lag, moved):
        detail = f"turns agree to {lag.yaw:.2f}, accelerations to {lag.force:.2f}, well with the y axis turned round"
        remedy = "give it as the sensor's axis that counts the other way (x, y or z), the gyroscope's too if need be"
        seen = f"the axes seem left-handed: {detail}"
        return [*out, Finding("imu.accel.mirror", "y", False, seen, remedy=remedy)]
    if lag is not None and away and (step := _clock_step(t - lag.lag_s, accel, gyro, moved, wanted)) is not None:
        return [*out, step]
    pose = None
    if lag is not None:
        pose = find_drifting_pose(t, accel * factor, gyro, moved, lag.lag_s)
    if "imu.gyro.unit" in wanted:
        out.append(_gyro_unit(gyro, pose, increments))
    sound = pose is not None and pose.explained > LEAST_EXPLAINED and AGREE[0] < pose.scale < AGREE[1]
    sound = sound and not (pose is not None and pose.down_apart > FARTHEST_DOWN)
    # of the first fix, the middle that the pose's lag is of
    before_s = middle(moved) - float(gnss["t"][0]) if len(gnss["t"]) else 0.0
    if away or "gnss.time.drift_ppm" in wanted:
        if drift_given and pose is not None:
            pose = replace(pose, doubt=0.0)
        out += _drift(pose if sound else None, wanted, sure, before_s)
    if away:
        out.append(_offset(lag, pose if sound else None, wanted, sure, before_s))
    if "imu.axes" in wanted:
        out.append(_axes(pose, bool(sound) and lag is not None and lag.clear, moved, sure))
    if "lever_arm_m" in wanted:
        out.append(_arm(pose if sound else None))
    if "gnss.position.delay_s" in wanted:
        out.append(_delay(gnss))
    return out


def _is_mirrored(t: Floats, accel: Floats, gyro: Floats, lag: Lag, gnss: Motion) -> bool:
    """Whether accelerations agree with GNSS where the turns do only in a left-handed triad."""
    if lag.yaw < 0.8 or lag.force > 0.9:
        return False
    other = find_lag(ImuSums.of(t, accel * [1.0, -1.0, 1.0], gyro), gnss)
    return other is not None and 1 - other.force < 0.5 * (1 - lag.force) and other.gain > 1.1 * lag.gain


def _clock_step(t: Floats, accel: Floats, gyro: Floats, gnss: Motion, wanted: set[str]) -> Finding | None:
    """A clock that was set during the drive: no offset is right, nor any drift."""
    sums = ImuSums.of(t, accel, gyro)
    ends = compare_ends(sums, gnss)
    at = None if ends is None else find_step(sums, gnss, ends)
    if ends is None or at is None:
        return None
    size, first, last = abs(ends.last_s - ends.first_s), *(time - gnss.t[0] for time in at)
    detail = f"a clock steps by {size:.1f} s, {first:.0f} to {last:.0f} s after the first fix"
    setting = next(name for name in sorted(wanted) if name.endswith("offset_s"))
    return Finding(setting, None, False, detail, remedy="make two drives of it there")


def _gyro_unit(gyro: Floats, pose: Pose | None, increments: bool) -> Finding:
    setting = "imu.gyro.unit"
    if pose is None:
        return Finding(setting, None, False, "no turn to compare with the course")
    scale, std = pose.gyro_scale, pose.gyro_scale_std
    detail = f"{scale:.4g} ± {abs(std):.1g} rad per unit of {np.degrees(pose.turned):.0f}° of turns"
    if scale <= 0:
        return Finding(setting, None, False, f"{detail}, which noise alone gives")
    unit = nearest_unit(scale, std, RATE)
    if unit is None:
        shaking = float(np.sqrt(np.mean(np.var(gyro, axis=0))))
        unit = unit_left(scale, std, shaking, RATE)
        if unit is not None:
            detail += f"; no other is near, or gives it the vibration of cars ({shaking * RATE[unit]:.2g} rad/s)"
    counted = unit is None and increments and std < 0.01 * scale
    return Finding(setting, unit or float(f"{scale:.6g}"), unit is not None or counted, detail, std=std)


def _drift(pose: Pose | None, wanted: set[str], sure: Sure, reach_s: float) -> list[Finding]:
    """How much faster the IMU's clock runs; a drift that nobody asked for is no answer, nor is one that may be there
    and would make the offset wrong ``reach_s`` from the drive's middle."""
    setting = "gnss.time.drift_ppm"
    if pose is not None and abs(pose.doubt) * reach_s > sure.time_s:
        detail = f"± {1e6 * abs(pose.drift_std):.0f} ppm: {1000 * abs(pose.doubt) * reach_s:.0f} ms at the drive's ends"
        return [Finding(setting, round(1e6 * pose.doubt, 1), False, detail)]
    if pose is None or not pose.drift:
        seen = "" if pose is None or math.isnan(pose.drift_std) else f", ± {1e6 * pose.drift_std:.0f} ppm"
        return [Finding(setting, 0.0, True, f"none to be seen{seen}")] if setting in wanted else []
    faster = "faster" if pose.drift > 0 else "slower"
    detail = f"± {1e6 * pose.drift_std:.0f} ppm: the clock of the IMU runs {faster} than that of GNSS"
    return [Finding(setting, round(1e6 * pose.drift, 1), setting in wanted, detail)]


def _offset(lag: Lag | None, pose: Pose | None, wanted: set[str], sure: Sure, before_s: float) -> Finding:
    """The offset of the first fix, ``before_s`` before the middle that the pose's lag is of."""
    setting = "gnss.time.offset_s" if "gnss.time.offset_s" in wanted else "imu.time.offset_s"
    sign = 1.0 if setting.startswith("gnss") else -1.0
    if lag is None or lag.gain <= 0.0:
        return Finding(setting, None, False, "too little motion in the time that both logs have")
    peak = (
        f"turns agree to {lag.yaw:.2f}, accelerations to {lag.force:.2f}, of 1; the next best offset fits "
        f"{100 * lag.rival / lag.gain:.0f} % as well"
    )
    if pose is None:
        return Finding(setting, round(sign * lag.lag_s, 1), False, peak)
    at_ends = ends_std(pose, before_s)
    certain = lag.clear and 2.5 * at_ends <= sure.time_s
    hardly = abs(pose.lag_s) < max(3 * pose.lag_std, 0.01) and abs(pose.lag_s) < 0.05
    value = 0.0 if hardly and not pose.drift else pose.lag_s - pose.drift * before_s
    detail = (
        f"{sign * pose.lag_s:+.3f} ± {pose.lag_std:.3f} s in the middle of the drive, ± {at_ends:.3f} at its ends, "
        f"a delay of GNSS's velocities included; {peak}{describe_offset(pose.lag_s)}"
    )
    wide = f"reader.sure.time_s={math.ceil(250 * at_ends + 1) / 100:g}" if lag.clear else ""
    return Finding(setting, round(sign * value, 4), certain, detail, wide, std=at_ends)


def _axes(pose: Pose | None, sound: bool, gnss: Motion, sure: Sure) -> Finding:
    from scipy.spatial.transform import Rotation

    if pose is None:
        moved = float(np.mean(gnss.speed > MOVING)) if len(gnss.t) else 0.0
        seen = f"{100 * moved:.0f} % of {len(gnss.t)} fixes above 2 m/s"
        return Finding("imu.axes", None, False, f"too little motion: {seen}")
    yaw, pitch, roll = Rotation.from_matrix(pose.matrix).as_euler("ZYX", degrees=True)
    value = {"roll": round(float(roll), 2), "pitch": round(float(pitch), 2), "yaw": round(float(yaw), 2)}
    limit = math.radians(sure.angle_deg)
    certain = sound and 2.5 * pose.yaw_std <= limit and 2.5 * pose.tilt_std <= limit
    detail = (
        f"± {math.degrees(pose.yaw_std):.1f}° about the vertical, ± {math.degrees(pose.tilt_std):.1f}° level; "
        f"accelerations {pose.scale:.2f} of those of GNSS, {100 * pose.explained:.0f} % explained"
    )
    if not math.isnan(pose.down_apart):
        detail += f"; down by gravity and by the turns {math.degrees(pose.down_apart):.1f}° apart"
    wide = f"reader.sure.angle_deg={math.ceil(2.5 * math.degrees(max(pose.yaw_std, pose.tilt_std)) + 0.1):d}"
    return Finding("imu.axes", value, certain, detail, wide if sound else "")


def _arm(pose: Pose | None) -> Finding:
    """The horizontal lever arm, where it is observable to 0.3 m (1σ); else zero, with a line."""
    if pose is None or pose.lever_arm_std > 0.3:
        seen = "not at all" if pose is None else f"only to {pose.lever_arm_std:.1f} m"
        return Finding("lever_arm_m", [0.0, 0.0, 0.0], True, f"observable {seen}: zero kept, measure it")
    value = [round(pose.lever_arm.real, 2), round(pose.lever_arm.imag, 2), 0.0]
    return Finding(
        "lever_arm_m", value, True, f"± {pose.lever_arm_std:.2f} m; the height is not observable, measure it"
    )


def _delay(gnss: Columns) -> Finding:
    setting = "gnss.position.delay_s"
    late, std = position_delay(gnss)
    if math.isnan(late) or std > 0.03 or abs(late) < max(3 * std, 0.02):
        seen = "cannot be seen" if math.isnan(late) else f"{late:+.3f} ± {std:.3f} s"
        return Finding(setting, 0.0, True, f"{seen}: none taken")
    return Finding(setting, round(late, 3), True, f"± {std:.3f} s, against the velocities")
