"""Plausibility of a reference: the place, the height and the heading of the same drive, in the same units and axes.

As in :mod:`dlkf.data.plausibility` each check compares with other data of the drive.
"""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import circular_median, wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.discovery.clock import ImuSums, describe_offset, find_lag
from dlkf.data.discovery.motion import find_motion
from dlkf.data.limits import DEGREE_M
from dlkf.data.plausibility import APART_S, TURNED_DEG
from dlkf.data.schema import ATTITUDE
from dlkf.data.tables import Columns

SAME_S = 1.0  # between a fix and a row of the reference that are compared
REFERENCE_M, HEIGHT_M, SIGMAS = 30.0, 20.0, 5.0  # beyond the receiver's own 1σ: no antenna and no datum is so far off
GEOID_M, STEADY_M = 110.0, 5.0  # the geoid lies no further from the ellipsoid, and is flat over a drive
ARM_M, SINGLE_M, DELAY_S = 3.0, 3.5, 0.5  # of a car's antenna, 1σ of a fix that tells none; a receiver is no later
SEARCH_S, STEPS_S = 45.0, (0.5, 0.05)  # leap seconds are within; coarse, fine
ENOUGH_FIXES = 500  # to find a shift by
FAST, FEWEST = 3.0, 10  # m/s above which the course is the heading; rows
SIDEWAYS, STEADY = 0.5, 0.8  # rad, about the median, within which such a share of the headings lies
FORCE_AGREES = 0.6  # correlation of the force with the acceleration that shows where the sensor looks


def check_same_clock(reference: Columns, fixes: Columns, where: str) -> None:
    """Moving fixes lie nearest to the reference as the clocks stand, but for a receiver's delay.

    A shift counts that more than halves the median distance, and by more than lever arm and 1σ explain.
    """
    thin = slice(None, None, 1 + len(fixes["t"]) // ENOUGH_FIXES)
    some = {name: values[thin] for name, values in fixes.items()}
    here, count = _measure_apart(reference, some, 0.0)
    sigma = np.nan_to_num(np.hypot(some["std_pos_n"], some["std_pos_e"]), nan=SINGLE_M)
    margin = max(ARM_M, 2 * float(np.median(sigma)) if len(sigma) else 0.0)
    if count < FEWEST or here <= margin:
        return
    shift, nearest, span = 0.0, here, SEARCH_S
    for step in STEPS_S:
        for other in shift + np.arange(-span, span + step / 2, step):
            apart, moving = _measure_apart(reference, some, float(other))
            if moving > count / 2 and apart < nearest:
                shift, nearest = float(other), apart
        span = step
    if abs(shift) <= DELAY_S or nearest > 0.5 * here or here - nearest <= margin:
        return
    ahead = shift > 0
    by = f"{'subtract' if ahead else 'add'} {abs(shift):.1f} s {'from' if ahead else 'to'} t of reference"
    raise InputError(
        f"{where}: lies {here:.3g} m from the moving fixes in the median, {nearest:.2g} m if shifted in time: its "
        f"clock is {abs(shift):.1f} s {'ahead of' if ahead else 'behind'} that of GNSS{describe_offset(shift)}; {by} "
        f"(reader.reference.time.offset_s={-shift:.1f})"
    )


def _measure_apart(reference: Columns, fixes: Columns, shift: float) -> tuple[float, int]:
    """Median distance [m] from fixes in motion to the reference ``shift`` seconds later, and how many these are."""
    both, apart = _compare_places(reference, fixes, shift)
    north, east = (np.interp(fixes["t"] + shift, reference["t"], reference[c]) for c in ("vel_n", "vel_e"))
    with np.errstate(invalid="ignore"):
        moving = both & (np.hypot(north, east) > FAST)
    return float(np.median(apart[moving])) if moving.any() else np.nan, int(moving.sum())


def _compare_places(reference: Columns, fixes: Columns, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Fixes (n,) that the reference has a row for ``shift`` seconds later, and how far each is from it [m]."""
    t = fixes["t"] + shift
    row = np.searchsorted(reference["t"], t).clip(max=len(reference["t"]) - 1)
    lat, lon = reference["lat_deg"], np.unwrap(reference["lon_deg"], period=360)
    lat, lon = (np.interp(t, reference["t"], x) for x in (lat, lon))
    side = wrap_angle(lon - fixes["lon_deg"], 180) * np.cos(np.radians(lat))
    return np.abs(reference["t"][row] - t) < SAME_S, DEGREE_M * np.hypot(lat - fixes["lat_deg"], side)


def check_same_place(reference: Columns, fixes: Columns, where: str) -> None:
    """A reference is of the same drive: near the fixes, in the median over those that it has a row for."""
    both, apart = _compare_places(reference, fixes)
    if not both.any():
        return
    near = {name: values[both] for name, values in fixes.items()}
    away = float(np.median(apart[both]))
    sigma = np.nan_to_num(np.hypot(near["std_pos_n"], near["std_pos_e"]))
    if away > REFERENCE_M + SIGMAS * float(np.median(sigma)):
        said = f"{away / 1000:.3g} km" if away > 1000 else f"{away:.0f} m"
        other = "of this drive" if away > 1000 else "of this drive, on the same clock and datum"
        raise InputError(f"{where}: lies {said} from the fixes in the median; give the reference {other}")
    _check_height(reference, near, where)


def _check_height(reference: Columns, fixes: Columns, where: str) -> None:
    """Heights of both above the ellipsoid; one number for all is that of a log that does not know it."""
    if any((table["height_m"] == table["height_m"][0]).all() for table in (reference, fixes)):
        return
    above = np.interp(fixes["t"], reference["t"], reference["height_m"]) - fixes["height_m"]
    sigma = np.nan_to_num(fixes["std_pos_d"])[np.isfinite(above)]
    above = above[np.isfinite(above)]
    middle = float(np.median(above)) if len(above) else 0.0
    if abs(middle) <= HEIGHT_M + SIGMAS * (float(np.median(sigma)) if len(sigma) else 0.0):
        return
    side = f"{where}: lies {abs(middle):.0f} m {'above' if middle > 0 else 'below'} the fixes in the median"
    flat = abs(middle) < GEOID_M and np.median(np.abs(above - middle)) < STEADY_M
    raise InputError(
        f"{side}: most often one counts from sea level (geoid), the other from the ellipsoid; height_m must count from "
        "the ellipsoid in both; add the geoid to the one from sea level (reader.reference.position.geoid, or of gnss)"
        if flat
        else f"{side}; height_m must be in metres above the ellipsoid in both"
    )


def check_attitude(reference: Columns, imu: Columns, where: str) -> None:
    """Attitudes in radians, yaw clockwise from North and along the motion of a car that drives forward."""
    for name in ATTITUDE:
        largest = np.nanmax(np.abs(reference[name]), initial=0.0)
        if largest > 2 * np.pi + 0.01:
            raise InputError(f"{where}: {name} reaches {largest:.1f}: looks like degrees; multiply attitudes by π/180")
    speed = np.hypot(reference["vel_n"], reference["vel_e"])
    with np.errstate(invalid="ignore"):
        fast = (speed > FAST) & np.isfinite(reference["yaw"])
    if fast.sum() < FEWEST:
        return
    course, yaw = np.arctan2(reference["vel_e"][fast], reference["vel_n"][fast]), reference["yaw"][fast]

    def measure_distance(angle: np.ndarray) -> float:
        return float(np.median(np.abs(wrap_angle(angle - course))))

    if measure_distance(yaw) > 0.5 and measure_distance(np.pi / 2 - yaw) < 0.1:
        raise InputError(f"{where}: yaw counts from East, must count clockwise from North; use π/2 − yaw")
    turned, off = circular_median(yaw - course)
    if np.mean(np.abs(off) < SIDEWAYS) < STEADY:
        return
    backwards = abs(turned) > np.radians(TURNED_DEG[1])
    if backwards or abs(turned) < np.radians(TURNED_DEG[0]):
        looks_back = _looks_back(imu, reference)
        if looks_back is None or looks_back == backwards:
            return  # forward, or a car in reverse, or a sensor that looks back
        if looks_back:
            raise InputError(
                f"{where}: yaw is along the course, but the IMU looks back: its accelerations agree with the motion if "
                "it is turned by 180° about the vertical; both must be of the same axes, x forward: "
                "reader.imu.accel.axes and gyro.axes={roll: 0, pitch: 0, yaw: 180}"
            )
    by = "180" if backwards else f"{np.degrees(turned):+.0f}"
    change = f"{'subtract' if turned > 0 else 'add'} {abs(turned):.2f} rad"
    raise InputError(
        f"{where}: yaw is {by}° from the course in the median though the car drives forward: of another axis, or in "
        f"other conventions; must be that of x forward, clockwise from North: {change} "
        "(or reader.reference.attitude.convention); roll and pitch may be wrong too"
    )


def _looks_back(imu: Columns, reference: Columns) -> bool | None:
    """Whether the force along the sensor's x axis is against a motion along it; None where it is not clear."""
    whole = np.unique(np.floor(reference["t"]), return_index=True)[1]  # one row a second
    moved = find_motion({name: values[whole] for name, values in reference.items()})
    best = find_lag(ImuSums.of_table(imu), moved, APART_S)
    if best is None or best.force < FORCE_AGREES or TURNED_DEG[0] < np.degrees(abs(best.angle)) < TURNED_DEG[1]:
        return None
    return bool(abs(best.angle) > np.pi / 2)
