"""Fixes in any order of arrival are screened as a log of them in order of time."""

from __future__ import annotations

import numpy as np
import pytest

from dlkf.data.limits import screen_fixes
from dlkf.data.schema import STD, VELOCITY
from dlkf.running.fix_history import HELD, FixHistory

M = 1 / 111_195.0  # degrees per metre of latitude


def a_log(seed: int, n: int = 300) -> dict[str, np.ndarray]:
    """Fixes once a second of a car that drives north: blocks of them far off, some frozen, some at 0°/0°."""
    g = np.random.default_rng(seed)
    t, zero = np.arange(float(n)), np.zeros(n)
    lat = 48 + 10 * t * M
    for first in range(20, n, 40):
        last = first + int(g.integers(2, 25))
        lat[first:last] = lat[first] if g.random() < 0.3 else lat[first:last] + g.choice([0.05, 0.5])
    gnss = {"t": t, "lat_deg": lat, "lon_deg": zero + 9, "height_m": zero + 150}
    gnss["lat_deg"][g.integers(n, size=5)] += 1.0
    return gnss | dict(zip(VELOCITY, (zero + 10, zero, zero))) | {c: zero + 0.05 for c in STD}


def rows(gnss: dict[str, np.ndarray], which: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[which] for name, values in gnss.items()}


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_arrival_ends_with_the_same_fixes(seed):
    """Now and then: of the fixes that are there, those count that a log of them would have; the changes are named."""
    gnss, history = a_log(seed), FixHistory()
    g = np.random.default_rng(seed)
    late = np.where(g.random(300) < 0.2, g.uniform(0, 10, 300), 0.0)
    order = np.argsort(gnss["t"] + late, kind="stable")
    used: dict[int, bool] = {}
    for k, row in enumerate(order):
        fix, changed = history.add(float(gnss["t"][row]), int(row), rows(gnss, np.array([row])), int(row) - 12)
        for boundary in changed:
            used[boundary] = history.at(boundary) is not None
        if k % 20:
            continue
        there = np.sort(order[: k + 1])
        keep = screen_fixes(rows(gnss, there)).keep
        assert fix is not None and fix.used == keep[there == row][0] and fix.used != bool(fix.reason)
        assert {int(x) for x in there[keep]} == {x for x, is_used in used.items() if is_used}
    assert 10 < sum(used.values()) < 290 and (late > 0).sum() > 30


def test_a_stamp_counts_once_and_the_latest_fix_of_a_boundary_is_its_own():
    gnss, history = a_log(0), FixHistory()
    one = [rows(gnss, np.array([k])) for k in range(3)]
    assert history.add(1.0, 7, one[1])[1] == {7}
    assert history.add(1.0, 7, one[1]) == (None, set())
    assert history.add(0.0, 7, one[0])[1] == {7}
    fix = history.at(7)
    assert fix is not None and fix.t == 1.0 and history.at(6) is None
    history.add(1.5, 7, one[1] | {"t": np.array([1.5])})
    assert history.at(7) is fix  # the same position again is not a later one
    for k in range(3, 300):
        history.add(float(k), k, rows(gnss, np.array([k])))
    assert len(history._fixes) == HELD
