"""Wheel speed, heading and barometer among the columns of a table: by their names, and a pressure by its size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from dlkf.data.readers import stamps, vocabulary
from dlkf.data.readers.aids import COUNTS
from dlkf.data.readers.frames import LogTable

Spec = dict[str, Any]
SLOWEST_S, FASTEST_S = 2.0, 9e-4
PRESSURES = {"pa": (6e4, 1.1e5), "hpa": (600.0, 1100.0), "kpa": (60.0, 110.0)}
SPEED_UNITS = ("km/h", "mph", "m/s", "knots", "rpm")


def aid_specs(table: LogTable, numbers: pd.DataFrame, called: str, time: Spec | None = None) -> dict[str, Spec]:
    """The mapping of every aid in a table, of which ``numbers`` are the columns with numbers.

    ``called`` is the table's name, ``time`` the mapping of its stamps where an IMU or fixes in it have set it. The
    speed of a receiver is none of a wheel: it stands beside a latitude, or is called so.
    """
    names = [str(c) for c in numbers.columns]
    places = vocabulary.find_column(names, "lat") is not None
    found: dict[str, Spec] = {}
    wheels = vocabulary.wheel_columns(names, "" if places else called)
    if wheels:
        found["speed"] = {"value": _wheel_value(numbers, wheels)}
    headings = [n for n in names if vocabulary.has(n, vocabulary.HEADING)]
    if not headings and not places and vocabulary.has(called, rf"{vocabulary.HEADING}|^heading$"):
        headings = [n for n in names if n == vocabulary.find_column([n], "course")]
    if headings:
        degrees = float(np.nanmax(np.abs(numbers[headings[0]]))) > 2 * np.pi + 0.01
        found["heading"] = {"value": {"columns": headings[:1], "unit": "deg" if degrees else "rad"}}
    if pressures := vocabulary.match_columns(names, vocabulary.PRESSURE):
        size = float(np.nanmedian(numbers[pressures[0]]))
        if unit := next((u for u, (least, most) in PRESSURES.items() if least < size < most), None):
            found["baro"] = {"pressure": {"columns": pressures[:1], "unit": unit}}
    elif heights := vocabulary.match_columns(names, vocabulary.BARO_HEIGHT):
        found["baro"] = {"pressure": {"columns": None}, "height": {"columns": heights[:1], "unit": "m"}}
    out = {}
    for name, spec in found.items():
        column = (spec.get("value") or spec["pressure"])["columns"] or spec["height"]["columns"]
        known = time or stamps.time_spec(table, numbers[column[0]].notna(), SLOWEST_S, FASTEST_S)
        if known is not None:
            out[name] = {"time": {**known, "offset_s": "auto"}, "rows": "filled", **spec}
    return out


def _wheel_value(numbers: pd.DataFrame, columns: list[str]) -> Spec:
    """Columns with the unit that their name states, else left to GNSS; what never falls and is called so counts on."""
    unit = vocabulary.find_unit(columns[0])
    counted = vocabulary.has(columns[0], vocabulary.COUNTED) and unit not in SPEED_UNITS
    if counted and unit not in COUNTS:
        return {
            "columns": columns,
            "unit": "auto",
            "counts": bool((numbers[columns[0]].dropna().diff() >= 0).mean() > 0.9),
        }
    return {"columns": columns, "unit": unit if unit in SPEED_UNITS and unit != "rpm" else "auto"}
