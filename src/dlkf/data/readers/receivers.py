"""Which columns of a table are one receiver's: place, velocity, accuracy, where a table has those of several."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import pandas as pd

from dlkf.data.readers import units, vocabulary

Spec = dict[str, Any]
PLACE = ("lat", "lon", "height")
SAME_PLACE = 2e-8  # of a latitude in any unit: 0.1 m


class Receiver(NamedTuple):
    """The column of every quantity (``found``) of the receiver ``called`` so, empty for none; the ``names`` of all
    columns but those of other receivers, its own first; ``refusal`` is a line where several have positions."""

    found: dict[str, str | None]
    names: list[str]
    called: str = ""
    refusal: str = ""


def choose_receiver(numbers: pd.DataFrame, names: Sequence[str], named: Sequence[str] = ()) -> Receiver:
    """The receiver whose position a table's fixes are: of the columns ``named``, else the only one that is complete.

    ``numbers`` are the columns with numbers, ``names`` those of all.
    """
    places: dict[str, list[str | None]] = {}
    for called in dict.fromkeys(map(vocabulary.find_receiver, map(str, numbers.columns))):
        own = [str(n) for n in numbers.columns if vocabulary.find_receiver(str(n)) == called]
        place = [vocabulary.find_column(own, key) for key in PLACE]
        if place[0] or place[1]:
            places[called] = place
    whole = [c for c, place in places.items() if all(place)] or [c for c, place in places.items() if all(place[:2])]
    called = vocabulary.find_receiver(named[0]) if named else (whole[0] if whole else "")
    own_place = [*named] or places.get(called, [None, None, None])
    apart = [c for c, place in places.items() if whole and c != called and _are_apart(numbers, own_place, place)]
    kept = [name for name in names if vocabulary.find_receiver(name) not in apart]
    kept.sort(key=lambda name: vocabulary.find_receiver(name) != called)
    with_numbers = [name for name in kept if name in numbers]
    found = {key: vocabulary.find_column(with_numbers, key) for key in vocabulary.QUANTITIES}
    found |= {key: column for key, column in zip(PLACE, own_place) if column is not None}
    several = [] if named else [places[c] for c in whole if c == called or c in apart]
    return Receiver(found, kept, called, _refuse(several) if len(several) > 1 else "")


def _are_apart(numbers: pd.DataFrame, one: Sequence[str | None], other: Sequence[str | None]) -> bool:
    """Whether two receivers' positions differ, or cannot be compared."""
    for a, b in zip(one[:2], other[:2]):
        if a is None or b is None or a not in numbers or b not in numbers:
            return True
        between = float((numbers[a] - numbers[b]).abs().median())
        if not between <= SAME_PLACE * float(numbers[a].abs().median()):
            return True
    return False


def _refuse(places: Sequence[Sequence[str | None]]) -> str:
    listed = [", ".join(name for name in place if name is not None) for place in places]
    first = ", ".join(n if re.fullmatch(r"\w+", n) else f'"{n}"' for n in places[0] if n is not None)
    first += "" if places[0][2] else ", …"
    return (
        f"positions of several receivers ({'; '.join(listed)}); choose one, "
        f"'reader.gnss.position.columns=[{first}]', or another"
    )


def find_velocity(names: Sequence[str], called: str = "") -> Spec | None:
    """The mapping of velocities: those of the receiver ``called`` so, else of any, else of columns that name none; a
    wheel's speed is none."""
    ranked = sorted(names, key=lambda name: _rank(vocabulary.find_receiver(name), called))
    own = [name for name in ranked if called and vocabulary.find_receiver(name) == called]
    return _map_velocity(own) or _map_velocity(ranked)


def _rank(receiver: str, called: str) -> int:
    return 0 if receiver and receiver == called else 1 if receiver else 2


def _map_velocity(names: Sequence[str]) -> Spec | None:
    find = vocabulary.find_column
    north, east = find(names, "north"), find(names, "east")
    down, up = find(names, "down"), find(names, "up")
    if north and east:
        third = down or up
        columns, frame = ([north, east], "ned") if down or third is None else ([east, north], "enu")
        return _with_climb({"columns": columns, "frame": frame}, third)
    speed = find([name for name in names if not vocabulary.is_wheel(name)], "speed")
    course = find(names, "course")
    if speed is None or course is None:
        return None
    return _with_climb({"columns": [speed, course], "frame": "course"}, up)


def _with_climb(spec: Spec, third: str | None) -> Spec:
    """With the vertical velocity, and its unit where that may be another than the first column's."""
    if third is None:
        return spec
    first, stated = (vocabulary.find_unit(name) for name in (spec["columns"][0], third))
    own = stated if stated in units.SPEED else "auto" if spec["frame"] == "course" else first
    same = own == first and spec["frame"] != "course"
    return {**spec, "columns": [*spec["columns"], third]} | ({} if same else {"climb_unit": own})


def find_geoid(numbers: pd.DataFrame, receiver: Receiver) -> str | None:
    """The column of the undulation where heights are above sea level; None where they are above the ellipsoid by their
    name or by a height above sea level beside them."""
    geoid, height = receiver.found["geoid"], receiver.found["height"]
    if geoid is None or height is None or vocabulary.is_ellipsoidal(height):
        return None
    others = [name for name in receiver.names if name in numbers and name != height]
    level = vocabulary.match_columns(others, f"{vocabulary.RECEIVER}(?:{vocabulary.SEA_LEVEL})")
    if not level:
        return geoid
    above = abs(float((numbers[height] - numbers[level[0]]).median()))
    return geoid if above <= abs(float(numbers[geoid].median())) / 2 else None
