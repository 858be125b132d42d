"""The core and the Python stream over logs as they are: real ones, and one of any rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.store import drive_rows
from dlkf.data.validate import read_checked
from dlkf.filters.build import build_filter
from dlkf.filters.shipped import trained_filter
from dlkf.onboard.c_source import write_source
from dlkf.onboard.core import Core
from dlkf.onboard.library import build, compiler
from dlkf.running.streaming import StreamingFilter
from tests.onboard.conftest import ARM, GRID, IMU, QUICK
from tests.onboard.streams import Calls, apart, calls, through_core, through_python

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler here")
REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "real"
LONG = (("rtkx", 0), ("wid", 2))
DRIVES = (("wid", 0), ("wid_mru", 0), ("linkoping", 0), *(pytest.param(*x, marks=pytest.mark.exports) for x in LONG))


def same(estimator, library: Path, sent: Calls, arm, limit: float) -> None:
    """The same words, the same rows, the same state in between, to ``limit`` [m, m/s, rad]."""
    python = through_python(StreamingFilter(estimator, lever_arm_b=arm), sent)
    core = through_core(Core(library, arm), sent)
    assert python.words == core.words
    assert len(python.rows) > 20
    assert apart(python.rows, core.rows) < limit
    assert apart(python.now, core.now) < limit


@pytest.mark.parametrize("rate", [25, 104.3, 400, 1000])
def test_samples_at_any_rate(rate, exported, tables):
    """The values of a drive on other stamps, which jitter by a tenth of an interval."""
    t = np.arange(tables.imu["t"][0], tables.imu["t"][-1], 1 / rate)
    t += np.random.default_rng(0).uniform(-0.1, 0.1, len(t)) / rate
    imu = {"t": t, **{c: np.interp(t, tables.imu["t"], tables.imu[c]) for c in (*ACCEL, *GYRO)}}
    kept = tables.gnss["t"] < 40
    gnss = {c: x[kept] for c, x in tables.gnss.items()}
    imu = {c: x[t < 40] for c, x in imu.items()}
    same(exported[1], exported[3].path, calls(replace(tables, imu=imu, gnss=gnss)), ARM, 1e-6)


@pytest.mark.parametrize("dataset,drive", DRIVES)
def test_real_logs_as_they_are(dataset, drive, exported):
    """Rounding of the sums, amplified by minutes of a filter whose gate doubts poor fixes."""
    same_on_real(exported[1], exported[3].path, dataset, drive)


@pytest.mark.exports
@pytest.mark.parametrize("model", ["mbkf21_car", "plus"])
def test_real_logs_through_the_filters_of_a_car(model, tmp_path):
    """As above; of ``plus`` the network's float32 takes part in it."""
    estimator = trained_filter("plus") if model == "plus" else build_filter(model, IMU)
    write_source(tmp_path, estimator, GRID, model, {})
    library = build(tmp_path, flags=QUICK)
    for dataset, drive in LONG[:1]:
        same_on_real(estimator, library, dataset, drive)


def same_on_real(estimator, library: Path, dataset: str, drive: int) -> None:
    if not (REAL / dataset).is_dir():
        pytest.skip(f"no {dataset} here")
    tables = read_checked(REAL / dataset, drive_rows(REAL / dataset)[drive], reference=False)
    same(estimator, library, calls(tables), tables.row.lever_arm_b, 1e-3)
