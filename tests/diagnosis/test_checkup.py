"""Findings about tables that a receiver left incomplete, and about a log at rest."""

import numpy as np

from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.tables import DriveRow
from dlkf.data.validate import CheckedTables
from dlkf.diagnosis.checkup import BAD, NOTE, discover_findings, gnss_findings


def test_a_jump_is_found_beside_a_fix_without_a_position():
    t = np.arange(0.0, 60.0, 0.2)
    gnss = {"t": t, "quality": np.full(len(t), 1)} | {c: np.zeros(len(t)) for c in (*POSITION, *VELOCITY, *STD)}
    gnss["lat_deg"][100:] = np.degrees(40 / 6.371e6)
    for name in POSITION:
        gnss[name][200] = np.nan
    texts = [finding.text for finding in gnss_findings({"t": t}, gnss) if finding.grade == BAD]
    assert texts == ["GNSS: 1 jumps; at t = 20.0 s it moves 40 m in 0.2 s"]


def test_a_log_at_rest_under_fixes_without_noise_determines_no_clock():
    """Its fixes correlate with nothing, the gain of every offset is zero."""
    g, t = np.random.default_rng(0), np.arange(0.0, 300.0, 0.02)
    imu = {"t": t} | {c: 0.01 * g.standard_normal(len(t)) for c in (*ACCEL, *GYRO)}
    imu["accel_z"] -= 9.81
    fixes = {"t": t[::50], "quality": np.ones(len(t[::50]), int)}
    fixes |= {c: np.zeros(len(t[::50])) for c in (*POSITION, *VELOCITY)} | {c: np.ones(len(t[::50])) for c in STD}
    found = [*discover_findings(CheckedTables(DriveRow("desk", "desk", (0.0, 0.0, 0.0)), imu, fixes, None))]
    assert found and all(finding.grade == NOTE for finding in found)
    assert any("too little motion" in finding.text for finding in found)
