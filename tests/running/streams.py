"""Filters, drives and comparisons for the tests of streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from dlkf.data.store import drive_from_tables
from dlkf.data.validate import CheckedTables
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.learned_kalman import LearnedKalmanConfig, LearnedKalmanFilter
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.running.offline import navigate_drives
from dlkf.running.replay import replay_drive
from dlkf.running.solution import estimates_table
from dlkf.running.streaming import StreamingFilter

IMU = ImuSpec(
    "mems", SensorErrors(2.5e-3, 0.02, 1e-3, 3600.0, 3e-3, 3e-3), SensorErrors(9e-5, 1e-3, 1e-4, 3600.0, 3e-3, 3e-3)
)
ARM = (1.0, 0.3, -1.2)
EARTH = 6.37e6  # m per radian


def network(**settings) -> LearnedFilter:
    """A small one whose heads have weights of some size, so that differences show."""
    torch.manual_seed(0)
    size = {"lstm_hidden": 16, "lstm_layers": 2, "dense": [24, 12]}
    model = LearnedFilter(LearnedConfig.from_mapping({"network": size, **settings})).eval()
    with torch.no_grad():
        model.gain.linear.weight.mul_(20)
        model.imu_error.linear.weight.mul_(50)
    return model.double()


def plus() -> PlusFilter:
    """A small one with weights."""
    torch.manual_seed(0)
    model = PlusFilter(PlusConfig.from_mapping({"network": {"hidden": 16}})).eval()
    for p in model.network.noise.parameters():
        torch.nn.init.normal_(p, std=0.2)
    return model.double()


def beside_kalman(base: str) -> LearnedKalmanFilter:
    """A network beside a Kalman filter; its heads change the gain by a tenth or so."""
    torch.manual_seed(0)
    size = {"lstm_hidden": 16, "lstm_layers": 2, "dense": [24, 12]}
    config = LearnedKalmanConfig.from_mapping({"network": size, "frame": "heading", "base": base})
    return LearnedKalmanFilter(config.with_base(IMU, Tuning(), None)).eval().double()


def estimator(name: str):
    if name == "plus":
        return plus()
    if name.startswith("dlkf_kalman"):
        return beside_kalman(name.removeprefix("dlkf_kalman_"))
    return network(outage_mode=name[4:]) if name.startswith("net_") else build_filter(name, IMU)


def batch(tables: CheckedTables, name: str) -> pd.DataFrame:
    whole = drive_from_tables(tables, "", 50.0, 1.0, torch.float64)
    return next(iter(navigate_drives([whole], estimator(name)))).table


def apart(a: pd.DataFrame, b: pd.DataFrame) -> float:
    """Largest difference of two solutions in any column; angles of position in metres."""
    assert len(a) == len(b) > 0
    scale = {"lat_deg": np.radians(EARTH), "lon_deg": np.radians(EARTH)}
    return max(float((a[c].astype(float) - b[c].astype(float)).abs().mul(scale.get(c, 1.0)).max()) for c in a
               if c != "geometry" and not a[c].isna().all())  # fmt: skip


def table(stream: StreamingFilter, tables: CheckedTables, **arrivals) -> pd.DataFrame:
    """All that a stream said of a drive, late fixes included."""
    found = {}
    for receipt in replay_drive(stream, tables.imu, tables.gnss, **arrivals):
        found.update((e.t, e) for e in receipt.estimates)
    return estimates_table(found[t] for t in sorted(found))


def some(tables: CheckedTables, keep: np.ndarray, kind: str) -> CheckedTables:
    return replace(tables, **{kind: {name: x[keep] for name, x in getattr(tables, kind).items()}})


def until(tables: CheckedTables, t: float) -> CheckedTables:
    for kind in ("imu", "gnss", "reference"):
        tables = some(tables, getattr(tables, kind)["t"] <= t + 1e-6, kind)
    return tables


# The same operations on the same numbers but for the rounding of sums over the samples and of the grid's times: 1e-13
# of values of 10, of latitudes of 1 rad 1e-9 m, which 90 closed-loop epochs do not let grow. A jump would show.
ROUNDING = 1e-8
