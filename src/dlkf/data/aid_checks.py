"""Checks of the tables of further sensors: wheel speed, heading, barometer, each against GNSS where possible.

One clear line for the first thing that makes a table unusable; what a filter can bear (a scale of some per cent, a
delay of some tenths of a second, slip, gaps) passes.
"""

from __future__ import annotations

import numpy as np

from dlkf.base.angles import circular_median
from dlkf.base.errors import InputError
from dlkf.data.discovery.motion import Motion
from dlkf.data.discovery.wheel import find_force_lag
from dlkf.data.schema import OPTIONAL
from dlkf.data.tables import Columns, refuse_rows

RATES_HZ = (0.02, 1000.0)
FAST = 3.0  # m/s: above, the ratio of two speeds means something and the car looks along its course
TURNS = 0.05  # m/s: above, a wheel turns
LEAST_COMMON = 10  # instants at which an aid and GNSS are compared
ENOUGH = 5000  # instants to find the lag of a clock by
SCALES = (0.7, 1.4)  # of a wheel to GNSS that a filter may calibrate; beyond, the unit is wrong
UNITS = {
    "km/h; divide it by 3.6 (reader.speed.value.unit=km/h)": 3.6,
    "mph; multiply it by 0.44704 (reader.speed.value.unit=mph)": 2.23694,
    "knots; multiply it by 0.514444 (reader.speed.value.unit=knots)": 1.94384,
    "cm/s; divide it by 100 (reader.speed.value.unit=cm/s)": 100.0,
    "mm/s; divide it by 1000 (reader.speed.value.unit=mm/s)": 1000.0,
    "m/s divided by 3.6; multiply it by 3.6": 1 / 3.6,
}
CLOCK_S, STEP_S = 5.0, 0.05  # so far apart are clocks compared, in such steps
APART_S = 0.6  # more is another clock, less a delay, which the filter estimates
CLEARLY = 0.4  # of the difference that is left at another lag, for that lag to be the right one
SQUARE_DEG = 30.0  # a heading so far from the course is that of antennas mounted otherwise
PRESSURE_PA = (3e4, 1.2e5)


def check_aid(name: str, table: Columns, imu: Columns, moved: Motion, where: str) -> None:
    """InputError for the first fault of an aid's table; ``moved`` is the motion by GNSS."""
    t = table["t"]
    values = [c for c in table if c not in ("t", "std")]
    if not values:
        wanted, has = OPTIONAL[name].names[:-1], ", ".join(table)
        raise InputError(f"{where}: has neither of {', '.join(wanted)}; one of them is needed, it has {has}")
    if len(t) > 1 and not RATES_HZ[0] <= (rate := 1 / float(np.median(np.diff(t)))) <= RATES_HZ[1]:
        raise InputError(f"{where}: {rate:.3g} rows a second: t is not in seconds; give t in seconds")
    refuse_rows(table, values, np.isinf, where, "write NaN where unknown")
    if not np.any([np.isfinite(table[c]) for c in values]):
        raise InputError(f"{where}: {' and '.join(values)} is NaN in every row; {_leaving_out(name)}")
    of_std = table.keys() & {"std"}
    refuse_rows(table, of_std, lambda x: (x < 0) | np.isinf(x), where, "must be finite and ≥ 0, or NaN if unknown")
    if not ((t > imu["t"][0]) & (t <= imu["t"][-1] + 1)).any():
        raise InputError(
            f"{where}: t from {t[0]:.3f} to {t[-1]:.3f} lies outside the IMU's {imu['t'][0]:.3f} to "
            f"{imu['t'][-1]:.3f}; both need the same clock"
        )
    if name == "speed":
        _check_speed(table, imu, moved, where)
    elif name == "heading":
        _check_heading(table, moved, where)
    elif name == "baro":
        _check_baro(table, where)


def _leaving_out(name: str) -> str:
    return f"leave it out (reader.{name}.file=null in ingest, an aids= without {name} elsewhere)"


def _check_speed(table: Columns, imu: Columns, moved: Motion, where: str) -> None:
    known = np.isfinite(table["speed"])
    t, v = table["t"][known], table["speed"][known]
    at, ground = _common(t, moved)
    fast = ground > FAST
    if fast.sum() < LEAST_COMMON:
        return
    wheel = np.interp(at, t, v)
    if np.ptp(wheel[fast]) == 0 and np.ptp(ground) > FAST:
        raise InputError(
            f"{where}: speed stays {wheel[0]:g} m/s though the car moves at up to {ground.max():.0f} m/s: the sensor "
            f"is dead; {_leaving_out('speed')}"
        )
    lag_s = _lag(t, v, at, ground)
    if abs(lag_s) > APART_S and not _agrees_with_imu(t, v, imu):
        raise InputError(
            f"{where}: the clock of the speed is {abs(lag_s):.1f} s {'ahead of' if lag_s > 0 else 'behind'} that of "
            f"GNSS; {'subtract' if lag_s > 0 else 'add'} {abs(lag_s):.2f} s {'from' if lag_s > 0 else 'to'} its t"
        )
    wheel, ground = np.interp(at + lag_s, t, v)[fast], ground[fast]
    turns = np.abs(wheel) > TURNS  # a car that is carried, on a train or a ferry, has a wheel that stands
    if turns.sum() >= LEAST_COMMON:
        wheel, ground = wheel[turns], ground[turns]
    ratio = float(np.median(wheel / ground))
    if SCALES[0] <= ratio <= SCALES[1]:
        return
    if SCALES[0] <= -ratio <= SCALES[1]:
        raise InputError(f"{where}: speed is negative where the car drives forward; negate it")
    close = [text for text, factor in UNITS.items() if abs(np.log(max(ratio, 1e-9) / factor)) < 0.1]
    looks = f": looks like {close[0]}" if close else "; it must be in m/s, correct its scale (reader.speed.value.unit)"
    raise InputError(f"{where}: speed is {ratio:.2f} times that of GNSS in the median{looks}")


def _agrees_with_imu(t: np.ndarray, v: np.ndarray, imu: Columns) -> bool:
    """Whether the speed has the clock of the IMU, so that it is the speed of GNSS that is late."""
    force = find_force_lag(t, v, imu["t"], imu["accel_x"])
    return force is not None and abs(force[0]) <= APART_S


def _lag(t: np.ndarray, v: np.ndarray, at: np.ndarray, ground: np.ndarray) -> float:
    """Seconds by which the speed comes late against GNSS, where that is clear; else 0."""
    lags = np.arange(-CLOCK_S, CLOCK_S + STEP_S / 2, STEP_S)
    inside = (at > t[0] + CLOCK_S) & (at < t[-1] - CLOCK_S)
    if inside.sum() < LEAST_COMMON or np.ptp(ground[inside]) < FAST:
        return 0.0
    at, ground = (x[inside][:: max(1, int(inside.sum()) // ENOUGH)] for x in (at, ground))
    shifted = np.abs(np.interp(at[:, None] + lags, t, v))
    scale = (shifted * ground[:, None]).sum(0) / np.maximum((shifted * shifted).sum(0), 1e-12)
    left = np.abs(scale * shifted - ground[:, None]).mean(0)  # means of magnitudes, so that slip does not decide
    best = int(left.argmin())
    return float(lags[best]) if left[best] < CLEARLY * left[len(lags) // 2] else 0.0


def _check_heading(table: Columns, moved: Motion, where: str) -> None:
    known = np.isfinite(table["heading"])
    t, heading = table["t"][known], table["heading"][known]
    if (largest := np.abs(heading).max()) > 2 * np.pi + 0.01:
        raise InputError(f"{where}: heading reaches {largest:.1f}: looks like degrees; multiply it by π/180")
    at, ground = _common(t, moved)
    fast = ground > FAST
    if fast.sum() < LEAST_COMMON:
        return
    course = np.interp(at, moved.t, np.unwrap(moved.course))[fast]
    seen = heading[np.clip(np.searchsorted(t, at[fast]), 0, len(t) - 1)]
    off = _middle(seen - course)
    for angle, said in ((np.pi / 2 - seen, "from East; use π/2 − heading"), (-seen, "anticlockwise; negate it")):
        mirrored = _middle(angle - course)
        if mirrored[1] < 0.5 * off[1] and abs(mirrored[0]) < 0.1 and max(abs(off[0]), off[1]) > np.radians(SQUARE_DEG):
            raise InputError(f"{where}: heading must count clockwise from North, it counts {said}")
    if abs(off[0]) > np.radians(SQUARE_DEG):
        raise InputError(
            f"{where}: heading is {np.degrees(off[0]):+.0f}° off the course in the median; subtract the angle of the "
            "antennas in the car from it"
        )


def _middle(angle: np.ndarray) -> tuple[float, float]:
    """Circular median of angles, and the median distance from it [rad]."""
    middle, off = circular_median(angle)
    return middle, float(np.median(np.abs(off)))


def _check_baro(table: Columns, where: str) -> None:
    if "pressure" not in table or not np.isfinite(table["pressure"]).any():
        return
    usual = float(np.nanmedian(table["pressure"]))
    if not PRESSURE_PA[0] < usual < PRESSURE_PA[1]:
        near = PRESSURE_PA[0] < 100 * usual < PRESSURE_PA[1]
        raise InputError(
            f"{where}: pressure is {usual:.4g} in the median, must be in Pa"
            + (": looks like hPa; multiply it by 100" if near else "; correct its unit")
        )


def _common(t: np.ndarray, moved: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Times within an aid's at which GNSS gives the speed, and that speed."""
    inside = (moved.t >= t[0]) & (moved.t <= t[-1])
    return moved.t[inside], moved.speed[inside]
