"""What a receiver's fix quality means: NMEA's GGA codes of words and of other receivers' numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import list_some
from dlkf.data.readers import vocabulary
from dlkf.data.schema import QUALITIES

Spec = dict[str, Any]
SOLUTION = r" ?(?:solution|losung|solucion|解)"
WORDS = {
    0: ("", "none", "no fix", "nofix", "no solution", "invalid", "kein fix", "keine", "aucun", "sin fix")
    + ("无", "无效", "無効"),
    1: ("single", "spp", "sps", "autonomous", "standalone", "3d", "3d fix", "2d", "2d fix", "gps", "gps fix", "einzel")
    + ("autonome", "autonomo", "单点", "单点解", "単独", "単独測位"),
    2: ("dgps", "dgnss", "sbas", "differential", "differentiell", "differentiel", "diferencial", "psrdiff")
    + ("差分", "差分解", "ディファレンシャル"),
    4: ("rtk", "rtk fix", "rtk fixed", "fixed", "fix", "rtk int", "int", "integer", "fixe", "fijo", "fest")
    + ("narrow int", "wide int", "l1 int", "固定", "固定解", "フィックス"),
    5: ("float", "rtk float", "flottant", "flotante", "gleitend", "narrow float", "l1 float")
    + ("浮点", "浮点解", "浮動", "フロート"),
}
# number of a fix: NMEA's GGA code
READINGS: dict[str, dict[int, int]] = {
    "NMEA's GGA code": {code: code for code in QUALITIES},
    "u-blox's fix type (3 is 3D)": {0: 0, 1: 0, 2: 1, 3: 1, 4: 1, 5: 0},
    "MAVLink's fix type (3 is 3D, 6 RTK fixed)": {0: 0, 1: 0, 2: 1, 3: 1, 4: 2, 5: 5, 6: 4},
    "RTKLIB's Q (1 is RTK fixed)": {0: 0, 1: 4, 2: 5, 3: 2, 4: 2, 5: 1, 6: 2},
    "ROS' NavSatStatus (0 is a fix)": {-1: 0, 0: 1, 1: 2, 2: 2},
    "u-blox's carrier solution (2 is RTK fixed)": {0: 1, 1: 5, 2: 4},
}
GGA, UBLOX, MAVLINK, RTKLIB, ROS, CARRIER = READINGS
GOOD_M, POOR_M = 0.15, 1.0  # accuracy of an RTK fix; of one that is none
LEAST_RTK_MM = 5.0  # no receiver states less


def quality_spec(frame: pd.DataFrame, column: str | None, accuracy_m: float) -> tuple[Spec | None, list[str]]:
    """The mapping's ``quality`` of a column and a line on what it was taken for; None where its values are unknown.

    ``accuracy_m`` is the median of the accuracies beside it, NaN where there are none.
    """
    if column is None:
        return None, []
    values = frame[column]
    if not any(str(word).strip() for word in values.dropna().unique()):
        return None, [f"quality {column} is empty: all count as single"]
    numbers, held = pd.to_numeric(values, errors="coerce"), list_some([str(x) for x in values.dropna().unique()], 4)
    if not bool(numbers.notna().any()):
        words = _read_words(values, column)
        unknown = f"quality {column} has words that are not known ({held}): all count as single; map them"
        return words, [] if words else [f"{unknown} with reader.gnss.quality={{column: {column}, map: {{…: 4}}}}"]
    seen = sorted({float(x) for x in numbers.dropna()})
    fits = [name for name, map_ in READINGS.items() if all(x in map_ for x in seen)]
    if not fits:
        unknown = f"quality {column} has numbers that no receiver gives ({held}): all count as single"
        return None, [unknown]
    beside_hdop = vocabulary.find_column([str(c) for c in frame.columns], "hdop") is not None  # RTKLIB writes none
    unlikely = {RTKLIB: beside_hdop, GGA: 3 in seen}  # PPS is rare, 3D is not
    fits = [name for name in fits if not unlikely.get(name)] or fits
    chosen = _choose_reading(column, [int(x) for x in seen], numbers, fits, accuracy_m)
    codes = {int(x): READINGS[chosen][int(x)] for x in seen}
    spec: dict[str, Any] = {"column": column}
    if any(x != code for x, code in codes.items()) or bool(numbers.isna().any()):
        spec["map"] = {str(x): code for x, code in codes.items()}
        spec["default"] = 0
    notes = [f"quality {column}: {_describe_codes(codes)}, taken as {chosen}"]
    named, usual = fits[0], int(numbers.mode().iloc[0])
    if chosen != named and accuracy_m > LEAST_RTK_MM and READINGS[named][usual] in (4, 5):
        notes.append(
            f"accuracies of {accuracy_m:g} m in the median are none of RTK; if they are mm: "
            "reader.gnss.std_position.unit=mm"
        )
    others = {name: {x: READINGS[name][x] for x in codes} for name in fits if name != chosen}
    if likely := next((n for n in _likely(column) if n in others and others[n] != codes), None):
        map_ = "{" + ", ".join(f"{x}: {code}" for x, code in others[likely].items()) + "}"
        notes[0] += f"; as {likely} it would be {_describe_codes(others[likely])}: reader.gnss.quality.map='{map_}'"
    return spec, notes


def _choose_reading(column: str, seen: list[int], numbers: pd.Series, fits: list[str], accuracy_m: float) -> str:
    """The most likely reading by name, by the numbers that occur, and by the fixes' own stds."""
    usual = [name for name in _likely(column) if name in fits] or fits
    best = numbers.mode().iloc[0]
    if 3 in seen and 6 in seen and MAVLINK in fits:
        usual = [MAVLINK]
    fixed = [name for name in usual if READINGS[name][int(best)] != 0] or usual  # there are positions beside it
    if np.isnan(accuracy_m):
        return fixed[0]
    return next((name for name in fixed if _agrees(READINGS[name][int(best)], accuracy_m)), fixed[0])


def _agrees(code: int, accuracy_m: float) -> bool:
    """An RTK fix is good to centimetres, others are not."""
    return accuracy_m < POOR_M if code in (4, 5) else accuracy_m > GOOD_M


def _likely(column: str) -> list[str]:
    """Readings by a column's name, the most likely first."""
    said = vocabulary.words(column)
    if "carr" in said:
        return [CARRIER]
    if said == "q":
        return [RTKLIB, GGA]
    if "type" in said or "mode" in said or said in ("gps fix", "fix"):
        return [GGA, UBLOX, MAVLINK]
    return [GGA, MAVLINK, UBLOX, ROS]


def _read_words(values: pd.Series, column: str) -> Spec | None:
    """GGA codes of the words of a column; None where one of them is not known, or there are none."""
    texts = [str(word) for word in values.dropna().unique()]
    codes = {w: code for w in texts if (code := _code(vocabulary.words(w))) is not None}
    known = len(codes) == len(texts) and any(vocabulary.words(w) for w in texts)
    return {"column": column, "map": codes} if known else None


def _code(word: str) -> int | None:
    """The GGA code of a word, with or without RTK before it or a word for solution behind it."""
    bare = re.sub(rf"^rtk |{SOLUTION}$", "", word)
    return next((code for code, known in WORDS.items() if word in known or bare in known), None)


def _describe_codes(codes: Mapping[int, int]) -> str:
    return ", ".join(f"{x} is {QUALITIES[code]}" for x, code in codes.items())
