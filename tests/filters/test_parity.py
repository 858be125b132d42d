"""The filters against python-ins' feedback filter: same drive, same start error, same P₀, Q, R and outage."""

from __future__ import annotations

import numpy as np
import pytest
from pipelines.studies import parity

from dlkf.command.composing import imu_preset

STEP = 1.0  # s: theirs; at its default of 0.1 s the outages end nearer to ours, and take ten times as long


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """One drive of 100 s."""
    folder = tmp_path_factory.mktemp("parity") / "drives"
    parity.write_drives(folder, imu_preset("consumer"), 1, 100 / 60)
    return folder


@pytest.mark.parametrize("states", [pytest.param(15, marks=pytest.mark.commands), 33])
@pytest.mark.whole
def test_it_goes_the_way_of_an_independent_filter(states, drives, monkeypatch, tmp_path):
    """Within 3 mm with GNSS, where the error is 2 cm; 30 s without, after 50 s from a start 1° and 3° off, both
    carry what two linearisations made of that start (15 to 25 % apart, and less with a smaller ``STEP``)."""
    monkeypatch.setattr(parity, "FIRST_S", 50)
    monkeypatch.setattr(parity, "OUTAGE_S", 30)
    result = parity.run(drives, tmp_path, 0, imu_preset("consumer"), states, STEP)
    (end,) = parity.outage_ends(result.hidden)
    apart = np.abs(result.ours - result.theirs)
    assert apart[5:50].max() < 3e-3
    assert result.theirs[end] > 1.0  # an outage that is none would prove nothing
    assert apart[end] < 0.35 * result.theirs[end]


def test_an_error_free_imu_does_not_drift(tmp_path):
    """60 s from the exact start: gravity, Earth rotation and the curvature of the way agree to millimetres."""
    parity.write_drives(tmp_path / "drives", imu_preset("perfect"), 1, 2.05)
    assert parity.perfect_drift(tmp_path / "drives", 100) < 0.005
