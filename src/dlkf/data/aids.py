"""Samples of further sensors, reduced to one row for each update interval.

A sensor has its own rate and its own stamps; an update of a filter comes once per interval. So its samples of an
interval become one measurement: their mean (:data:`MEAN`, a speed) or the last one (:data:`LAST`, an angle), where in
the interval it lies, and how long a stretch it is the mean over. The filter compares it with what it predicts for just
that stretch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dlkf.data.aid_tables import LAST, AidTable
from dlkf.data.resampling import SampleGrid, find_boundary
from dlkf.data.tables import Columns

ROW = ("value", "std", "lag_s", "span_s", "count")  # of an update interval; a std of 0 is not known, a count of 0: none
LARGEST_VALUE = 1e9  # of a value in any unit: beyond is a mark of an invalid one, and sums of some overflow
SEA_LEVEL_PA, SCALE_M, EXPONENT = 101_325.0, 44_330.77, 0.190263  # of the international standard atmosphere


def aid_rows(table: AidTable, columns: Columns, grid: SampleGrid) -> np.ndarray:
    """(N + 1, 5) :data:`ROW` at the boundaries of a grid: of the samples in the interval that ends there."""
    value = aid_values(table, columns)
    std = columns.get("std", np.full(len(value), np.nan))
    place = find_boundary(columns["t"], grid)
    good = (np.abs(value) <= LARGEST_VALUE) & (place >= 1) & (place <= grid.epochs)
    lag = np.clip(grid.boundaries[place[good]] - columns["t"][good], 0.0, None)
    return _reduce(table, place[good], value[good], std[good], lag, grid.epochs + 1)


def _reduce(
    table: AidTable, place: np.ndarray, value: np.ndarray, std: np.ndarray, lag: np.ndarray, rows: int
) -> np.ndarray:
    """(rows, 5) :data:`ROW` of samples in order of time, each at its boundary."""
    if table.reduce == LAST:
        last = np.flatnonzero(np.append(np.diff(place) > 0, True)) if len(place) else np.zeros(0, dtype=np.int64)
        place, value, std, lag = (x[last] for x in (place, value, std, lag))

    def mean(x: np.ndarray) -> np.ndarray:
        return np.bincount(place, x, rows) / np.maximum(count, 1)

    count = np.bincount(place, minlength=rows).astype(float)
    first, last = np.zeros(rows), np.full(rows, np.inf)
    np.maximum.at(first, place, lag)
    np.minimum.at(last, place, lag)
    several = count > 1
    span = np.where(several, (first - np.where(several, last, 0.0)) * count / np.maximum(count - 1, 1), 0.0)
    variance = mean(std * std)
    known = np.where(np.isfinite(variance), np.sqrt(np.where(np.isfinite(variance), variance, 0.0)), 0.0)
    return np.stack((mean(value), known, mean(lag), span, count), -1)


def aid_row(table: AidTable, samples: Sequence[tuple[float, float, float]], boundary: float) -> np.ndarray:
    """(1, 5) :data:`ROW` of the samples (t, value, std) of one interval, whose end is at ``boundary``."""
    if not samples:
        return np.zeros((1, len(ROW)))
    t, value, std = np.array(sorted(samples)).T
    return _reduce(table, np.zeros(len(t), dtype=np.int64), value, std, np.clip(boundary - t, 0.0, None), 1)


def aid_values(table: AidTable, columns: Columns) -> np.ndarray:
    """The values of a table; heights of a barometer that gives pressures by the standard atmosphere."""
    if table.name == "baro":
        unknown = np.full(len(columns["t"]), np.nan)
        height, pressure = columns.get("height_m", unknown), columns.get("pressure", unknown)
        return np.where(np.isfinite(height), height, pressure_height(pressure))
    return columns[table.column]


def pressure_height(pressure: np.ndarray) -> np.ndarray:
    """Height [m] in the international standard atmosphere of a pressure [Pa]."""
    return SCALE_M * (1 - (pressure / SEA_LEVEL_PA) ** EXPONENT)
