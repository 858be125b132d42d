"""Plausibility of a drive's numbers: wrong units, dead, mirrored or exchanged axes, ones that do not point
Forward-Right-Down, swapped columns.

Each check compares with other data of the drive (gravity, the velocities, the course), so that an
unusual drive does not raise an alarm.
"""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.dead_sensors import check_dead_axes
from dlkf.data.discovery.clock import ImuSums, Lag, describe_offset, find_lag
from dlkf.data.discovery.drift import ROUGH_S, compare_ends, find_drifting_pose, find_step
from dlkf.data.discovery.motion import Motion, find_motion, fit_motion, stretches
from dlkf.data.discovery.units import compare_climbs, nearest_unit
from dlkf.data.limits import DEGREE_M, NOWHERE_DEG
from dlkf.data.readers.units import LENGTH
from dlkf.data.schema import ACCEL, GYRO, stack_columns
from dlkf.data.tables import Columns
from dlkf.navigation.earth import SEMI_MAJOR

FORCE, UPRIGHT = (7.0, 13.0), 0.7  # m/s², the median specific force; the share of it along −z
FASTEST_RATE = 20.0  # rad/s: no car turns, and no bump shakes it, that fast for a thousandth of a drive
DISAGREES, AGREES = 0.4, 0.25  # relative residual of way against velocity
UNRELATED = 0.8  # of that: the velocities explain nothing of the way
MOVING, RADIANS_DEG = 3.0, 6.5  # m/s; courses in radians that were read as degrees are less
SUSPECT, CLEARLY = 0.15, 0.25  # less than DISAGREES, but more than a quarter of which another reading has
MOVED_M = 100.0  # positions of a car that moves
UNITS = (  # that velocities may be in, the remedy, m/s per unit
    ("like km/h", "divide them by 3.6", 1 / 3.6),
    ("like knots", "multiply them by 0.5144", 0.514444),
    ("like mph", "multiply them by 0.44704", 0.44704),
    ("divided by 3.6", "multiply them by 3.6", 3.6),
)
FEW = 2  # single fixes at 0°/0° or a continent away are refused by themselves (dlkf.data.limits)
FARTHEST_KM = 2000.0
SEARCH_S = 600.0  # clocks of logs that have time in common are hardly further apart
APART_S = 1.0  # less is a delay, which the filters bear; dlkf.ingest measures it on request
WORST_PPM = 1e5  # of clocks that both count seconds
LATE_S = 0.3  # more than the search is ever off (0.2 s on 50 real drives)
DRIFTED_S = 0.1  # from a drive's first to its last second: worth a line
SHORTEST_S = 60.0  # of a drive whose drift is observable
TURNED_DEG = (30.0, 150.0)  # backwards is found by the filters' own search
YAW_AGREES, FORCE_DISAGREES, FORCE_AGREES = 0.85, 0.6, 0.85  # correlations with GNSS
CHUNK_S = 10.0  # way and course are compared over such stretches: metres of GNSS noise do not matter
ALIKE = 0.9  # correlation of heights with the integral of vel_d
OTHER_UNIT, CERTAIN = 2.0, 5.0  # of the climb by heights to that by velocities, or its inverse; σ
UNIT_WORDS = {"ft": "feet"}


def check_imu_units(imu: Columns, where: str) -> None:
    """Gravity must be about 9.8 m/s² and upwards along −z; rates must be those of a car in rad/s."""
    force = _length(imu, ACCEL)
    down, largest = -imu["accel_z"], float(_length(imu, GYRO).max())
    usual = _is_usual(force > FORCE[0]) and _is_usual(force < FORCE[1]) and _is_usual(down > UPRIGHT * FORCE[1])
    if usual and largest <= FASTEST_RATE:
        return  # the medians and the quantile below, which cost more than all else, would say the same
    size = float(np.median(force))
    if 0.8 < size < 1.3:
        raise InputError(
            f"{where}: median specific force is {size:.2f}: looks like g; reader.imu.accel.unit=g, or multiply "
            "accel by 9.80665"
        )
    if not FORCE[0] < size < FORCE[1]:
        raise InputError(
            f"{where}: median specific force is {size:.3g} m/s², must be near 9.8; reader.imu.accel.unit=auto, or "
            "accel in m/s² with gravity"
        )
    axes = np.array([np.median(imu[c]) for c in ACCEL])
    if axes[2] > UPRIGHT * size:
        raise InputError(
            f"{where}: accel_z is {axes[2]:+.2f} m/s² in the median, must be about −9.8 (Forward-Right-"
            "Down); the z axis points up (FLU?): reader.imu.accel.axes=auto and gyro.axes=auto, or negate y and z of "
            "accel and gyro"
        )
    if axes[2] > -UPRIGHT * size:
        k = int(np.abs(axes).argmax())
        raise InputError(
            f"{where}: gravity lies on {ACCEL[k]} ({axes[k]:+.2f} m/s² in the median), must be −9.8 on "
            "accel_z (Forward-Right-Down); reorder the axes of accel and gyro (reader.imu.accel.axes and gyro.axes, "
            "or auto)"
        )
    rate = float(np.quantile(_length(imu, GYRO), 0.999))
    if rate > FASTEST_RATE:
        raise InputError(
            f"{where}: gyro reaches {rate:.0f} rad/s: looks like degrees; reader.imu.gyro.unit=deg/s, or "
            "multiply gyro by π/180"
        )


def _is_usual(holds: np.ndarray) -> bool:
    """Whether more than half hold, and so the median."""
    return 2 * int(np.count_nonzero(holds)) > len(holds) + 1


def _length(imu: Columns, axes: tuple[str, ...]) -> np.ndarray:
    return np.sqrt(sum(imu[c] * imu[c] for c in axes))


def check_gnss_units(gnss: Columns, where: str) -> None:
    """Latitude and longitude in range, and the way that they make in agreement with the velocities."""
    lat, lon = gnss["lat_deg"], gnss["lon_deg"]
    bad = np.flatnonzero(np.abs(lat) > 90)
    if len(bad):
        swapped = np.abs(lon).max() <= 90
        remedy = "latitude and longitude look swapped" if swapped else "must lie within ±90 degrees"
        remedy += "" if swapped else _other_degrees(lat)
        raise InputError(f"{where}: fix {bad[0]}: lat_deg is {lat[bad[0]]:.4f}; {remedy}")
    bad = np.flatnonzero(np.abs(lon) > 180)
    if len(bad):
        remedy = "; subtract 360 where it is above 180" if lon.min() >= 0 and lon.max() <= 360 else ""
        raise InputError(f"{where}: fix {bad[0]}: lon_deg is {lon[bad[0]]:.4f}; must lie within ±180 degrees{remedy}")
    _check_places(lat, lon, where)
    check_way(gnss, where)
    _check_climb(gnss, where)


def _other_degrees(lat: np.ndarray) -> str:
    """What latitudes beyond 90 may be instead."""
    largest = float(np.nanmax(np.abs(lat)))
    if largest <= 9000.0 and np.nanmax(np.abs(lat) % 100.0) < 60.0:
        return ": looks like degrees and minutes (ddmm.mmmm); reader.gnss.position.unit=ddmm, or change them to degrees"
    if 1e5 < largest <= 1e7:  # 1e-7 degrees within a degree of the equator are fewer than grids
        return ": looks like metres of a grid (UTM, ECEF); change them to degrees"
    return ": looks like 1e-7 degrees; multiply by 1e-7" if 1e7 < largest <= 9e8 else ""


def _check_places(lat: np.ndarray, lon: np.ndarray, where: str) -> None:
    """No fixes at 0°/0° in a drive elsewhere, and none a continent away from the rest, but for very few."""
    zero = np.flatnonzero((np.abs(lat) < NOWHERE_DEG) & (np.abs(lon) < NOWHERE_DEG))
    if FEW < len(zero) < len(lat):
        raise InputError(
            f"{where}: fix {zero[0]} is at 0°/0°, as {len(zero)} of {len(lat)}: no position yet; "
            "reader.gnss.position.zero=none, or give them quality 0"
        )
    middle, side = np.median(lat), np.median(np.cos(np.radians(lat)))
    east = wrap_angle(lon - np.median(lon), 180)
    far = np.hypot(lat - middle, east * side) * DEGREE_M / 1000
    worst = int(far.argmax()) if len(far) else 0
    if (far > FARTHEST_KM).sum() > FEW and np.mean(far > FARTHEST_KM) < 0.3:
        raise InputError(
            f"{where}: fix {worst} lies {far[worst]:.0f} km from the rest of the drive; give such fixes quality 0"
        )


def check_way(gnss: Columns, where: str, *, unexplained: bool = False) -> None:
    """InputError where displacements over stretches of ten seconds are not those of the velocities of good fixes.

    A fault only if another reading of the columns explains the way where the given one does not, or ``unexplained``
    if none does.
    """
    t, lat, lon = gnss["t"], np.radians(gnss["lat_deg"]), np.radians(gnss["lon_deg"])
    v_n, v_e = gnss["vel_n"], gnss["vel_e"]
    if len(t) < 3:
        return
    step = np.diff(t)
    whole = np.isfinite(v_n) & np.isfinite(v_e)
    _check_unknown(lat, lon, v_n[whole], v_e[whole], where)
    smooth = (step <= 2.0) & whole[1:] & whole[:-1]
    way_n, way_e = (
        np.concatenate(([0.0], np.cumsum(np.where(smooth, step * (v[1:] + v[:-1]) / 2, 0.0)))) for v in (v_n, v_e)
    )
    first, last = stretches(t, CHUNK_S, ~smooth)
    moved = np.stack((way_n[last] - way_n[first], way_e[last] - way_e[first]), -1)
    far = np.hypot(*moved.T) > 20.0
    if far.sum() < 3:
        return
    first, last, moved = first[far], last[far], moved[far]

    def residual(lat: np.ndarray, lon: np.ndarray, moved: np.ndarray) -> float:
        turn = wrap_angle(lon[last] - lon[first])
        way = SEMI_MAJOR * np.stack((lat[last] - lat[first], np.cos(lat[first]) * turn), -1)
        return float(np.median(np.linalg.norm(way - moved, axis=-1) / np.linalg.norm(moved, axis=-1)))

    given = residual(lat, lon, moved)
    if given < SUSPECT:
        return
    readings = {
        "latitude and longitude look swapped; exchange the first two of reader.gnss.position.columns, or lat_deg and "
        "lon_deg": (lon, lat, moved),
        "lat_deg and lon_deg look like radians (unit=rad), or like degrees that were read as ddmm (unit=deg); "
        "reader.gnss.position.unit=…, or give degrees": (np.degrees(lat), np.degrees(lon), moved),
        "vel_n and vel_e look swapped; reader.gnss.velocity.frame=enu, or exchange them": (lat, lon, moved[:, ::-1]),
        **{
            f"the velocities look {so}; reader.gnss.velocity.unit=auto, or {remedy}": (lat, lon, moved * factor)
            for so, remedy, factor in UNITS
        },
        "the velocities have the wrong sign; negate them": (lat, lon, -moved),
        "lat_deg or vel_n has the wrong sign, north is positive; negate it": (-lat, lon, moved),
        "lon_deg or vel_e has the wrong sign, east is positive; negate it": (lat, -lon, moved),
    }
    fits = {text: residual(*reading) for text, reading in readings.items()}
    best = min(fits, key=lambda text: fits[text])
    if fits[best] < (AGREES if given > DISAGREES else CLEARLY * given):
        raise InputError(f"{where}: positions and velocities disagree: {best}")
    if given > DISAGREES and (np.ptp(v_e[whole]) == 0 or np.ptp(v_n[whole]) == 0):
        raise InputError(
            f"{where}: positions and velocities disagree: vel_n and vel_e must count North and East, not along the "
            "car; leave them out, or give speed and course (reader.gnss.velocity.frame=course)"
        )
    course = np.degrees(np.arctan2(v_e[whole], v_n[whole]))[np.hypot(v_e, v_n)[whole] > MOVING]
    if given > DISAGREES and len(course) and course.min() > -0.5 and course.max() < RADIANS_DEG:
        raise InputError(
            f"{where}: positions and velocities disagree: all velocities point to {course.min():.1f}° to "
            f"{course.max():.1f}°, as of a course in radians that was read as degrees; convert the course column"
        )
    if unexplained and given > UNRELATED:
        raise InputError(
            f"{where}: positions and velocities disagree: over ten seconds the velocities are off by {given:.0%} of "
            "the way (median); check unit, order and course (degrees from North over East) of their columns, or leave "
            "them out"
        )


def _check_unknown(lat: np.ndarray, lon: np.ndarray, v_n: np.ndarray, v_e: np.ndarray, where: str) -> None:
    """Velocities of 0 in every row of a drive that moves are none."""
    if not len(v_n) or v_n.any() or v_e.any():
        return
    east = np.cos(lat[0]) * wrap_angle(lon - lon[0])
    way = SEMI_MAJOR * float(np.hypot(np.ptp(lat), np.ptp(east)))
    if way > MOVED_M:
        raise InputError(
            f"{where}: vel_n and vel_e are 0 in every row though positions move by {way:.0f} m: write NaN where a "
            "velocity is not known, or leave the columns out"
        )


def _check_climb(gnss: Columns, where: str) -> None:
    """Heights against the integral of the downward velocity."""
    climb = compare_climbs(gnss["t"], gnss["height_m"], gnss["vel_d"])
    if climb is None:
        return
    if climb.slope < -0.5 and climb.alike > ALIKE:
        raise InputError(f"{where}: vel_d grows where the height does: it counts upwards; negate vel_d")
    if not climb.differs(OTHER_UNIT, CERTAIN):
        return
    unit = nearest_unit(1 / climb.slope, climb.std / climb.slope**2, LENGTH)
    remedy = (
        f"look like {UNIT_WORDS.get(unit, unit)}; reader.gnss.position.height_unit={unit}, or multiply height_m by "
        f"{LENGTH[unit]:g}"
        if unit is not None
        else "one of them is in another unit; reader.gnss.position.height_unit, or correct vel_d"
    )
    raise InputError(f"{where}: heights change {climb.slope:.3g} times as much as the vertical velocity says: {remedy}")


def check_clocks(imu: Columns, fixes: Columns, where: str) -> None:
    """The yaw rate and the horizontal force agree with GNSS as the clocks stand, or at no offset clearly better.

    Then the force forward and right also shows whether the sensor looks along the car.
    """
    moved = find_motion(fixes)
    check_dead_axes(imu, moved, where)
    sums = ImuSums.of_table(imu)
    _check_drift(sums, moved, where)
    best = find_lag(sums, moved, SEARCH_S)
    if (best is None or not best.certain) and not np.isfinite(fixes["vel_n"]).any():
        moved = fit_motion(fixes)
        best = find_lag(sums, moved, SEARCH_S)
    _check_handedness(imu, moved, best, where)
    if best is None or not best.certain:
        return
    if abs(best.lag_s) > APART_S:
        here = find_lag(sums, moved, APART_S / 2)
        if here is not None and here.gain > 0.5 * best.gain:
            return
        as_is = "too little in common" if here is None else f"{max(here.yaw, here.force):.2f}"
        raise InputError(
            f"{where}: the clocks of IMU and GNSS are {abs(best.lag_s):.1f} s apart: yaw rate and course agree to "
            f"{best.yaw:.2f} with {best.lag_s:+.1f} s on GNSS, as they stand {as_is}{describe_offset(best.lag_s)}; "
            f"reader.gnss.time.offset_s=auto, or add {best.lag_s:.1f} s to t of gnss"
        )
    turned = np.degrees(best.angle)
    if best.force > 0.85 and TURNED_DEG[0] < abs(turned) < TURNED_DEG[1]:
        raise InputError(
            f"{where}: accelerations agree with GNSS if the IMU is turned by {turned:+.0f}° about the vertical (to "
            f"the {'right' if turned > 0 else 'left'}): x must point forward; reader.imu.accel.axes and "
            f"gyro.axes=auto, or of axes that are frd now {{roll: 0, pitch: 0, yaw: {turned:.0f}}}"
        )


def _check_handedness(imu: Columns, gnss: Motion, best: Lag | None, where: str) -> None:
    """Turns agree with GNSS, accelerations only when an axis is turned round: the axes are left-handed."""
    if best is None or best.yaw < YAW_AGREES or best.force > FORCE_DISAGREES or abs(best.lag_s) > APART_S:
        return
    mirrored = find_lag(ImuSums.of_table(imu | {"accel_y": -imu["accel_y"]}), gnss, APART_S)
    if mirrored is None or mirrored.force < FORCE_AGREES:
        return
    quarter = round(float(mirrored.angle) / (np.pi / 2)) % 4
    remedy, key = {
        0: ("negate accel_y", "reader.imu.accel.mirror=y"),
        2: ("negate accel_x", "reader.imu.accel.mirror=x"),
    }.get(quarter, ("exchange accel_x and accel_y", "reader.imu.accel.columns"))
    raise InputError(
        f"{where}: turns agree with GNSS, accelerations only in left-handed axes ({mirrored.force:.2f} instead of "
        f"{best.force:.2f}): {remedy}, and look at the gyroscope's axes too ({key})"
    )


def _check_drift(imu: ImuSums, gnss: Motion, where: str) -> None:
    """The first and the last third of a drive have the same lag."""
    ends = compare_ends(imu, gnss)
    if ends is None:
        return
    if (at := find_step(imu, gnss, ends)) is not None:
        raise InputError(
            f"{where}: the clock of IMU or GNSS steps between t = {at[0]:.0f} and {at[1]:.0f} s: the offset is "
            f"{ends.first_s:+.2f} s before and {ends.last_s:+.2f} s after it; make two drives there"
        )
    if abs(ends.last_s - ends.first_s) <= APART_S:
        return
    ppm = 1e6 * ends.drift
    raise InputError(
        f"{where}: the clocks of IMU and GNSS drift apart, by about {ppm:.0f} ppm: {ends.first_s:+.1f} s at the "
        f"beginning, {ends.last_s:+.1f} s at the end; reader.gnss.time.drift_ppm={ppm:.0f} and "
        f"offset_s={ends.first_s:.1f}, then drift_ppm=auto on what is left"
        if abs(ppm) < WORST_PPM
        else f"{where}: the clocks of IMU and GNSS have different seconds; correct reader.imu.time.unit"
    )


def describe_clocks(imu: Columns, gnss: Columns) -> list[str]:
    """Lines about what :func:`check_clocks` does not refuse yet: clocks that drift apart, fixes that are late or early,
    a sensor that seems turned."""
    moved, sums = find_motion(gnss), ImuSums.of_table(imu)
    lines = [_describe_drift(imu, sums, moved)]
    if (best := find_lag(sums, moved, APART_S)) is not None:
        lines += [_describe_delay(best), _describe_rotation(best)]
    return [line for line in lines if line]


def _describe_drift(imu: Columns, sums: ImuSums, moved: Motion) -> str | None:
    ends = compare_ends(sums, moved)
    span = float(moved.t[-1] - moved.t[0]) if len(moved.t) else 0.0
    if span < SHORTEST_S or (ends is not None and abs(ends.drift) * span < DRIFTED_S - ROUGH_S):
        return None
    lag_s = 0.5 * (ends.first_s + ends.last_s) if ends is not None else 0.0
    pose = find_drifting_pose(imu["t"], stack_columns(imu, ACCEL), stack_columns(imu, GYRO), moved, lag_s)
    if pose is None or abs(pose.drift) * span < DRIFTED_S:
        return None
    return (
        f"the clock of the IMU runs {'faster' if pose.drift > 0 else 'slower'} than that of GNSS by "
        f"{1e6 * abs(pose.drift):.0f} ± {1e6 * pose.drift_std:.0f} ppm, {abs(pose.drift) * span:.2f} s over the drive; "
        "reader.gnss.time.drift_ppm=auto and offset_s=auto take it out"
    )


def _describe_delay(best: Lag) -> str | None:
    if not best.certain or abs(best.peak_s) < LATE_S:
        return None
    side = "later" if best.peak_s < 0 else "earlier"
    return (
        f"fixes are stamped about {abs(best.peak_s):.1f} s {side} than the motion that the IMU feels: plus and filters "
        "with +receiver estimate it, others follow it; dlkf doctor measures it, reader.gnss.time.offset_s=auto takes "
        "it out"
    )


def _describe_rotation(best: Lag) -> str | None:
    if not best.clear or not min(best.yaw, best.force) > 0.6:
        return None
    turned = np.degrees(best.angle)
    if not TURNED_DEG[0] < abs(turned) < TURNED_DEG[1]:
        return None
    return (
        f"the IMU seems turned by {turned:+.0f}° about the vertical (accelerations and GNSS agree to {best.force:.2f} "
        "then): dlkf doctor looks closer, reader.imu.accel.axes=auto and gyro.axes=auto find it"
    )
