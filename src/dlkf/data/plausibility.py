"""Plausibility of a drive's numbers: wrong units, axes that do not point Forward-Right-Down, swapped columns.

Each check compares with something else that the drive knows (gravity, the velocities, the course), so that an
unusual drive does not raise an alarm.
"""

from __future__ import annotations

import numpy as np

from dlkf.data.schema import ACCEL, ATTITUDE, GYRO
from dlkf.data.tables import Columns
from dlkf.errors import InputError
from dlkf.navigation.earth import SEMI_MAJOR

STANDARD_GRAVITY = 9.80665  # m/s²
FASTEST_RATE = 20.0  # rad/s: no car turns, and no bump shakes it, that fast for a thousandth of a drive
CHUNK_S = 10.0  # way and course are compared over such stretches: metres of GNSS noise do not matter
DISAGREES, AGREES = 0.5, 0.25  # relative residual of way against velocity


def check_imu_units(imu: Columns, where: str) -> None:
    """Gravity must be about 9.8 m/s² and upwards along −z; rates must be those of a car in rad/s."""
    force = np.stack([imu[c] for c in ACCEL], -1)
    size = float(np.median(np.linalg.norm(force, axis=-1)))
    if 0.8 < size < 1.3:
        raise InputError(
            f"{where}: median specific force is {size:.2f}: looks like g; multiply accel by 9.80665"
        )
    if not 7.0 < size < 13.0:
        raise InputError(
            f"{where}: median specific force is {size:.3g} m/s², must be near 9.8; check the unit, "
            "and that gravity was not taken out"
        )
    axes = np.median(force, axis=0)
    if axes[2] > 0.7 * size:
        raise InputError(
            f"{where}: accel_z is {axes[2]:+.2f} m/s² in the median, must be about −9.8 (Forward-Right-"
            "Down); the z axis points up (FLU?): turn the signs of y and z of accel and gyro"
        )
    if axes[2] > -0.7 * size:
        k = int(np.abs(axes).argmax())
        raise InputError(
            f"{where}: gravity lies on {ACCEL[k]} ({axes[k]:+.2f} m/s² in the median), must be −9.8 on "
            "accel_z (Forward-Right-Down); reorder the axes of accel and gyro"
        )
    rate = float(np.quantile(np.linalg.norm(np.stack([imu[c] for c in GYRO], -1), axis=-1), 0.999))
    if rate > FASTEST_RATE:
        raise InputError(
            f"{where}: gyro reaches {rate:.0f} rad/s: looks like degrees; multiply gyro by π/180"
        )


def check_gnss_units(gnss: Columns, where: str) -> None:
    """Latitude and longitude in range, and the way that they make in agreement with the velocities."""
    lat, lon = gnss["lat_deg"], gnss["lon_deg"]
    bad = np.flatnonzero(np.abs(lat) > 90)
    if len(bad):
        swapped = np.abs(lon).max() <= 90
        remedy = "latitude and longitude look swapped" if swapped else "must lie within ±90 degrees"
        raise InputError(f"{where}: fix {bad[0]}: lat_deg is {lat[bad[0]]:.4f}; {remedy}")
    bad = np.flatnonzero(np.abs(lon) > 180)
    if len(bad):
        raise InputError(f"{where}: fix {bad[0]}: lon_deg is {lon[bad[0]]:.4f}; must lie within ±180 degrees")
    _check_way(gnss, where)


def _check_way(gnss: Columns, where: str) -> None:
    """Displacements over stretches of ten seconds against the integral of the velocities.

    Speaks up only if another reading of the columns explains the way where the given one does not.
    """
    t, lat, lon = gnss["t"], np.radians(gnss["lat_deg"]), np.radians(gnss["lon_deg"])
    v_n, v_e = gnss["vel_n"], gnss["vel_e"]
    if len(t) < 3:
        return
    step = np.diff(t)
    whole = np.isfinite(v_n) & np.isfinite(v_e)
    smooth = (step <= 2.0) & whole[1:] & whole[:-1]
    way_n, way_e = (
        np.concatenate(([0.0], np.cumsum(np.where(smooth, step * (v[1:] + v[:-1]) / 2, 0.0))))
        for v in (v_n, v_e)
    )
    breaks = np.concatenate(([0], np.cumsum(~smooth)))
    first = np.arange(len(t))
    last = np.searchsorted(t, t + CHUNK_S)
    use = last < len(t)
    first, last = first[use], last[use]
    same = breaks[first] == breaks[last]
    first, last = first[same], last[same]
    if not len(first):
        return
    moved = np.stack((way_n[last] - way_n[first], way_e[last] - way_e[first]), -1)
    far = np.hypot(*moved.T) > 20.0
    if far.sum() < 3:
        return
    first, last, moved = first[far], last[far], moved[far]

    def residual(lat: np.ndarray, lon: np.ndarray, moved: np.ndarray) -> float:
        turn = (lon[last] - lon[first] + np.pi) % (2 * np.pi) - np.pi
        way = SEMI_MAJOR * np.stack((lat[last] - lat[first], np.cos(lat[first]) * turn), -1)
        return float(np.median(np.linalg.norm(way - moved, axis=-1) / np.linalg.norm(moved, axis=-1)))

    if residual(lat, lon, moved) < DISAGREES:
        return
    readings = {
        "latitude and longitude look swapped; exchange lat_deg and lon_deg": (lon, lat, moved),
        "lat_deg and lon_deg look like radians; multiply them by 180/π": (
            np.degrees(lat),
            np.degrees(lon),
            moved,
        ),
        "vel_n and vel_e look swapped; exchange them": (lat, lon, moved[:, ::-1]),
        "the velocities look like km/h; divide them by 3.6": (lat, lon, moved / 3.6),
        "the velocities look like knots; multiply them by 0.5144": (lat, lon, moved * 0.514444),
        "the velocities have the wrong sign; negate them": (lat, lon, -moved),
    }
    fits = {text: residual(*reading) for text, reading in readings.items()}
    best = min(fits, key=lambda text: fits[text])
    if fits[best] < AGREES:
        raise InputError(f"{where}: positions and velocities disagree: {best}")


def check_turns(imu: Columns, gnss: Columns, where: str) -> None:
    """Integrated gyro_z against the change of course between fixes, where the drive turns enough to tell."""
    t, course = gnss["t"], np.arctan2(gnss["vel_e"], gnss["vel_n"])
    speed = np.hypot(gnss["vel_n"], gnss["vel_e"])
    angle = np.concatenate(([0.0], np.cumsum(imu["gyro_z"][1:] * np.diff(imu["t"]))))
    with np.errstate(invalid="ignore"):
        use = (np.diff(t) <= 1.5) & (speed[1:] > 3) & (speed[:-1] > 3)
        use &= (t[1:] <= imu["t"][-1]) & (t[:-1] >= imu["t"][0])
    turned = ((np.diff(course) + np.pi) % (2 * np.pi) - np.pi)[use]
    gyro = np.diff(np.interp(t, imu["t"], angle))[use]
    clear = np.abs(turned) > 0.1
    turned, gyro = turned[clear], gyro[clear]
    if len(turned) < 3 or np.abs(turned).sum() < 1.0 or not np.any(gyro):
        return
    slope = float(turned @ gyro / (turned @ turned))
    alike = abs(float(turned @ gyro)) / float(np.linalg.norm(turned) * np.linalg.norm(gyro))
    if alike < 0.9:
        return
    if slope > 20:
        raise InputError(
            f"{where}: gyro_z is {slope:.0f} times the turn of the course: looks like degrees; use rad/s"
        )
    if slope < -0.3:
        raise InputError(
            f"{where}: gyro_z turns against the course (slope {slope:.2f}): z must point down; "
            "turn the signs of y and z"
        )


def check_attitude(reference: Columns, where: str) -> None:
    """Attitudes in radians, and yaw clockwise from North."""
    for name in ATTITUDE:
        largest = np.nanmax(np.abs(reference[name]), initial=0.0)
        if largest > 2 * np.pi + 0.01:
            raise InputError(
                f"{where}: {name} reaches {largest:.1f}: looks like degrees; multiply attitudes by π/180"
            )
    speed = np.hypot(reference["vel_n"], reference["vel_e"])
    with np.errstate(invalid="ignore"):
        fast = (speed > 3) & np.isfinite(reference["yaw"])
    if fast.sum() < 10:
        return
    course, yaw = np.arctan2(reference["vel_e"][fast], reference["vel_n"][fast]), reference["yaw"][fast]

    def apart(angle: np.ndarray) -> float:
        return float(np.median(np.abs((angle - course + np.pi) % (2 * np.pi) - np.pi)))

    if apart(yaw) > 0.5 and apart(np.pi / 2 - yaw) < 0.1:
        raise InputError(f"{where}: yaw counts from East, must count clockwise from North; use π/2 − yaw")
