"""The core in C against the Python stream: the same faults, the same words, the same solutions."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest

from dlkf.data.aids import pressure_height
from dlkf.onboard.c_source import COLUMNS
from dlkf.onboard.library import find_compiler
from dlkf.running.streaming import StreamingFilter
from tests.onboard.conftest import ARM
from tests.onboard.core import Core, Status, Waiting
from tests.onboard.faults import FAULTS, JUMPS, JUMPS_LATE, USUAL
from tests.onboard.streams import Trunk, apart, calls, through_core

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
OTHERS = "TAKEN", "REPLAYED", "SUPERSEDED", "RESTARTED", "DIVERGED", "LOST", "SPIKE", "BRIDGED"
REFUSED = set(Status) - {Status[x] for x in OTHERS}
ROUNDING = 1e-6  # m, m/s, rad: sums in another order over a minute


@pytest.fixture(scope="module")
def plain(tables):
    """The calls of the drive."""
    return calls(tables)


@pytest.fixture(scope="module")
def python(exported, plain):
    """``python(name)``: the stream, and what it answers to the calls with that fault; run once, from the fault on."""
    trunk = Trunk(StreamingFilter(exported[1], lever_arm_b=ARM), plain)
    return cache(lambda name: trunk.branch(FAULTS[name][0](plain)))


@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.exports] * (x not in USUAL)) for x in FAULTS])
def test_the_core_answers_every_fault_as_the_python_stream_does(name, exported, plain, python):
    """The same word on every call, the same rows at the same calls, the same state in between."""
    fault, words = FAULTS[name]
    sent, inside = fault(plain), Core(exported[3].path, ARM)
    (stream, want), core = python(name), through_core(inside, sent)
    assert Counter(words) <= want.counts
    assert [x for x in zip(sent, want.words, core.words, strict=True) if x[1] != x[2]] == []
    refused = sum(inside.counts.get(x, 0) for x in REFUSED)
    assert refused == stream.counts["refused"]
    assert inside.counts.get(Status.DIVERGED, 0) == stream.counts["diverged"]
    assert inside.counts.get(Status.LOST, 0) == stream.counts["lost"]
    assert inside.counts.get(Status.SPIKE, 0) == stream.counts["spikes"]
    assert (stream.counts["spikes"] > 3) is ("spikes" in name)
    assert len(want.solution) > 15 and len(want.now) > 2
    assert apart(want.rows, core.rows) < ROUNDING
    assert apart(want.now, core.now) < ROUNDING
    np.testing.assert_allclose(np.array(core.aids), np.array(want.aids), atol=ROUNDING, rtol=1e-5)
    assert inside.doubt == pytest.approx(stream.doubt, rel=1e-6)


@pytest.mark.parametrize("name", JUMPS_LATE)
def test_a_jump_ends_the_same_whether_fixes_come_in_order_or_late(name, exported, plain, python):
    """The screen goes back with the filter: every fix counts, or is refused, as in a log in order of time."""
    jump, late = JUMPS_LATE[name]
    in_order = JUMPS[jump](plain)
    in_c = [through_core(Core(exported[3].path, ARM), sent) for sent in (in_order, late(in_order))]
    for want, got in ((python(jump)[1], python(name)[1]), in_c):
        np.testing.assert_allclose(got.solution, want.solution[-len(got.solution) :], rtol=0, atol=ROUNDING)


def test_samples_of_sensors_that_cannot_be_taken(exported):
    core = Core(exported[3].path, ARM)
    assert core.aid("radar", 1.0, 2.0).status is Status.NO_SENSOR
    assert core.speed(1.0, 2.0, -0.1).status is Status.OUTSIDE
    assert core.speed(np.inf, 2.0).status is Status.NOT_FINITE
    assert core.speed(1.0, -1.7e308).status is Status.IMPLAUSIBLE
    assert core.baro(1.0, pressure=95_000.0).status is Status.TAKEN
    assert core.counts == {
        Status.NO_SENSOR: 1,
        Status.OUTSIDE: 1,
        Status.NOT_FINITE: 1,
        Status.IMPLAUSIBLE: 1,
        Status.TAKEN: 1,
    }
    height = core._library.dlkf_pressure_height(95_000.0)
    assert height == pytest.approx(float(pressure_height(np.float64(95_000.0))), abs=1e-9) and 500 < height < 600
    assert [core.describe_status(x) for x in Status] and core.waiting is Waiting.SAMPLES and core.doubt == 1.0


def test_it_says_what_it_waits_for_as_the_python_stream_does(exported, plain):
    stream, core, said = StreamingFilter(exported[1], lever_arm_b=ARM), Core(exported[3].path, ARM), []
    for call in FAULTS["coarse positions alone"][0](plain):
        said.append((stream.waits_for, core.waits_for))
        getattr(stream, call.kind)(*call.arguments), getattr(core, call.kind)(*call.arguments)
        if stream.latest is not None:
            break
    assert all(a == b for a, b in said)
    words = list(dict.fromkeys(a for a, _ in said))
    assert [x.split()[0] for x in words] == ["samples", "fixes", "the", "motion"]
    assert stream.waits_for == core.waits_for == "nothing"


def test_a_rejected_innovation_has_its_own_1σ(exported, plain):
    """Of fixes 100 m off, one in six, it is as large as that of those beside them."""
    core, rows = Core(exported[3].path, ARM), []
    for call in FAULTS["fixes 100 m off, one in six"][0](plain):
        rows += list(getattr(core, call.kind)(*call.arguments).rows)
    used, z, std = (
        np.array(rows)[:, COLUMNS.index(x)] for x in ("gnss_used", "innovation_pos_n", "innovation_std_pos_n")
    )
    rejected = (used == 0) & (np.abs(z) > 50)
    assert rejected.sum() > 3
    np.testing.assert_allclose(std[rejected], np.median(std[used == 1]), rtol=0.5)
