"""A filter in single precision: written by a process that has made nothing else, beside the same one in double."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dlkf.onboard.library import build, find_compiler
from dlkf.running.solution import COLUMNS
from tests.onboard.conftest import ARM
from tests.onboard.core import Core
from tests.onboard.streams import METRES, calls, through_core

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
ROOT = Path(__file__).parents[2]
WRITE = """
import sys
from pathlib import Path
import torch
from dlkf.data.aid_tables import STANDARD
from dlkf.filters.aids.attach import with_aids
from dlkf.filters.build import build_filter
from dlkf.onboard.c_source import write_source
from dlkf.onboard.functions import Grid
from tests.onboard.conftest import IMU, KIND
filter = with_aids(build_filter(KIND, IMU), STANDARD.values())
write_source(Path(sys.argv[1]), filter, Grid(50, 0.02, torch.float32), KIND, {})
"""
LIMITS = {"lat_deg": 0.01, "lon_deg": 0.01, "height_m": 0.01, "vel_n": 0.005, "vel_e": 0.005, "vel_d": 0.005,
          "roll": 1e-4, "pitch": 1e-4, "yaw": 1e-3}  # m, m/s, rad: of a minute  # fmt: skip


@pytest.mark.exports
def test_single_precision_beside_double(exported, tables, tmp_path):
    """Constants that the package keeps from call to call must not be made while it records: a new process has none."""
    subprocess.run([sys.executable, "-c", WRITE, tmp_path], cwd=ROOT, check=True)
    sent = calls(tables)
    double, single = (
        through_core(Core(path, ARM), sent) for path in (exported[3].path, build(tmp_path, flags=("-O0",)))
    )  # fmt: skip
    assert single.words == double.words and single.solution.shape == double.solution.shape
    apart = np.abs(single.solution - double.solution)
    for column, limit in LIMITS.items():
        assert 0 < apart[:, COLUMNS.index(column)].max() * METRES.get(column, 1.0) < limit
