"""Plain values become settings in one way, and what is odd is told in one way."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import pytest

from dlkf.base.errors import InputError, did_you_mean
from dlkf.base.settings import Ranged, bounded_field, settings_from


@dataclass(frozen=True)
class Inner:
    width_m: float = 1.0


@dataclass(frozen=True)
class Outer:
    name: str
    length_s: float = 2.0
    loud: bool = False
    when_s: float | Sequence[float] = 0.0
    every_s: float | None = None
    mode: Literal["a", "b"] = "a"
    inner: Inner = field(default_factory=Inner)


@dataclass(frozen=True)
class Counts:
    count: int
    most: int | None = None
    sizes: tuple[int, ...] = ()


def test_values_of_the_right_type_become_settings():
    given = {"name": "x", "when_s": [1, 2], "every_s": None, "mode": "b", "inner": {"width_m": 3}}
    assert settings_from(Outer, given, "outer") == Outer("x", when_s=(1.0, 2.0), mode="b", inner=Inner(3))
    ready = Outer("y")
    assert settings_from(Outer, ready, "outer") is ready


@pytest.mark.parametrize("given", [2, 2.0])
def test_a_whole_number_is_an_int(given):
    made = settings_from(Counts, {"count": given, "most": given, "sizes": [given, 3.0]}, "counts")
    assert made == Counts(2, 2, (2, 3)) and {type(x) for x in (made.count, made.most, *made.sizes)} == {int}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"name": "x", "lenght_s": 1}, "outer: unknown key lenght_s; did you mean length_s\\? known are name"),
        ({"length_s": 1}, "outer: name missing"),
        ({"name": 3}, "outer\\.name is 3, must be a name or path"),
        ({"name": "x", "length_s": "long"}, "outer\\.length_s is 'long', must be a number"),
        ({"name": "x", "length_s": True}, "outer\\.length_s is True, must be a number"),
        ({"name": "x", "length_s": float("nan")}, "must be a number"),
        ({"name": "x", "loud": 1}, "outer\\.loud is 1, must be true or false"),
        ({"name": "x", "when_s": ["a"]}, "must be a number or a list of numbers"),
        ({"name": "x", "every_s": "no"}, "must be a number or null"),
        ({"name": "x", "mode": "c"}, "outer\\.mode is 'c', must be one of a, b"),
        ({"name": "x", "inner": {"with_m": 1}}, "outer\\.inner: unknown key with_m; did you mean width_m"),
        ({"name": "x", "inner": 5}, "outer\\.inner is 5, must be a mapping"),
        ([1], "outer: is \\[1\\], must be a mapping"),
    ],
)
def test_mistakes_have_one_text(given, expected):
    with pytest.raises(InputError, match=expected):
        settings_from(Outer, given, "outer")


@dataclass(frozen=True)
class Spring(Ranged, where="spring", least=0):
    name: str = "soft"
    length_m: float = 1.0
    damping: float | None = bounded_field(0.2, 0.05, 2)


@pytest.mark.parametrize("given", [{"length_m": 0}, {"damping": 0.05}, {"damping": 2}, {"damping": None}])
def test_the_ends_of_a_range_belong_to_it(given):
    assert Spring(**given)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"length_m": -1e-9}, "spring: length_m is -1e-09, must be a finite number ≥ 0"),
        ({"length_m": math.inf}, "length_m is inf"),
        ({"damping": 0.04}, "spring: damping is 0.04, must be from 0.05 to 2"),
        ({"damping": 2.1}, "damping is 2.1"),
        ({"damping": math.nan}, "damping is nan"),
    ],
)
def test_what_is_out_of_range_has_one_text(given, expected):
    with pytest.raises(InputError, match=re.escape(expected)):
        Spring(**given)


def test_the_whole_of_a_command_has_its_own_text_for_an_unknown_key():
    with pytest.raises(InputError, match="unknown config key 'lenght_s'; --cfg job"):
        settings_from(Outer, {"name": "x", "lenght_s": 1}, "")


@pytest.mark.parametrize(
    ("name", "meant"),
    [("modle", "model"), ("Modle", "model"), ("dirves", "drives"), ("modes", "mode"), ("mod", "mode"), ("zzz", "")],
)
def test_two_neighbours_that_are_swapped_are_the_closest(name, meant):
    """``modle`` has four letters of ``mode`` in order, and all five of ``model``."""
    said = did_you_mean(name, ["mode", "model", "drives"])
    assert said == (f"; did you mean {meant}?" if meant else "")
