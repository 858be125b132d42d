"""Where GPS satellites are, how they move, and what a receiver on the Earth measures without any error.

Orbits after IS-GPS-200 tables 20-IV and 20-VI with its constants. Times are seconds since the almanac's time of
applicability, so that float64 resolves them to 0.1 ns. Shapes: T receiver times, S satellites.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.simulation.gnss.almanac import Almanac

Array = NDArray[np.floating]
LIGHT = 299792458.0  # m/s
GRAVITATION = 3.986005e14  # m³/s², μ of IS-GPS-200
EARTH_SPIN = 7.2921151467e-5  # rad/s, Ω̇e of IS-GPS-200
RELATIVITY = -2 * GRAVITATION**0.5 / LIGHT**2  # s/√m, F of IS-GPS-200
L1 = 1575.42e6  # Hz
NEWTON_STEPS = 3  # from an error of e²: below rounding for e ≤ 0.1


@dataclass(frozen=True)
class SatelliteState:
    """Position [m] and velocity [m/s] (T, S, 3) in ECEF, clock offset [s] and its rate (T, S)."""

    r_e: Array
    v_e: Array
    clock: Array
    clock_rate: Array


@dataclass(frozen=True)
class Signals:
    """What arrives at T times from S satellites, free of error.

    ``satellite`` is the state at emission, in the ECEF axes of the time of *reception*: the Earth's rotation
    during the signal's travel (Sagnac) is in it, so a distance is |r_s − r| (Groves 8.26, 8.32).
    ``distance`` [m] and its time derivative ``distance_rate`` [m/s], ``elevation``, ``azimuth`` [rad] (T, S).
    """

    satellite: SatelliteState
    distance: Array
    distance_rate: Array
    elevation: Array
    azimuth: Array


def satellite_state(almanac: Almanac, t: Array, t_axes: Array | None = None) -> SatelliteState:
    """The satellites at times ``t`` (T,) or (T, S), in the ECEF axes of the times ``t_axes`` (T,), by default ``t``.

    Kepler's equation by Newton's method, position by IS-GPS-200 table 20-IV without harmonic corrections,
    velocity as its derivative in rotating axes; δt_s = af0 + af1 t + F e √A sin E.
    """
    t = t[:, None] if t.ndim == 1 else t
    t_axes = t if t_axes is None else t_axes[:, None]
    e = almanac.eccentricity
    mean_motion = GRAVITATION**0.5 / almanac.sqrt_a**3
    mean_anomaly = almanac.mean_anomaly + mean_motion * t
    anomaly = mean_anomaly + e * np.sin(mean_anomaly)
    for _ in range(NEWTON_STEPS):
        anomaly += (mean_anomaly - anomaly + e * np.sin(anomaly)) / (1 - e * np.cos(anomaly))
    sine, cosine = np.sin(anomaly), np.cos(anomaly)
    shrink = 1 - e * cosine
    anomaly_rate = mean_motion / shrink
    root = np.sqrt(1 - e * e)
    # in the orbital plane, first axis towards perigee, then turned by the argument of perigee
    a = almanac.sqrt_a**2
    along, across = a * (cosine - e), a * root * sine
    along_rate, across_rate = -a * sine * anomaly_rate, a * root * cosine * anomaly_rate
    cw, sw = np.cos(almanac.perigee), np.sin(almanac.perigee)
    x, y = cw * along - sw * across, sw * along + cw * across
    vx, vy = cw * along_rate - sw * across_rate, sw * along_rate + cw * across_rate
    node = almanac.node + almanac.node_rate * t - EARTH_SPIN * (t_axes + almanac.toa)
    node_rate = almanac.node_rate - EARTH_SPIN
    cn, sn = np.cos(node), np.sin(node)
    ci, si = np.cos(almanac.inclination), np.sin(almanac.inclination)
    r_e = np.stack((x * cn - y * ci * sn, x * sn + y * ci * cn, y * si), -1)
    v_e = np.stack(
        (vx * cn - vy * ci * sn - r_e[..., 1] * node_rate, vx * sn + vy * ci * cn + r_e[..., 0] * node_rate, vy * si),
        -1,
    )
    relativity = RELATIVITY * e * almanac.sqrt_a
    return SatelliteState(
        r_e, v_e, almanac.af0 + almanac.af1 * t + relativity * sine, almanac.af1 + relativity * cosine * anomaly_rate
    )


def signals(almanac: Almanac, t: Array, r_e: Array, v_e: Array) -> Signals:
    """Signals at an antenna at ``r_e`` [m] with velocity ``v_e`` [m/s] (T, 3) in ECEF at reception times ``t`` (T,).

    Light time τ: c τ = |r_s(t − τ) − r(t)|, solved to first order in τ from the satellite at t. What is left out,
    its acceleration over τ, is 2 mm of distance or 7 ps of τ, in which the satellite moves less than 1 µm.
    """
    now = satellite_state(almanac, t)
    distance, unit = direction(now.r_e, r_e)
    # speed of the satellite along the line of sight in inertial axes
    approach = np.einsum("tsi,tsi->ts", unit, now.v_e) + EARTH_SPIN * _spin_term(unit, r_e)
    emitted = satellite_state(almanac, t[:, None] - distance / (LIGHT + approach), t)
    distance, unit = direction(emitted.r_e, r_e)
    north, east, down = np.moveaxis(unit @ ned_at(r_e), -1, 0)
    return Signals(
        emitted,
        distance,
        range_rate(unit, emitted.v_e, v_e, r_e),
        np.arcsin(np.clip(-down, -1, 1)),
        np.arctan2(east, north),
    )


def range_rate(unit: Array, satellite_v_e: Array, v_e: Array, r_e: Array) -> Array:
    """d/dt of the distance [m/s] (T, S) by the line of sight ``unit`` (T, S, 3) from antenna to satellite.

    With cτ the distance, ρ̇ (1 + u·v_s/c) = u·(v_s − v): the satellite is that of t − τ, which changes as well.
    In the axes of reception the Earth's rotation cancels out of the right-hand side, and u·v_s is inertial.
    """
    closing = np.einsum("tsi,tsi->ts", unit, satellite_v_e - v_e[:, None])
    return closing / light_time_factor(unit, satellite_v_e, r_e)


def light_time_factor(unit: Array, satellite_v_e: Array, r_e: Array) -> Array:
    """1 + u·v_s/c (T, S), v_s inertial."""
    return 1 + (np.einsum("tsi,tsi->ts", unit, satellite_v_e) + EARTH_SPIN * _spin_term(unit, r_e)) / LIGHT


def ned_at(r_e: Array) -> Array:
    """C_en (T, 3, 3) at ECEF positions (T, 3): columns are North, East and Down."""
    lat, lon, _ = geodetic_from_ecef(torch.from_numpy(r_e))
    return ned_axes(lat, lon).numpy()


def direction(satellite_r_e: Array, r_e: Array) -> tuple[Array, Array]:
    """Distance (T, S) and unit vector from antenna to satellite (T, S, 3)."""
    offset = satellite_r_e - r_e[:, None]
    distance = np.sqrt(np.einsum("tsi,tsi->ts", offset, offset))
    return distance, offset / distance[..., None]


def _spin_term(unit: Array, r_e: Array) -> Array:
    """u·(z × r): with r_s − r along u, the satellite's and the antenna's are the same (T, S)."""
    return unit[..., 1] * r_e[:, None, 0] - unit[..., 0] * r_e[:, None, 1]
