"""Units, pose, clock offset, delays and lever arm of a log, estimated from a drive, each with its 1σ."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dlkf.base.settings import Ranged
from dlkf.data.discovery.clock import ImuSums, Lag, find_lag, known_offset
from dlkf.data.discovery.drift import ends_std, find_drifting_pose, middle
from dlkf.data.discovery.motion import MOVING, Floats, Motion, motion, position_delay
from dlkf.data.discovery.orientation import Pose
from dlkf.data.discovery.units import accel_units, nearest_unit, unit_left
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


@dataclass
class Findings:
    """All findings of a drive."""

    found: list[Finding] = field(default_factory=list)

    def add(
        self, setting: str, value: Any, sure: bool, detail: str, wide: str = "", remedy: str = "", std: float = math.nan
    ) -> None:
        """One more."""
        self.found.append(Finding(setting, value, sure, detail, wide, remedy, std))

    def get(self, setting: str) -> Any:
        """The value of a setting, None if it was not looked for or not found."""
        return next((f.value for f in self.found if f.setting == setting), None)

    def doubtful(self) -> list[Finding]:
        """Those that are not sure."""
        return [f for f in self.found if not f.sure]


@dataclass(frozen=True)
class Raw:
    """A drive in its sensor's axes: accelerations and rates times ``accel_factor`` and ``gyro_factor`` are SI.

    A factor is None where the unit is not known. Times of both tables [s]; positions [deg], velocities NED [m/s].
    """

    t: Floats
    accel: Floats
    gyro: Floats
    accel_factor: float | None
    gyro_factor: float | None
    gnss_t: Floats
    lat_deg: Floats
    lon_deg: Floats
    v_ned: Floats


def discover(
    raw: Raw,
    wanted: set[str],
    sure: Sure = Sure(),
    *,
    known_accel: Mapping[str, float],
    known_gyro: Mapping[str, float],
    increments: bool = False,
    drift_given: bool = False,
) -> Findings:
    """Find the settings in ``wanted`` (as ``imu.accel.unit``, ``imu.axes``, ``time.offset_s``, ``lever_arm_m``, …).

    With ``drift_given`` the stamps have the clocks' drift taken out: a rest of it does not count as doubtful.
    """
    out = Findings()
    size = float(np.median(np.linalg.norm(raw.accel, axis=-1)))
    factor = raw.accel_factor
    if factor is None:
        names = accel_units(size, known_accel)
        unit = names[0] if len(names) == 1 else None
        factor = known_accel[unit] if unit else G / size
        taken = "" if unit else f": {' or '.join(names) or 'no known unit'}, so a number by gravity"
        certain = size > 0 and (len(names) > 0 or increments)
        out.add("imu.accel.unit", unit or float(f"{factor:.5g}"), certain, f"median force {size:.4g}{taken}")
    gnss = motion(raw.gnss_t, raw.lat_deg, raw.lon_deg, raw.v_ned)
    away = "imu.time.offset_s" in wanted or "gnss.time.offset_s" in wanted
    lag = find_lag(ImuSums.of(raw.t, raw.accel, raw.gyro), gnss, None if away else 2.0)
    if raw.accel_factor is None:  # some devices give the reaction's opposite
        other = find_lag(ImuSums.of(raw.t, -raw.accel, raw.gyro), gnss, None if away else 2.0)
        if other is not None and (lag is None or other.gain > 1.5 * lag.gain) and other.yaw > 0.7:
            lag, factor = other, -factor
            out.found[0] = Finding("imu.accel.unit", factor, True, out.found[0].detail + ", its sign turned round")
    if lag is not None and away and _is_mirrored(raw, lag, gnss):
        detail = f"turns agree to {lag.yaw:.2f}, accelerations to {lag.force:.2f}, well with the y axis turned round"
        remedy = "give it as the sensor's axis that counts the other way (x, y or z), the gyroscope's too if need be"
        out.add("imu.accel.mirror", "y", False, f"the axes seem left-handed: {detail}", remedy=remedy)
        return out
    pose = None
    if lag is not None:
        pose = find_drifting_pose(raw.t, raw.accel * factor, raw.gyro, gnss, lag.lag_s)
    _gyro_unit(out, raw, pose, known_gyro, increments)
    sound = pose is not None and pose.explained > LEAST_EXPLAINED and AGREE[0] < pose.scale < AGREE[1]
    sound = sound and not (pose is not None and pose.down_apart > FARTHEST_DOWN)
    if away or "gnss.time.drift_ppm" in wanted:
        if drift_given and pose is not None:
            pose = replace(pose, doubt=0.0)
        _drift(out, pose if sound else None, wanted, sure, middle(gnss) - float(raw.gnss_t[0]))
    if away:
        _offset(out, lag, pose if sound else None, wanted, sure, middle(gnss) - float(raw.gnss_t[0]))
    if "imu.axes" in wanted:
        _axes(out, pose, bool(sound) and lag is not None and lag.clear, gnss, sure)
    if "lever_arm_m" in wanted:
        _arm(out, pose if sound else None)
    if "gnss.position.delay_s" in wanted:
        _delay(out, raw)
    return out


def _is_mirrored(raw: Raw, lag: Lag, gnss: Motion) -> bool:
    """Whether accelerations agree with GNSS where the turns do only in a left-handed triad."""
    if lag.yaw < 0.8 or lag.force > 0.9:
        return False
    other = find_lag(ImuSums.of(raw.t, raw.accel * [1.0, -1.0, 1.0], raw.gyro), gnss)
    return other is not None and 1 - other.force < 0.5 * (1 - lag.force) and other.gain > 1.1 * lag.gain


def _gyro_unit(out: Findings, raw: Raw, pose: Pose | None, known: Mapping[str, float], increments: bool) -> None:
    if raw.gyro_factor is not None:
        return
    if pose is None:
        out.add("imu.gyro.unit", None, False, "no turn to compare with the course")
        return
    spread, turned = abs(pose.gyro_scale_std), np.degrees(pose.turned)
    detail = f"{pose.gyro_scale:.4g} ± {spread:.1g} rad per unit of {turned:.0f}° of turns"
    if pose.gyro_scale <= 0:
        out.add("imu.gyro.unit", None, False, f"{detail}, which noise alone gives")
        return
    unit = nearest_unit(pose.gyro_scale, pose.gyro_scale_std, known)
    if unit is None:
        shaking = float(np.sqrt(np.mean(np.var(raw.gyro, axis=0))))
        unit = unit_left(pose.gyro_scale, pose.gyro_scale_std, shaking, known)
        if unit is not None:
            detail += f"; no other is near, or gives it the vibration of cars ({shaking * known[unit]:.2g} rad/s)"
    counted = unit is None and increments and pose.gyro_scale_std < 0.01 * pose.gyro_scale
    out.add("imu.gyro.unit", unit or float(f"{pose.gyro_scale:.6g}"), unit is not None or counted, detail)


def _drift(out: Findings, pose: Pose | None, wanted: set[str], sure: Sure, reach_s: float) -> None:
    """How much faster the IMU's clock runs; a drift that nobody asked for is no answer, nor is one that may be there
    and would make the offset wrong ``reach_s`` from the drive's middle."""
    setting = "gnss.time.drift_ppm"
    if pose is not None and abs(pose.doubt) * reach_s > sure.time_s:
        detail = f"± {1e6 * abs(pose.drift_std):.0f} ppm: {1000 * abs(pose.doubt) * reach_s:.0f} ms at the drive's ends"
        out.add(setting, round(1e6 * pose.doubt, 1), False, detail)
        return
    if pose is None or not pose.drift:
        if setting in wanted:
            seen = "" if pose is None or math.isnan(pose.drift_std) else f", ± {1e6 * pose.drift_std:.0f} ppm"
            out.add(setting, 0.0, True, f"none to be seen{seen}")
        return
    faster = "faster" if pose.drift > 0 else "slower"
    detail = f"± {1e6 * pose.drift_std:.0f} ppm: the clock of the IMU runs {faster} than that of GNSS"
    out.add(setting, round(1e6 * pose.drift, 1), setting in wanted, detail)


def _offset(out: Findings, lag: Lag | None, pose: Pose | None, wanted: set[str], sure: Sure, before_s: float) -> None:
    """The offset of the first fix, ``before_s`` before the middle that the pose's lag is of."""
    setting = "gnss.time.offset_s" if "gnss.time.offset_s" in wanted else "imu.time.offset_s"
    sign = 1.0 if setting.startswith("gnss") else -1.0
    if lag is None or pose is None:
        value = None if lag is None else round(sign * lag.lag_s, 1)
        out.add(
            setting, value, False, "too little motion in the time that both logs have" if lag is None else _peak(lag)
        )
        return
    at_ends = ends_std(pose, before_s)
    certain = lag.clear and 2.5 * at_ends <= sure.time_s
    hardly = abs(pose.lag_s) < max(3 * pose.lag_std, 0.01) and abs(pose.lag_s) < 0.05
    value = 0.0 if hardly and not pose.drift else pose.lag_s - pose.drift * before_s
    detail = (
        f"{sign * pose.lag_s:+.3f} ± {pose.lag_std:.3f} s in the middle of the drive, ± {at_ends:.3f} at its ends, "
    )
    detail += f"a delay of GNSS's velocities included; {_peak(lag)}"
    wide = f"reader.sure.time_s={math.ceil(250 * at_ends + 1) / 100:g}" if lag.clear else ""
    out.add(setting, round(sign * value, 4), certain, detail + known_offset(pose.lag_s), wide, std=at_ends)


def _peak(lag: Lag) -> str:
    return (
        f"turns agree to {lag.yaw:.2f}, accelerations to {lag.force:.2f}, of 1; the next best offset fits "
        f"{100 * lag.rival / lag.gain:.0f} % as well"
    )


def _axes(out: Findings, pose: Pose | None, sound: bool, gnss: Motion, sure: Sure) -> None:
    from scipy.spatial.transform import Rotation

    if pose is None:
        moved = float(np.mean(gnss.speed > MOVING)) if len(gnss.t) else 0.0
        out.add("imu.axes", None, False, f"too little motion: {100 * moved:.0f} % of {len(gnss.t)} fixes above 2 m/s")
        return
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
    out.add("imu.axes", value, certain, detail, wide if sound else "")


def _arm(out: Findings, pose: Pose | None) -> None:
    """The horizontal lever arm, where it is observable to 0.3 m (1σ); else zero, with a line."""
    if pose is None or pose.lever_arm_std > 0.3:
        seen = "not at all" if pose is None else f"only to {pose.lever_arm_std:.1f} m"
        out.add("lever_arm_m", [0.0, 0.0, 0.0], True, f"can be seen {seen}: zero kept, measure it")
        return
    value = [round(pose.lever_arm.real, 2), round(pose.lever_arm.imag, 2), 0.0]
    out.add("lever_arm_m", value, True, f"± {pose.lever_arm_std:.2f} m; the height cannot be seen, measure it")


def _delay(out: Findings, raw: Raw) -> None:
    late, std = position_delay(raw.gnss_t, raw.lat_deg, raw.lon_deg, raw.v_ned)
    if math.isnan(late) or std > 0.03 or abs(late) < max(3 * std, 0.02):
        seen = "cannot be seen" if math.isnan(late) else f"{late:+.3f} ± {std:.3f} s"
        out.add("gnss.position.delay_s", 0.0, True, f"{seen}: none taken")
        return
    out.add("gnss.position.delay_s", round(late, 3), True, f"± {std:.3f} s, against the velocities")
