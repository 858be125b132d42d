"""Findings about tables that a receiver left incomplete."""

import numpy as np

from dlkf.data.schema import POSITION, STD, VELOCITY
from dlkf.diagnosis.checkup import BAD, gnss_findings


def test_a_jump_is_found_beside_a_fix_without_a_position():
    t = np.arange(0.0, 60.0, 0.2)
    gnss = {"t": t, "quality": np.full(len(t), 1)} | {c: np.zeros(len(t)) for c in (*POSITION, *VELOCITY, *STD)}
    gnss["lat_deg"][100:] = np.degrees(40 / 6.371e6)
    for name in POSITION:
        gnss[name][200] = np.nan
    texts = [finding.text for finding in gnss_findings({"t": t}, gnss) if finding.grade == BAD]
    assert texts == ["GNSS: 1 jumps; at t = 20.0 s it moves 40 m in 0.2 s"]
