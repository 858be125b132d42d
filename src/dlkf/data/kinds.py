"""Is a drive simulated, semi-real or real? Their results are never mixed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dlkf.base.errors import InputError
from dlkf.data.tables import read_drives_table, read_first_stamps

KINDS = ("simulated", "semi-real", "real", "unknown")


def drive_kind(row: Mapping[Any, Any]) -> str:
    """Kind of one drive by its row of ``drives.parquet``.

    A column ``kind`` decides where there is one. Otherwise: a source marked as simulated is simulated;
    a synthetic or simulated GNSS or IMU on a real drive makes it semi-real; all else is real.
    """
    stated = row.get("kind")
    if isinstance(stated, str) and stated:
        if stated not in KINDS:
            raise InputError(
                f"drives.parquet: kind {stated!r} of drive {row.get('drive')} is none of {', '.join(KINDS)}"
            )
        return stated
    source, gnss, imu = (str(row.get(c, "")).lower() for c in ("source", "gnss", "imu"))
    if "simulat" in source:
        return "simulated"
    made_up = ("synthetic", "simulated", "injected")
    return "semi-real" if any(word in text for text in (gnss, imu) for word in made_up) else "real"


def drive_kinds(dataset: str | Path) -> dict[str, str]:
    """Kind of every drive of a dataset."""
    return {str(row["drive"]): drive_kind(row) for row in _rows(dataset)}


def drive_imus(dataset: str | Path) -> dict[str, str]:
    """What ``drives.parquet`` calls the IMU of every drive, of those that it names one of."""
    return {str(row["drive"]): row["imu"] for row in _rows(dataset) if isinstance(row.get("imu"), str) and row["imu"]}


def drive_rates(dataset: str | Path, drives: Iterable[str] | None = None) -> dict[str, float]:
    """Samples a second [Hz] of every drive's IMU, or of those named, by the median step of its first stamps."""
    names = [str(row["drive"]) for row in _rows(dataset)] if drives is None else drives
    steps = {drive: np.diff(read_first_stamps(dataset, drive)) for drive in names}
    return {drive: float(1 / np.median(step)) for drive, step in steps.items() if len(step) and np.median(step) > 0}


def _rows(dataset: str | Path) -> list[dict[Any, Any]]:
    return read_drives_table(dataset).to_dict("records")
