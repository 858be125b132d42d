"""Columns under other names than the contract's: what they are likely to be, and which of them are not used."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import pandas as pd

from dlkf.base.errors import InputError

SHOWN = 12  # columns in a line
OTHER_NAMES = {  # what people call the contract's columns, beside what the readers know (dlkf.data.readers.vocabulary)
    "t": ("time", "timestamp", "time_s", "seconds", "stamp", "date"),
    "speed": ("speed_mps", "velocity", "v", "speed_kmh"),
    "heading": ("heading_deg", "yaw", "course"),
    **{f"{s}_{a}": (f"{short}{a}", f"{short}_{a}", f"{s}{a}", f"{s[:3]}_{a}")
       for s, short in (("accel", "a"), ("gyro", "g")) for a in "xyz"},
}  # fmt: skip
QUANTITIES = {"lat_deg": "lat", "lon_deg": "lon", "height_m": "height"}
OPTIONAL_OF_GNSS = {  # what the readers call a quantity: the contract's column for it
    **dict.fromkeys(("north", "east", "down", "up", "speed", "course"), "vel_n"),
    **dict.fromkeys(("hacc", "vacc", "std_pos_n", "std_pos_e", "std_pos_d"), "std_pos_n"),
    **dict.fromkeys(("sacc", "std_vel_n", "std_vel_e", "std_vel_d"), "std_vel_n"),
    "quality": "quality",
}


def check_columns(name: str, frame: pd.DataFrame, needed: Sequence[str]) -> None:
    """InputError for columns that are missing, with what is there in their place, or stand twice."""
    if frame.columns.nlevels > 1:
        raise InputError(f"{name}: its columns have {frame.columns.nlevels} levels, must be plain names")
    columns = [str(c) for c in frame.columns]
    if twice := sorted({c for c in columns if columns.count(c) > 1}):
        raise InputError(f"{name}: column {twice[0]} appears twice; keep one")
    if not (missing := [c for c in needed if c not in columns]):
        return
    renamed = other_names(columns, missing)
    remedy = f"has {', '.join(columns[:SHOWN])}{', …' if len(columns) > SHOWN else ''}" if columns else "has no columns"
    if missing == ["t"] and frame.index.name == "t":
        remedy = f"t is its index; give {name}.reset_index()"
    elif {c.strip() for c in columns} >= set(needed):
        remedy = f"its names have blanks around them; {name}.rename(columns=str.strip)"
    elif len(renamed) == len(missing):
        remedy += f"; {name}.rename(columns={renamed}), units of the contract (dlkf.read_logs finds names and units)"
    else:
        remedy += "; dlkf.read_logs reads logs with other names and units"
    raise InputError(f"{name}: column {', '.join(missing)} missing; {remedy}")


def other_names(columns: Sequence[str], missing: Iterable[str]) -> dict[str, str]:
    """Which columns are likely to be the missing ones: ``{"ax": "accel_x"}``."""
    from dlkf.data.readers.vocabulary import SENSORS, find_column, triad

    lower = {c.lower(): c for c in columns}
    found = {c: next((lower[o] for o in (c, *OTHER_NAMES.get(c, ())) if o in lower), None) for c in missing}
    for sensor, stem in SENSORS.items():
        three = triad(columns, stem) or ()
        found |= {f"{sensor}_{a}": c for a, c in zip("xyz", three) if found.get(f"{sensor}_{a}", c) is None}
    for column, quantity in QUANTITIES.items():
        if column in found and found[column] is None:
            found[column] = find_column(columns, quantity)
    return {old: new for new, old in found.items() if old is not None}


def warn_of_other_columns(gnss: pd.DataFrame) -> None:
    """A warning for columns of a fix that the contract has under another name: they are not used."""
    from dlkf.data.readers.vocabulary import find_column

    others: list[Any] = [c for c in gnss.columns if c not in ("t", *QUANTITIES, *OPTIONAL_OF_GNSS.values())]
    unused = {
        column: wanted
        for quantity, wanted in OPTIONAL_OF_GNSS.items()
        if wanted not in gnss and (column := find_column(map(str, others), quantity)) is not None
    }
    if unused:
        names, wanted = ", ".join(unused), ", ".join(dict.fromkeys(unused.values()))
        line = f"gnss: columns {names} are not used; the contract's names are {wanted}, … (docs: Data)"
        warnings.warn(line, UserWarning, stacklevel=6)
