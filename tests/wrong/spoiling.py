"""Ways to spoil a frame, and what a line that refuses it looks like."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

LONGEST = 600  # letters of a line
PI = np.pi / 180
Frames = dict[str, pd.DataFrame]


def put(column: str, row: int, value: Any) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """A value in one row."""

    def spoil(frame: pd.DataFrame) -> pd.DataFrame:
        values = frame[column].to_numpy(object if isinstance(value, str) else float).copy()
        values[row] = value
        return frame.assign(**{column: values})

    return spoil


def times(factor: float, *columns: str) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Columns in another unit."""
    return lambda frame: frame.assign(**{c: frame[c] * factor for c in columns})


def plus(seconds: float) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Another clock."""
    return lambda frame: frame.assign(t=frame.t + seconds)


def ddmm(frame: pd.DataFrame) -> pd.DataFrame:
    """Degrees and minutes as a receiver prints them."""
    return frame.assign(**{c: np.trunc(frame[c]) * 100 + frame[c] % 1 * 60 for c in ("lat_deg", "lon_deg")})


def check(line: str, said: str) -> None:
    """One line, short, which says this and names no file of the temporary dataset."""
    assert "\n" not in line and len(line) < LONGEST, line
    assert "drive=frames" not in line and "/tmp" not in line.replace("/tmp/pytest", ""), line
    assert said, line
    assert said in line, line
