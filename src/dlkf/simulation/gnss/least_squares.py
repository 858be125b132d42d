"""Position, velocity and clock of a receiver from pseudoranges and their rates: weighted least squares.

All epochs at once. Shapes: T epochs, S satellites, of which each epoch uses those where ``used`` is true.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlkf.simulation.gnss.satellites import SatelliteState, direction, light_time_factor, ned_at, range_rate

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]
FEWEST = 4  # satellites for position and clock (R019)
MOST_STEPS = 10
SETTLED = 1e-4  # m: Gauss-Newton is quadratic here, the step after one so small is below rounding


@dataclass(frozen=True)
class Observations:
    """What a receiver measured. ``pseudorange`` [m] and ``pseudorange_rate`` [m/s] (T, S), satellite clocks removed.

    ``variance`` and ``rate_variance`` (T, S) are of what is independent between satellites; ``common`` (K, T, S) is
    the 1σ [m] of K errors shared by all satellites of an epoch (a zenith delay times its mapping).
    """

    satellite: SatelliteState
    pseudorange: Array
    pseudorange_rate: Array
    used: Mask
    variance: Array
    rate_variance: Array
    common: Array


@dataclass(frozen=True)
class Dop:
    """Dilution of precision (T,): the roots of sums of the diagonal of (GᵀG)⁻¹ in north, east, down, time."""

    gdop: Array
    pdop: Array
    hdop: Array
    vdop: Array


@dataclass(frozen=True)
class LeastSquaresFix:
    """Least-squares solution of T epochs; where not ``solved`` the numbers mean nothing.

    ``r_e`` [m], ``v_e`` [m/s] (T, 3) in ECEF; ``clock`` [m], ``clock_rate`` [m/s] (T,) of the receiver;
    ``covariance`` and ``rate_covariance`` (T, 4, 4) of (r_e, clock) and (v_e, clock_rate).
    """

    r_e: Array
    v_e: Array
    clock: Array
    clock_rate: Array
    covariance: Array
    rate_covariance: Array
    dop: Dop
    satellites: NDArray[np.int64]
    solved: Mask


def solve(observed: Observations) -> LeastSquaresFix:
    """Weighted least squares of every epoch (Groves 9.4.1, 9.4.3).

    Gauss-Newton from the Earth's centre for the epoch with the most satellites; from there for all others.
    ``solved``: at least four satellites and converged.
    """
    enough = observed.used.sum(-1) >= FEWEST
    best = np.array([observed.used.sum(-1).argmax()])
    start = _gauss_newton(_rows(observed, best), np.zeros((1, 4)))[0]
    state, converged = _gauss_newton(observed, np.repeat(start, len(enough), 0))
    r_e, solved = state[:, :3], enough & converged
    unit = direction(observed.satellite.r_e, r_e)[1]
    geometry = _geometry(unit)
    weight = observed.used / (observed.variance + (observed.common**2).sum(0))
    gain = _gain(geometry, weight)
    covariance = _spread(gain, observed.variance, observed.common)
    rate_geometry = geometry.copy()
    rate_geometry[..., :3] /= light_time_factor(unit, observed.satellite.v_e, r_e)[..., None]
    rate_gain = _gain(rate_geometry, observed.used / observed.rate_variance)
    at_rest = range_rate(unit, observed.satellite.v_e, np.zeros_like(r_e), r_e)
    rate = _apply(rate_gain, observed.pseudorange_rate - at_rest)
    return LeastSquaresFix(
        r_e,
        rate[:, :3],
        state[:, 3],
        rate[:, 3],
        covariance,
        _spread(rate_gain, observed.rate_variance, observed.common[:0]),
        dilution(unit, observed.used, r_e),
        observed.used.sum(-1),
        solved,
    )


def dilution(unit: Array, used: Mask, r_e: Array) -> Dop:
    """Dilution of precision at positions ``r_e`` (T, 3) of the ``used`` satellites in directions ``unit`` (T, S, 3)."""
    turned = np.concatenate((unit @ ned_at(r_e), np.ones_like(unit[..., :1])), -1) * used[..., None]
    cofactor = np.linalg.inv(_regular(np.swapaxes(turned, -1, -2) @ turned))
    north, east, down, time = np.moveaxis(np.diagonal(cofactor, axis1=-2, axis2=-1), -1, 0)
    horizontal = north + east
    return Dop(*(np.sqrt(x) for x in (horizontal + down + time, horizontal + down, horizontal, down)))


def _gauss_newton(observed: Observations, state: Array) -> tuple[Array, Mask]:
    """Position [m] and clock [m] (T, 4) from a start, and whether each epoch converged."""
    weight = observed.used / (observed.variance + (observed.common**2).sum(0))
    enough = observed.used.sum(-1) >= FEWEST
    step = np.full(len(state), np.inf)
    for _ in range(MOST_STEPS):
        distance, unit = direction(observed.satellite.r_e, state[:, :3])
        change = _apply(_gain(_geometry(unit), weight), observed.pseudorange - distance - state[:, 3:])
        state = state + change
        step = np.abs(change).max(-1)
        if (step[enough] < SETTLED).all():
            break
    return state, step < SETTLED


def _geometry(unit: Array) -> Array:
    """G (T, S, 4): derivative of a pseudorange by position and clock, [−u, 1]."""
    return np.concatenate((-unit, np.ones_like(unit[..., :1])), -1)


def _gain(geometry: Array, weight: Array) -> Array:
    """(GᵀWG)⁻¹GᵀW (T, 4, S); of use only where four weights are positive and the satellites are not in a cone."""
    weighted = np.swapaxes(geometry * weight[..., None], -1, -2)
    return np.linalg.solve(_regular(weighted @ geometry), weighted)


def _regular(normal: Array) -> Array:
    """Normal matrices that can be inverted: those of epochs without a solution become the identity."""
    scale = np.trace(normal, axis1=-2, axis2=-1) / 4
    singular = np.linalg.det(normal / np.where(scale > 0, scale, 1)[:, None, None]) < 1e-12
    return np.where(singular[:, None, None], np.eye(4), normal)


def _apply(gain: Array, residual: Array) -> Array:
    return (gain @ residual[..., None])[..., 0]


def _spread(gain: Array, variance: Array, common: Array) -> Array:
    """Covariance K Σ Kᵀ (T, 4, 4) with Σ = diag(variance) + Σ_k m_k m_kᵀ, m_k the common errors' 1σ."""
    spread = (gain * variance[:, None]) @ np.swapaxes(gain, -1, -2)
    for error in common:
        shift = _apply(gain, error)
        spread += shift[:, :, None] * shift[:, None, :]
    return spread


def _rows(observed: Observations, rows: NDArray[np.int64]) -> Observations:
    satellite = SatelliteState(*(getattr(observed.satellite, n)[rows] for n in SatelliteState.__dataclass_fields__))
    o = observed
    return Observations(
        satellite, o.pseudorange[rows], o.pseudorange_rate[rows], o.used[rows], o.variance[rows],
        o.rate_variance[rows], o.common[:, rows],
    )  # fmt: skip
