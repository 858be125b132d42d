"""One drive on a uniform grid: composed IMU samples, fixes in epochs, reference at the boundaries."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data import compiled_samples
from dlkf.data.increments import merge_increments, two_sample
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, IMU_ERROR, POSITION, STD, VELOCITY, stack_columns
from dlkf.data.tables import Columns
from dlkf.data.validate import usable_fixes
from dlkf.navigation.attitude import rotation_from_rpy, rotation_from_vector, vector_from_rotation
from dlkf.navigation.compiled import loops_are_loaded
from dlkf.navigation.earth import ecef_from_geodetic, ned_axes

ON_BOUNDARY_S = 1e-3  # a fix this close to a boundary counts as on it
LONGEST_BRIDGE_S = 1.1  # the reference is interpolated between samples no further apart
BLOCK = 4000  # samples of the grid that are composed at a time: what they need stays in the processor's cache
BEFORE = 3  # samples before the first that a block needs, for the interval before it and whether that is whole
SMALLEST_STD = 1e-3  # m, m/s
FARTHEST = 2**62  # boundary: where stamps beyond any clock are put
# horizontal position [m] and velocity [m/s] 1σ where a source gives none, by NMEA GGA quality
DEFAULT_STD = {4: (0.02, 0.05), 5: (0.3, 0.1), 2: (1.0, 0.1), 3: (1.0, 0.1), 9: (1.0, 0.1), 1: (2.5, 0.2)}
VERTICAL_FACTOR = 1.5  # of the default position std
USUAL_HZ, SLOW_HZ = 50.0, 40.0  # of the grid; of logs that have a grid of their own
FASTEST_HZ, LONGEST_S = 10_000.0, 60.0  # of an IMU, of an epoch: beyond these something was mistyped


@dataclass(frozen=True)
class SampleGrid:
    """N epochs of M samples from ``t0``; boundary k is at ``t0 + k·epoch_s``."""

    t0: float
    epoch_s: float
    epochs: int
    samples: int

    @property
    def boundaries(self) -> np.ndarray:
        """Times of the N+1 boundaries [s]."""
        return self.t0 + self.epoch_s * np.arange(self.epochs + 1)

    @property
    def sample_times(self) -> np.ndarray:
        """Times of the N·M+1 limits of the samples [s]."""
        return self.t0 + self.epoch_s / self.samples * np.arange(self.epochs * self.samples + 1)


def epoch_grid(t_imu: np.ndarray, t_fix: np.ndarray, rate_hz: float, epoch_s: float, drive: str) -> SampleGrid:
    """The grid inside the IMU's time whose boundaries the fixes fall on.

    Raises InputError if an epoch is no whole number of samples, or the drive is shorter than an epoch.
    """
    samples = samples_per_epoch(rate_hz, epoch_s)
    step = float(np.median(np.diff(t_imu)))
    first, last = t_imu[0] - step, t_imu[-1]  # the first sample covers the interval before its stamp
    slack = 0.5 * min(step, epoch_s / samples)
    phase = fix_phase(t_fix, epoch_s)
    t0 = phase + np.ceil((first - phase - slack) / epoch_s) * epoch_s
    epochs = int(np.floor((last - t0 + slack) / epoch_s))
    if epochs < 1:
        raise InputError(f"drive {drive}: only {last - first:.2f} s of IMU, shorter than an epoch of {epoch_s:g} s")
    return SampleGrid(float(t0), epoch_s, epochs, samples)


def check_rate(rate_hz: float | None, epoch_s: float | None) -> None:
    """InputError where one that is given is not above 0, or beyond what there is."""
    for name, given, most in (("rate_hz", rate_hz, FASTEST_HZ), ("epoch_s", epoch_s, LONGEST_S)):
        if given is not None and not 0 < given <= most:
            raise InputError(f"{name} is {given!r}, must be above 0 and at most {most:g}")


def usual_rate(rates: Iterable[float], epoch_s: float = 1.0) -> float:
    """Samples a second of the grid for logs with so many [Hz]: 50, or where all are slower than 40 Hz as many as the
    fastest, in whole ones an epoch.

    A sample that is held over several of the grid has images of its spectrum beyond half its own rate, which speed from
    vibration (up to 20 Hz) would take for the car's.
    """
    fastest = max(rates, default=USUAL_HZ)
    return USUAL_HZ if fastest >= SLOW_HZ else max(1, round(fastest * epoch_s)) / epoch_s


def samples_per_epoch(rate_hz: float, epoch_s: float) -> int:
    """Samples in an epoch; InputError if that is no whole number, or one of the two is out of range."""
    check_rate(rate_hz, epoch_s)
    samples = round(rate_hz * epoch_s)
    if samples < 1 or abs(samples - rate_hz * epoch_s) > 1e-6:
        near = max(round(epoch_s * rate_hz), 1) / rate_hz
        raise InputError(
            f"rate_hz={rate_hz:g}, epoch_s={epoch_s:g}: an epoch must hold a whole number of samples, such as "
            f"epoch_s={near:.6g}"
        )
    return samples


def fix_phase(t: np.ndarray, epoch_s: float) -> float:
    """Phase of the fixes in an epoch [s]: their circular median where that is where most of them are.

    Several fixes in an epoch (5 Hz) or jittering ones have no such phase: then the most frequent one of 1 ms
    width, and the latest of jittering fixes, so that a fix waits as little as can be for its boundary.
    """
    if not len(t):
        return 0.0
    phase = np.mod(t, epoch_s)
    mean = np.exp(2j * np.pi * phase / epoch_s).mean()
    centre = np.angle(mean) / (2 * np.pi) * epoch_s if abs(mean) > 0.5 else phase[0]
    around = wrap_angle(phase - centre, epoch_s / 2)
    if abs(mean) > 0.5:
        median = float(np.median(around))
        settled = np.mean(np.abs(around - median) <= ON_BOUNDARY_S) > 0.5
        return float(centre + (median if settled else np.quantile(around, 0.95)))
    bins, counts = np.unique(np.round(around / ON_BOUNDARY_S), return_counts=True)
    best = bins[counts.argmax()] * ON_BOUNDARY_S
    return float(centre + np.median(around[np.abs(around - best) <= ON_BOUNDARY_S]))


def resample_imu(imu: Columns, grid: SampleGrid, usual: float | None = None) -> np.ndarray:
    """Specific force and rate (N, M, 6), constant within each of the grid's samples, that act like the file's.

    A sample of the file is the mean over the interval that ends at its stamp. Its integral is corrected for coning
    and sculling from the interval before (:mod:`dlkf.data.increments`) and spread evenly over the interval; the grid's
    samples are composed of the segments of intervals inside them. So their integral is exact for whole ratios and
    unbiased for any other, and their rectified motion is that of the file's rate. Where stamps are missing (an
    interval over 1.5 ``usual`` ones [s], by default their median), the mean of the two neighbours fills the
    missing part.
    """
    t, at = imu["t"], grid.sample_times
    if usual is None:
        usual = float(np.median(np.diff(t)))
    step = grid.epoch_s / grid.samples
    if loops_are_loaded():
        columns = tuple(imu[c] for c in (*ACCEL, *GYRO))
        return compiled_samples.compose(t, columns, at, usual, step).reshape(grid.epochs, grid.samples, 6)
    out = np.empty((grid.epochs * grid.samples, 6))
    for first in range(0, len(out), BLOCK):
        last = min(first + BLOCK, len(out))
        begin = max(0, int(np.searchsorted(t, at[first], side="right")) - BEFORE)
        end = int(np.searchsorted(t, at[last])) + 1
        part = np.stack([imu[c][begin:end] for c in (*ACCEL, *GYRO)])
        out[first:last] = _compose(t[begin:end], part, at[first : last + 1], usual).T
    out /= step
    return out.reshape(grid.epochs, grid.samples, 6)


def _compose(t: np.ndarray, values: np.ndarray, at: np.ndarray, usual: float) -> np.ndarray:
    """Increments (6, m) between the limits ``at`` (m + 1,) of samples (6, n) that end at ``t``."""
    step = np.diff(t, prepend=t[0] - usual)
    whole = step <= 1.5 * usual
    integrals = values * np.where(whole, step, usual)
    missing = np.flatnonzero(~whole)
    integrals[:, missing] += 0.5 * (values[:, missing] + values[:, missing - 1]) * (step[missing] - usual)
    follows = whole & np.concatenate(([False], whole[:-1]))
    rates = two_sample(integrals, step, follows) / step
    # one interval more before the first, and one after the last, for the slack of the grid
    rates = np.concatenate((values[:, :1], rates, values[:, -1:]), 1)
    knots = np.concatenate((t[:1] - 2 * step[0], t[:1] - step[0], t, t[-1:] + step[-1]))
    times = np.concatenate((at, knots[(knots > at[0]) & (knots < at[-1])]))
    times.sort(kind="stable")
    place = np.searchsorted(knots, times[:-1], side="right") - 1
    segments = rates.take(place, 1, mode="clip") * np.diff(times)
    return merge_increments(segments, np.searchsorted(times, at[:-1]))


@dataclass(frozen=True)
class FixRows:
    """GNSS at the N+1 boundaries; the columns of :class:`dlkf.data.drive.Drive`."""

    r_e: np.ndarray
    v_e: np.ndarray
    std: np.ndarray
    valid: np.ndarray
    lag: np.ndarray
    quality: np.ndarray


# what a boundary without a fix holds
BLANK = {"r_e": np.nan, "v_e": np.nan, "std": np.nan, "valid": False, "lag": 0.0, "quality": 0}


def assign_fixes(gnss: Columns, grid: SampleGrid) -> FixRows:
    """Each fix to the first boundary at or after it; the latest in an epoch wins.

    A position that repeats the one before to the bit is that of the earlier time, so it does not count as a later one.
    Unknown stds (NaN, 0) take the defaults of ``DEFAULT_STD``; components that are NaN are not valid.
    """
    rows = grid.epochs + 1
    place = find_boundary(gnss["t"], grid)
    inside = np.flatnonzero(usable_fixes(gnss) & (place >= 0) & (place < rows))
    repeats = np.diff(place[inside], prepend=-1) == 0
    for column in POSITION:
        repeats &= np.diff(gnss[column][inside], prepend=np.nan) == 0
    inside, chosen = inside[~repeats], np.full(rows, -1)
    chosen[place[inside]] = inside  # rows are in order of time: the last assignment stays
    at = np.flatnonzero(chosen >= 0)
    found = make_fixes(gnss, chosen[at], grid.boundaries[at])
    return FixRows(*(_spread(getattr(found, name), at, rows, blank) for name, blank in BLANK.items()))


def find_boundary(t: np.ndarray, grid: SampleGrid) -> np.ndarray:
    """Number of the first boundary at or after times [s]; it may lie outside the grid."""
    return np.clip(np.ceil((t - grid.t0 - ON_BOUNDARY_S) / grid.epoch_s), -FARTHEST, FARTHEST).astype(np.int64)


def make_fixes(gnss: Columns, rows: np.ndarray, boundaries: np.ndarray) -> FixRows:
    """Some rows of a GNSS table as fixes of the boundaries [s] given for them."""
    r_e, v_e, C_en = _ecef(gnss, rows)
    quality = gnss["quality"][rows].astype(np.int64)
    default = np.array([default_std(int(q)) for q in quality]).reshape(-1, 6)
    std = np.stack([gnss[c][rows] for c in STD], -1)
    std = np.where(std > 0, np.maximum(std, SMALLEST_STD), default)  # a 1σ that a source does not fill is 0
    v_ned = np.stack([gnss[c][rows] for c in VELOCITY], -1)
    known = np.isfinite(v_ned)
    v_e = (C_en @ np.where(known, v_ned, 0.0)[..., None])[..., 0]
    lag = np.clip(boundaries - gnss["t"][rows], 0.0, None)
    lag[lag <= ON_BOUNDARY_S] = 0.0
    return FixRows(r_e, v_e, std, np.concatenate((np.ones_like(known), known), -1), lag, quality)


@dataclass(frozen=True)
class ReferenceStates:
    """Reference at the N+1 boundaries; the columns of :class:`dlkf.data.drive.Drive`."""

    r_e: np.ndarray
    v_e: np.ndarray
    C_eb: np.ndarray
    valid: np.ndarray
    imu_error: np.ndarray


def interpolate_reference(reference: Columns | None, grid: SampleGrid) -> ReferenceStates:
    """The reference interpolated to the boundaries, from samples that are both valid and close.

    Position by cubic Hermite with the velocities (linear where samples are dense), velocity and IMU error
    linear, attitude along the geodesic of SO(3). NaN and not valid elsewhere.
    """
    rows = grid.epochs + 1
    r_e, v_e, C_eb, imu_error = (np.full((rows, *shape), np.nan) for shape in ((3,), (3,), (3, 3), (6,)))
    out = ReferenceStates(r_e, v_e, C_eb, np.zeros(rows, bool), imu_error)
    if reference is None:
        return out
    known = reference["valid"] & np.isfinite(np.stack([reference[c] for c in (*POSITION, *VELOCITY)])).all(0)
    t, at = reference["t"], grid.boundaries
    if len(t) < 2:
        return out
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = t[i + 1] - t[i]
    s = (at - t[i]) / h
    nearest = np.where(np.abs(at - t[i]) <= np.abs(at - t[i + 1]), i, i + 1)
    between = known[i] & known[i + 1] & (h <= LONGEST_BRIDGE_S) & (s >= 0) & (s <= 1)
    alone = (np.abs(at - t[nearest]) <= ON_BOUNDARY_S) & known[nearest] & ~between
    exact = alone | (s == 0) | (s == 1)  # which a neighbour without attitude does not spoil
    rows_at = np.flatnonzero(between | alone)
    i, j = (np.where(exact, nearest, k)[rows_at] for k in (i, i + 1))
    s, h = np.where(exact, 0.0, s)[rows_at, None], h[rows_at, None]
    r0, v0, C0 = _ecef(reference, i, attitude=True)
    r1, v1, C1 = _ecef(reference, j, attitude=True)
    r_e = r0 + (r1 - r0) * (s * s * (3 - 2 * s)) + h * s * (1 - s) * ((1 - s) * v0 - s * v1)
    v_e = v0 + s * (v1 - v0)
    turn = vector_from_rotation(torch.from_numpy(C0.transpose(0, 2, 1) @ C1))
    C_eb = C0 @ rotation_from_vector(torch.from_numpy(s) * turn).numpy()
    error = np.full((len(i), 6), np.nan)
    if all(c in reference for c in IMU_ERROR):
        e = stack_columns(reference, IMU_ERROR)
        error = e[i] + s * (e[j] - e[i])
    out.r_e[rows_at], out.v_e[rows_at], out.C_eb[rows_at] = r_e, v_e, C_eb
    out.valid[rows_at], out.imu_error[rows_at] = True, error
    return out


def default_std(quality: int) -> tuple[float, ...]:
    """1σ [m, m/s] of a fix of which nothing but its NMEA GGA quality is known."""
    position, velocity = DEFAULT_STD[quality]
    return (position, position, VERTICAL_FACTOR * position, velocity, velocity, velocity)


def _spread(values: np.ndarray, at: np.ndarray, rows: int, fill: float | bool) -> np.ndarray:
    out = np.full((rows, *values.shape[1:]), fill, dtype=values.dtype)
    out[at] = values
    return out


def _ecef(table: Columns, rows: np.ndarray, attitude: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ECEF position and velocity, and C_en, or C_eb with ``attitude``, of some rows."""
    lat, lon = (torch.from_numpy(np.radians(table[c][rows])) for c in ("lat_deg", "lon_deg"))
    r_e = ecef_from_geodetic(lat, lon, torch.from_numpy(table["height_m"][rows]))
    C = ned_axes(lat, lon)
    v_e = (C @ torch.from_numpy(np.stack([table[c][rows] for c in VELOCITY], -1)).unsqueeze(-1)).squeeze(-1)
    if attitude:
        C = C @ rotation_from_rpy(torch.from_numpy(np.stack([table[c][rows] for c in ATTITUDE], -1)))
    return r_e.numpy(), v_e.numpy(), C.numpy()
