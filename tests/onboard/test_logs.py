"""The core and the Python stream over logs as they are: real ones, and one of any rate."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.store import drive_rows
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.filters.build import build_filter
from dlkf.filters.shipped import trained_filter
from dlkf.onboard.c_source import write_source
from dlkf.onboard.library import build, find_compiler
from dlkf.running.streaming import StreamingFilter
from tests.cars import REAL
from tests.onboard.conftest import ARM, GRID, IMU, QUICK
from tests.onboard.core import Core
from tests.onboard.streams import Calls, apart, calls, through_core, through_python

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
SHORT = "linkoping", "comma2k19"
LONG = [pytest.param(name, marks=pytest.mark.exports) for name in ("rtkx", "wid", "wid_mru")]


def same(estimator, library: Path, sent: Calls, arm, limit: float, least: int = 20) -> None:
    """The same words, the same rows, the same state in between, to ``limit`` [m, m/s, rad]."""
    python = through_python(StreamingFilter(estimator, lever_arm_b=arm), sent)
    core = through_core(Core(library, arm), sent)
    assert python.words == core.words
    assert len(python.rows) > least
    assert apart(python.rows, core.rows) < limit
    assert apart(python.now, core.now) < limit


def sampled(tables: CheckedTables, t: np.ndarray, stamps: np.ndarray, end: float) -> CheckedTables:
    """A drive up to ``end`` [s] with the values at ``t`` under other stamps."""
    kept = t < end
    imu = {"t": stamps[kept], **{c: np.interp(t[kept], tables.imu["t"], tables.imu[c]) for c in (*ACCEL, *GYRO)}}
    return replace(tables, imu=imu, gnss={c: x[tables.gnss["t"] < end] for c, x in tables.gnss.items()})


@pytest.mark.parametrize("rate", [25, 104.3, 1000])
def test_samples_at_any_rate(rate, exported, tables):
    """The values of a drive on other stamps, which jitter by a tenth of an interval."""
    t = np.arange(tables.imu["t"][0], tables.imu["t"][-1], 1 / rate)
    t += np.random.default_rng(0).uniform(-0.1, 0.1, len(t)) / rate
    same(exported[1], exported[3].path, calls(sampled(tables, t, t, 40.0)), ARM, 1e-6)


def test_samples_at_40_hz_stamped_on_arrival(exported, tables):
    """A host's clock in milliseconds: late by some of them, and now and then three samples at once, some of which have
    one stamp."""
    g = np.random.default_rng(0)
    t = np.arange(tables.imu["t"][0], tables.imu["t"][-1], 1 / 40)
    arrival = t + 0.004 + g.exponential(0.003, len(t))
    for k in g.integers(0, len(t) - 3, 30):
        arrival[k : k + 3] = arrival[k + 2] + [0.0, 2e-4, 4e-4]
    sent = calls(sampled(tables, t, np.maximum.accumulate(arrival).round(3), 60.0))
    same(exported[1], exported[3].path, sent, ARM, 1e-6)
    assert Counter(through_core(Core(exported[3].path, ARM), sent).words)["double"] > 20


@pytest.mark.parametrize("dataset", [*SHORT, *LONG])
def test_real_logs_as_they_are(dataset, exported):
    """Rounding of the sums, amplified by minutes of a filter whose gate doubts poor fixes."""
    same_on_real(exported[1], exported[3].path, dataset, 0)


@pytest.mark.exports
@pytest.mark.parametrize("model", ["mbkf21_car", "plus"])
def test_every_real_log_through_the_filters_of_a_car(model, tmp_path):
    """As above; of ``plus`` the network's float32 takes part in it."""
    if not REAL.is_dir():
        pytest.skip("no real logs here")
    estimator = trained_filter("plus") if model == "plus" else build_filter(model, IMU)
    write_source(tmp_path, estimator, GRID, model, {})
    library = build(tmp_path, flags=QUICK)
    for dataset in sorted(x.name for x in REAL.iterdir() if (x / "drives.parquet").is_file()):
        for drive in range(len(drive_rows(REAL / dataset))):
            same_on_real(estimator, library, dataset, drive, least=-1)  # some cars never move


def same_on_real(estimator, library: Path, dataset: str, drive: int, least: int = 20) -> None:
    if not (REAL / dataset).is_dir():
        pytest.skip(f"no {dataset} here")
    tables = read_drive(REAL / dataset, drive_rows(REAL / dataset)[drive], reference=False)
    same(estimator, library, calls(tables), tables.row.lever_arm_b, 1e-3, least)
