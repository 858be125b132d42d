"""A minute of a drive, for what newcomers get wrong with it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

Frames = dict[str, pd.DataFrame]


@pytest.fixture(scope="package")
def frames(simulated) -> Frames:
    """A minute of the first simulated drive, and a wheel that fits."""
    name = pd.read_parquet(simulated / "drives.parquet")["drive"][0]
    tables = {
        kind: pd.read_parquet(simulated / kind / f"drive={name}" / "part-0.parquet")
        for kind in ("imu", "gnss", "reference")
    }
    tables = {kind: table[table.t - table.t.iloc[0] < 60].reset_index(drop=True) for kind, table in tables.items()}
    fixes = tables["gnss"]
    tables["speed"] = pd.DataFrame({"t": fixes.t, "speed": np.hypot(fixes.vel_n, fixes.vel_e)})
    rows = tables["reference"].iloc[:: max(1, len(tables["reference"]) // len(fixes))]
    tables["heading"] = pd.DataFrame({"t": rows.t, "heading": rows.yaw})
    tables["baro"] = pd.DataFrame({"t": fixes.t, "pressure": 101_325.0 - 12 * fixes.height_m})
    return tables
