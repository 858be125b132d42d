"""GNSS fixes and raw observations of a drive, from the satellites above it or with white noise, and how a receiver
reports them: delayed, with a scaled std, and with gaps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.data.readers.units import WEEK_S
from dlkf.data.schema import STD
from dlkf.navigation.earth import ecef_from_geodetic, ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.simulation.gnss.almanac import Almanac, read_almanac
from dlkf.simulation.gnss.least_squares import LeastSquaresFix, Observations, solve
from dlkf.simulation.gnss.receiver import Receiver, clock, range_errors
from dlkf.simulation.gnss.satellites import L1, LIGHT, Signals, ned_at, signals
from dlkf.simulation.gnss.surroundings import Sky, hold_visibility, in_view
from dlkf.simulation.gnss.white import FLOAT, GnssConfig, antenna_states, episodes, observe, shift_positions
from dlkf.simulation.motion.vehicle import Truth
from dlkf.simulation.tables import fix_columns

Array = NDArray[np.floating]
FOR_FIX = 5  # satellites that resolve carrier ambiguities


class Received(NamedTuple):
    """``fixes``: GNSS table of the data contract; from satellites with satellites, gdop, pdop, hdop, vdop on top.

    A row without a fix has quality 0 and NaN. ``raw``: a row per epoch and tracked satellite; t; gps_week, tow
    [s]; prn; pseudorange_m and pseudorange_rate [m/s] as measured, with both clocks in them, doppler_hz; their
    1σ; elevation, azimuth [rad]; sat_x|y|z_m, sat_vx|y|z: the satellite at emission in the ECEF axes of
    reception; sat_clock_s, sat_clock_rate. So

        pseudorange = |r_s − r| + receiver clock − c · sat_clock + error
    """

    fixes: pd.DataFrame
    raw: pd.DataFrame | None


def receive(
    rng: np.random.Generator,
    truth: Truth,
    rate_b: Array,
    config: GnssConfig,
    receiver: Receiver | None,
    sky: Sky | None,
) -> Received:
    """GNSS at every row of ``truth``: white noise around the truth without a ``receiver``, else from satellites."""
    (reporting_rng,) = rng.spawn(1)
    if receiver is None:
        received = Received(observe(rng, truth, rate_b, config, sky), None)
    else:
        received = observe_satellites(rng, truth, rate_b, config, receiver, sky)
    return Received(report_fixes(reporting_rng, received.fixes, config), received.raw)


def delay_fixes(
    truth: Truth, rate_b: Array, rows: NDArray[np.int64], config: GnssConfig, rate_hz: float
) -> tuple[Truth, Array]:
    """The truth of which the fixes stamped with the times of ``rows`` are made, and the body's rate there (N, 3).

    Position and velocity of the antenna are those of ``position_lag_s`` and ``velocity_lag_s`` before, to the nearest
    sample; the time is the stamp. Where they differ, the body is moved so that its antenna is where it was.
    """
    earlier = [np.maximum(rows - round(lag * rate_hz), 0) for lag in (config.position_lag_s, config.velocity_lag_s)]
    place, moving = (truth.at(k) for k in earlier)
    swing = rate_b[earlier[1]]
    if config.position_lag_s == config.velocity_lag_s:
        where = place.lat, place.lon, place.height
    else:
        arms = [antenna_states(x, rate_b[k], config.lever_arm_b)[0] for x, k in zip((place, moving), earlier)]
        where = shift_positions(place, arms[0] - arms[1])
    return Truth(truth.t[rows], *where, moving.v_n, moving.rpy), swing


def report_fixes(rng: np.random.Generator, fixes: pd.DataFrame, config: GnssConfig) -> pd.DataFrame:
    """The fixes with stds of ``std_factor`` times what they are, and gaps of ``dropout_s`` on average (exponential)
    that make ``dropout_share`` of the time."""
    if config.std_factor != 1:
        fixes = fixes.assign(**{name: config.std_factor * fixes[name] for name in STD})
    if config.dropout_share > 0:
        lost = episodes(rng, fixes.t.to_numpy(), config.dropout_share, config.dropout_s)
        fixes = fixes.loc[~lost].reset_index(drop=True)
    return fixes


def observe_satellites(
    rng: np.random.Generator, truth: Truth, rate_b: Array, config: GnssConfig, receiver: Receiver, sky: Sky | None
) -> Received:
    """What a receiver makes of the satellites at every row of ``truth`` (uniform in time), by least squares.

    The drive starts at a random second of the almanac's week. ``rate_b`` (N, 3) is the body's ω_ib [rad/s], for
    the antenna; s_p, s_v of ``config`` are added to the fix (paper eqs 12, 13; R130).
    """
    almanac = read_almanac(receiver.almanac)
    rows = len(truth.t)
    dt = float(truth.t[1] - truth.t[0]) if rows > 1 else 1.0
    start = float(rng.integers(WEEK_S))
    offset_n, v_n = antenna_states(truth, rate_b, config.lever_arm_b)
    lat, lon, height = (torch.from_numpy(x) for x in shift_positions(truth, offset_n))
    r_e = ecef_from_geodetic(lat, lon, height).numpy()
    v_e = (ned_axes(lat, lon).numpy() @ v_n[..., None])[..., 0]
    seen = signals(almanac, start - almanac.toa + truth.t - truth.t[0], r_e, v_e)
    view = seen.elevation > np.radians(receiver.mask_deg)
    if sky is not None:
        view &= in_view(sky, truth.rpy[:, 2], seen.elevation, seen.azimuth)
    used = hold_visibility(view, round(receiver.reacquire_s / dt))
    fixed = hold_visibility(used.sum(-1) >= FOR_FIX, round(receiver.refix_s / dt))
    is_float = ~fixed & (receiver.ambiguity > 0)
    errors = range_errors(rng, receiver, seen.elevation, is_float, dt)
    offset, drift = clock(rng, receiver, rows, dt)
    geometric = seen.distance + errors.range + offset[:, None]
    rate = seen.distance_rate + errors.rate + drift[:, None]
    observed = Observations(seen.satellite, geometric, rate, used, errors.variance, errors.rate_variance, errors.common)
    solution = solve(observed)
    added = rng.standard_normal((rows, 6)) * np.repeat((config.s_p, config.s_v), 3)
    fix = solution.solved & (solution.dop.pdop <= receiver.max_pdop)
    quality = np.where(fix, np.where(is_float, FLOAT, receiver.quality), 0)
    fixes = _fixes(truth.t, solution, quality, added, (config.s_p, config.s_v))
    return Received(fixes, _raw(truth.t, start, almanac, seen, observed))


def _fixes(
    t: Array, solution: LeastSquaresFix, quality: NDArray[np.int64], added_n: Array, scale: tuple[float, float]
) -> pd.DataFrame:
    """The table of fixes in latitude, longitude, height and NED, with noise ``added_n`` (T, 6) of ``scale`` on top."""
    fix = quality > 0
    r_e = np.where(fix[:, None], solution.r_e, np.nan)
    C_en = ned_at(r_e)
    place = torch.from_numpy(r_e + (C_en @ added_n[:, :3, None])[..., 0])
    lat, lon, height = (x.numpy() for x in geodetic_from_ecef(place))
    v_n = (np.swapaxes(C_en, -1, -2) @ solution.v_e[..., None])[..., 0] + added_n[:, 3:]
    std = [
        np.sqrt(np.einsum("tij,tik,tkj->tj", C_en, covariance[:, :3, :3], C_en) + added**2)
        for covariance, added in zip((solution.covariance, solution.rate_covariance), scale)
    ]
    table = fix_columns(t, lat, lon, height, v_n, np.concatenate(std, -1), quality)
    known = solution.satellites >= 4
    dops = {f"{d}dop": np.where(known, getattr(solution.dop, f"{d}dop"), np.nan) for d in "gphv"}
    return pd.DataFrame({**table, "satellites": solution.satellites, **dops})


def _raw(t: Array, start: float, almanac: Almanac, seen: Signals, observed: Observations) -> pd.DataFrame:
    """The tracked satellites' observations as rows, in order of time and satellite."""
    row, column = np.nonzero(observed.used)
    tow = start + t - t[0]
    satellite = seen.satellite
    sat_clock, sat_rate = satellite.clock[row, column], satellite.clock_rate[row, column]
    rate = observed.pseudorange_rate[row, column] - LIGHT * sat_rate
    variance = observed.variance + (observed.common**2).sum(0)
    return pd.DataFrame(
        {
            "t": t[row],
            "gps_week": almanac.week + (tow // WEEK_S).astype(np.int64)[row],
            "tow": (tow % WEEK_S)[row],
            "prn": almanac.prn[column],
            "pseudorange_m": observed.pseudorange[row, column] - LIGHT * sat_clock,
            "pseudorange_rate": rate,
            "doppler_hz": -L1 / LIGHT * rate,
            "std_pseudorange_m": np.sqrt(variance[row, column]),
            "std_pseudorange_rate": np.sqrt(observed.rate_variance[row, column]),
            "elevation": seen.elevation[row, column],
            "azimuth": seen.azimuth[row, column],
            **{f"sat_{axis}_m": satellite.r_e[row, column, k] for k, axis in enumerate("xyz")},
            **{f"sat_v{axis}": satellite.v_e[row, column, k] for k, axis in enumerate("xyz")},
            "sat_clock_s": sat_clock,
            "sat_clock_rate": sat_rate,
        }
    )
