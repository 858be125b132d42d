"""Metrics: errors of a filter against the truth, and their statistics.

All functions are pure and work on numpy arrays with P segments (rows), T epochs and, after the last update
that an outage allows, W outages. Two marks have a meaning everywhere: **NaN** = there is no truth to compare
with (it is left out), **inf** = the filter's own output was not finite (it counts, and shows).
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from dlkf.data.drive import Batch
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import NavState

LEAST_LOG = -50.0  # what the logarithm of an exact zero counts as in a geometric mean
Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

# Quantity → unit in which it is stored; tables show radians as degrees.
QUANTITIES: dict[str, str] = {
    "position": "m",
    "horizontal": "m",
    "vertical": "m",
    "velocity": "m/s",
    "attitude": "rad",
    "heading": "rad",
}


def error_series(batch: Batch, state: NavState) -> Array:
    """Truth − estimate in true local NED, (B, T, 9): position [m], velocity [m/s], attitude log(C Ĉᵀ) [rad].

    NaN where the truth (or its attitude) is unknown or the epoch is padding; inf where the truth is known and
    the estimate is not finite.
    """
    estimate = NavState(*(x.detach().cpu().double() for x in state))
    truth = NavState(*(x.cpu().double() for x in batch.truth))
    error = estimate.error_to(truth).unflatten(-1, (3, 3))  # rows: position, velocity, attitude
    lat, lon, _ = geodetic_from_ecef(batch.frame.to_ecef(batch.truth.p_n.double()))
    C_ln = ned_axes(lat, lon).mT @ batch.frame.C_en.cpu().double().unsqueeze(1)  # (B, T, 3, 3), at the true position
    error = torch.einsum("btij,btkj->btki", C_ln, error).flatten(-2).numpy()
    known = (batch.truth_valid & batch.present).cpu().numpy()
    level = known & batch.attitude_valid.cpu().numpy()
    valid = np.concatenate((np.repeat(known[..., None], 6, -1), np.repeat(level[..., None], 3, -1)), -1)
    return np.where(valid, np.where(np.isfinite(error), error, np.inf), np.nan)


def magnitudes(error: Array) -> dict[str, Array]:
    """The six scalar errors of QUANTITIES from a 9-vector error (..., 9); each (...)."""
    p, v, a = error[..., 0:3], error[..., 3:6], error[..., 6:9]
    return {
        "position": np.linalg.norm(p, axis=-1),
        "horizontal": np.hypot(p[..., 0], p[..., 1]),
        "vertical": np.abs(p[..., 2]),
        "velocity": np.linalg.norm(v, axis=-1),
        "attitude": np.linalg.norm(a, axis=-1),
        "heading": np.abs(a[..., 2]),
    }


def segment_rms(x: Array, mask: Mask | None = None) -> Array:
    """RMS over the epochs of each segment, √(Σ x²/n): (P, T) → (P,), NaN where a segment has no valid epoch."""
    valid = ~np.isnan(x) if mask is None else mask & ~np.isnan(x)
    n = valid.sum(-1)
    total = np.where(valid, x, 0.0) ** 2
    return np.where(n > 0, np.sqrt(total.sum(-1) / np.maximum(n, 1)), np.nan)


def rms_over_segments(x: Array) -> Array:
    """RMS over segments at each epoch: (P, T) → (T,), NaN where no segment has truth."""
    return segment_rms(x.T)


def summarise_errors(values: Array) -> dict[str, float]:
    """n, RMS, mean, geometric mean, median, 95 % and maximum over segments or outages; NaN left out, inf counted."""
    x = np.asarray(values, float)
    x = x[~np.isnan(x)]
    if x.size == 0:
        nothing = dict.fromkeys(("rms", "mean", "geomean", "median", "p95", "max"), float("nan"))
        return {"n": 0, **nothing, "nonfinite": 0}
    finite = np.isfinite(x)
    method = "linear" if finite.all() else "higher"  # inf cannot be interpolated
    return {
        "n": int(x.size),
        "rms": float(np.sqrt(np.mean(x**2))),
        "mean": float(np.mean(x)),
        "geomean": geometric_mean(x),
        "median": float(np.percentile(x, 50, method=method)),
        "p95": float(np.percentile(x, 95, method=method)),
        "max": float(x.max()),
        "nonfinite": int((~finite).sum()),
    }


def geometric_mean(x: Array) -> float:
    """exp of the mean logarithm of |x|, to which every value counts alike; an exact zero counts as e⁻⁵⁰."""
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.maximum(np.log(np.abs(x)), LEAST_LOG))))


class OutageIntervals(NamedTuple):
    """W outages: segment, first epoch without a fix, number of epochs without one; each (W,)."""

    segment: NDArray[np.int64]
    first: NDArray[np.int64]
    length: NDArray[np.int64]

    @property
    def last(self) -> NDArray[np.int64]:
        """Last epoch without a fix."""
        return self.first + self.length - 1


def outage_intervals(outage: Mask) -> OutageIntervals:
    """Runs of True in each row of an outage mask (P, T), in row order."""
    padded = np.pad(np.asarray(outage, np.int8), ((0, 0), (1, 1)))
    change = np.diff(padded, axis=-1)
    segment, first = np.nonzero(change == 1)
    _, stop = np.nonzero(change == -1)
    return OutageIntervals(segment, first, stop - first)


def outage_end(x: Array, w: OutageIntervals) -> Array:
    """Value at the end of each outage, before GNSS is back: (P, T) → (W,)."""
    return x[w.segment, w.last]


def end_errors(batch: Batch, state: NavState) -> Array:
    """Horizontal error [m] at the end of every outage of a batch whose masks are applied; inf where not finite.

    What tuning, the choice of weights and the tables go by, so that all of them mean the same. An outage that the
    truth does not reach to its end counts as long as the truth does.
    """
    hidden = (~batch.available & batch.truth_valid & batch.present).cpu().numpy()
    off = (state.p_n.detach().double() - batch.truth.p_n.to(state.p_n.device).double())[..., :2].norm(dim=-1)
    return outage_end(np.nan_to_num(off.cpu().numpy(), nan=np.inf), outage_intervals(hidden))


def segment_errors(batch: Batch, state: NavState) -> Array:
    """RMS over each segment of position [m], velocity [m/s] and attitude [rad], (B, 3), the measure of the paper's
    tables (R120); NaN without truth, inf where not finite."""
    size = magnitudes(error_series(batch, state))
    return np.stack([segment_rms(size[name]) for name in ("position", "velocity", "attitude")], -1)


OBJECTIVES = ("log", "rms", "median")
PVA = "pva"  # the objective of whole segments, with or without outages


def mean_error(errors: Array, objective: str) -> float:
    """One number of many errors [m]: geometric mean (``log``), to which every outage counts alike, ``median``, or
    ``rms``, which a few hard ones decide. NaN without errors, inf where one is not finite."""
    if not len(errors) or not np.isfinite(errors).all():
        return float("inf") if len(errors) else float("nan")
    if objective == "rms":
        return float(np.sqrt(np.mean(errors**2)))
    return float(np.median(errors)) if objective == "median" else geometric_mean(errors)


def outage_at(x: Array, w: OutageIntervals, seconds: Array, epoch_s: float) -> Array:
    """Value ``seconds`` (K,) after the last fix: (P, T) → (W, K), NaN where the outage is shorter."""
    steps = np.rint(np.asarray(seconds, float) / epoch_s).astype(int)
    column = w.first[:, None] + steps - 1
    inside = (steps >= 1) & (steps <= w.length[:, None])
    return np.where(inside, x[w.segment[:, None], np.clip(column, 0, x.shape[1] - 1)], np.nan)


def outage_rms(x: Array, w: OutageIntervals) -> Array:
    """RMS over the epochs of each outage: (P, T) → (W,)."""
    epoch = np.arange(x.shape[1])
    inside = (epoch >= w.first[:, None]) & (epoch <= w.last[:, None])
    return segment_rms(x[w.segment], inside)


def outage_distance(v_truth: Array, w: OutageIntervals, epoch_s: float) -> Array:
    """Horizontal distance driven in each outage [m] from the true velocity (P, T, 3) at the epochs' ends.

    Trapezoid over the outage's epochs; where the velocity before one is missing, as at the start of an outage without
    truth there, that at its end counts for all of it. A missing velocity at the end of an epoch makes the distance NaN.
    """
    speed = np.hypot(v_truth[..., 0], v_truth[..., 1])
    before = np.concatenate((speed[:, :1], speed[:, :-1]), -1)
    before = np.where(np.isnan(before), speed, before)
    step = 0.5 * (speed + before) * epoch_s
    cumulative = np.concatenate((np.zeros((len(step), 1)), np.cumsum(np.nan_to_num(step), -1)), -1)
    missing = np.concatenate((np.zeros((len(step), 1)), np.cumsum(np.isnan(step), -1)), -1)
    gaps = missing[w.segment, w.last + 1] - missing[w.segment, w.first]
    return np.where(gaps > 0, np.nan, cumulative[w.segment, w.last + 1] - cumulative[w.segment, w.first])


def slope(estimate: Array, cause: Array, *, intercept: bool) -> Array:
    """Least-squares slope per axis of an IMU-error estimate against what caused it (paper.md 4.7).

    1 = the filter estimates the error, 0 = it has memorised one. ``estimate`` and ``cause`` (P, 6). With
    ``intercept`` across drives of different true error; without, of the change of the estimate against a
    bias injected into the same drives. NaN where an axis has too few or too equal causes.
    """
    valid = np.isfinite(estimate) & np.isfinite(cause)
    n = valid.sum(0)
    x, y = np.where(valid, cause, np.nan), np.where(valid, estimate, np.nan)
    if intercept:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # an axis without any value: NaN is the answer
            x, y = x - np.nanmean(x, 0), y - np.nanmean(y, 0)
    power = np.nansum(x * x, 0)
    scale = np.nanmax(np.abs(np.where(valid, cause, 0.0)), 0, initial=0.0)
    enough = (n > (2 if intercept else 0)) & (power > n * (1e-6 * scale) ** 2) & (power > 0)
    return np.where(enough, np.nansum(x * y, 0) / np.where(enough, power, 1.0), np.nan)
