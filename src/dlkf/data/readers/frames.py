"""What passes between the steps of reading: a file's table as it stands, and one drive in the contract's columns."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

Place = tuple[Path, str, Path | None]  # of a drive: its folder, its name, the one file that counts if there is one


@dataclass(frozen=True)
class LogTable:
    """A table of a log file in the file's own columns and units.

    The index of ``frame`` numbers its rows as ``row`` calls them (line of a text file, row, message), for messages to
    the user; ``notes`` are messages of the reader, ``beside`` further files whose rows follow.
    """

    frame: pd.DataFrame
    path: Path
    row: str = "row"
    notes: tuple[str, ...] = ()
    beside: tuple[Path, ...] = ()


@dataclass(frozen=True)
class DriveFrames:
    """A drive in contract units, axes and columns; ``meta`` is its row of ``drives.parquet``.

    ``notes`` are what the reader reports; ``mapping`` explains the log so that it reads the same again;
    ``aids`` are tables of further sensors by name (:data:`dlkf.data.schema.AIDS`).
    """

    meta: dict[str, Any]
    imu: pd.DataFrame
    gnss: pd.DataFrame | None
    reference: pd.DataFrame | None = field(default=None)
    notes: tuple[str, ...] = ()
    mapping: dict[str, Any] = field(default_factory=dict)
    aids: dict[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The drive's name."""
        return str(self.meta["drive"])
