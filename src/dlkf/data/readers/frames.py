"""What every reader of foreign logs hands over: one drive as tables in the data contract's columns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pandas as pd


@dataclass(frozen=True)
class DriveFrames:
    """A drive in contract units, axes and columns; ``meta`` is its row of ``drives.parquet``."""

    meta: dict[str, Any]
    imu: pd.DataFrame
    gnss: pd.DataFrame
    reference: pd.DataFrame | None = field(default=None)

    @property
    def name(self) -> str:
        """The drive's name."""
        return str(self.meta["drive"])
