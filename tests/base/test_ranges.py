"""Ranges: stated distributions, one draw per path whatever else is fixed, faults in one line."""

import math

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.base.ranges import draw_ranges, has_ranges, range_middle

SEEDS = [np.random.SeedSequence(4, spawn_key=(k,)) for k in range(2000)]


def drawn(config, key="x"):
    return np.array([draw_ranges(config, seed)[key] for seed in SEEDS])


def test_draws_have_the_stated_distribution():
    """2000 draws: 1σ of a mean is σ/45, of a share 1 %."""
    x = drawn({"x": {"uniform": [2.0, 6.0]}})
    assert (x.min() >= 2) and (x.max() <= 6) and x.mean() == pytest.approx(4, abs=0.1)
    x = np.log(drawn({"x": {"log_uniform": [1e-4, 1e-2]}}))
    assert x.mean() == pytest.approx(math.log(1e-3), abs=0.12)
    assert x.std() == pytest.approx(math.log(100) / 12**0.5, rel=0.05)
    x = drawn({"x": {"normal": [1.0, 0.5], "absent": 0.25}})
    assert (x == 0).mean() == pytest.approx(0.25, abs=0.04)
    assert x[x != 0].mean() == pytest.approx(1, abs=0.05) and x[x != 0].std() == pytest.approx(0.5, rel=0.08)
    assert set(drawn({"x": {"choice": [1, 1, 5]}})) == {1, 5}
    assert (drawn({"x": {"choice": [1, 1, 5]}}) == 1).mean() == pytest.approx(2 / 3, abs=0.04)


def test_a_fixed_value_leaves_all_other_draws_as_they_are():
    config = {"a": {"b": {"uniform": [0, 1]}, "c": {"uniform": [0, 1]}}, "d": [{"normal": [0, 1]}, 3.0]}
    fixed = {"a": {"b": 0.0, "c": {"uniform": [0, 1]}, "new": {"uniform": [0, 1]}}, "d": [{"normal": [0, 1]}, 3.0]}
    for seed in SEEDS[:20]:
        one, other = draw_ranges(config, seed), draw_ranges(fixed, seed)
        assert one["a"]["c"] == other["a"]["c"] and one["d"] == other["d"] and other["a"]["b"] == 0.0
        assert one["a"]["b"] != one["a"]["c"]


def test_variants_are_merged_and_what_stands_beside_them_wins():
    config = {
        "one_of": {
            "slow": {"share": 3, "car": {"speed": {"uniform": [1, 2]}, "size": 1.0}},
            "fast": {"car": {"speed": {"uniform": [8, 9]}, "size": 1.0}},
        },
        "car": {"size": 2.0, "bumpy": {"choice": [True]}},
    }
    cars = [draw_ranges(config, seed)["car"] for seed in SEEDS]
    assert all(car["size"] == 2.0 and car["bumpy"] is True and set(car) == {"speed", "size", "bumpy"} for car in cars)
    assert np.mean([car["speed"] < 3 for car in cars]) == pytest.approx(0.75, abs=0.04)
    assert range_middle(config)["car"] == {"speed": 1.5, "size": 2.0, "bumpy": True}


def test_a_choice_may_hold_ranges():
    config = {"x": {"choice": [[0.0, 0.0], [{"uniform": [1, 2]}, {"uniform": [3, 4]}]]}}
    drawn_ones = [draw_ranges(config, seed)["x"] for seed in SEEDS[:200]]
    assert all(x == [0, 0] or (1 <= x[0] <= 2 and 3 <= x[1] <= 4) for x in drawn_ones)
    assert len({tuple(x) for x in drawn_ones}) > 50 and range_middle(config)["x"] == [0, 0]


def test_the_middle():
    config = {
        "u": {"uniform": [1, 3]}, "l": {"log_uniform": [1e-4, 1e-2]}, "n": {"normal": [5, 1]}, "c": {"choice": [7, 8]},
        "rare": {"uniform": [1, 3], "absent": 0.6}, "fixed": "word",
    }  # fmt: skip
    values = range_middle(config)
    assert values.pop("l") == pytest.approx(1e-3)
    assert values == {"u": 2, "n": 5, "c": 7, "rare": 0.0, "fixed": "word"}
    assert has_ranges(config) and not has_ranges(values) and has_ranges([{"uniform": [0, 1]}])
    assert draw_ranges(values, SEEDS[0]) == values


@pytest.mark.parametrize(
    "fault",
    [
        {"uniform": [2, 1]},
        {"log_uniform": [0, 1]},
        {"normal": [0, -1]},
        {"uniform": [1]},
        {"uniform": [1, 2], "normal": [0, 1]},
        {"uniform": [1, 2], "absent": 1.5},
        {"uniform": [1, 2], "abzent": 0.5},
        {"choice": []},
        {"one_of": {"a": 3}},
        {"one_of": {"a": {"share": 0}}},
        {"one_of": {}},
    ],
)
def test_faults_are_one_clear_line(fault):
    for resolve in (lambda c: draw_ranges(c, SEEDS[0]), range_middle):
        with pytest.raises(InputError, match=r"deep\.key") as caught:
            resolve({"deep": {"key": fault}})
        assert "\n" not in str(caught.value)
