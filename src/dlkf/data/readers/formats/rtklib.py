"""RTKLIB solutions (.pos): calendar or week time; degrees, degrees-minutes-seconds or ECEF; with velocities or not.

Columns are the contract's, ``x``, ``y``, ``z`` excepted, and ``gps_ns``; the header line that starts with ``%`` says
what there is.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymap3d

from dlkf.base.errors import InputError
from dlkf.data.readers import units
from dlkf.data.readers.formats.text import decode_text, make_frame
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.qualities import READINGS, RTKLIB
from dlkf.data.schema import POSITION, STD, VELOCITY

ZONES = {"GPST": "gps", "UTC": "utc"}


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """The solution's rows; InputError for a solution of baselines, which has no place on the Earth."""
    lines = decode_text(path, None).splitlines()
    heads = [k for k, line in enumerate(lines) if line.startswith("%") and re.search(r"\bQ\b", line)]
    if not heads:
        raise InputError(f"{path}: has no header line '%  GPST … Q …'; give a .pos file of RTKLIB")
    head = lines[heads[-1]].lstrip("% ")
    if "baseline" in head:
        raise InputError(f"{path}: holds baselines; write the solution as lat/lon/height or x/y/z-ecef")
    separator = "," if "," in head else None
    names = [re.sub(r"\(.*?\)", "", n).strip() for n in (head.split(separator))]
    names = [n for n in names if n]
    zone = names[0]
    if zone not in ZONES:
        raise InputError(f"{path}: times in {zone}; write the solution in {' or '.join(ZONES)}")
    rows = [
        (k, [c.strip() for c in line.split(separator)])
        for k, line in enumerate(lines, 1)
        if line.strip() and not line.startswith("%")
    ]
    first, usual = (rows[0][0], len(rows[0][1])) if rows else (0, 0)
    cells, notes = make_frame(rows, usual, path, f"another number of cells than line {first}")
    return LogTable(_frame(cells, names, ZONES[zone], path), path, "line", notes)


def _frame(cells: pd.DataFrame, names: list[str], clock: str, path: Path) -> pd.DataFrame:
    first = str(cells.iloc[0, 0])
    calendar = "/" in first
    one_cell = calendar and " " in first  # comma-separated: date and time in one
    where = str(path)
    if calendar:
        texts = cells[0] if one_cell else cells[0].str.cat(cells[1], sep=" ")
        whole, part = units.seconds(texts.to_numpy(), units.ISO, None, clock, where)
    else:
        week, tow = (_numbers(cells[k], where) for k in (0, 1))
        whole, part = units.seconds(tow, "s", week, None, where)
    skip = 1 if one_cell else 2
    wide = cells.shape[1] - skip - len(names) + 1  # degrees, minutes, seconds take three cells
    numbers = np.stack([_numbers(cells[k], where) for k in range(skip, cells.shape[1])], -1)
    if wide == 4:
        angles = [units.degrees_minutes_seconds(cells.iloc[:, k : k + 3]) for k in (skip, skip + 3)]
        numbers = np.column_stack((*angles, numbers[:, 6:]))
    elif wide != 0:
        raise InputError(f"{where}: rows have {cells.shape[1]} cells, the header names {len(names)} columns")
    column = {n: numbers[:, k] for k, n in enumerate(names[1:])}
    out = {"gps_ns": whole * 10**9 + np.round(part * 1e9).astype(np.int64)}
    nan = np.full(len(cells), np.nan)
    if "x-ecef" in column:
        x, y, z = (column[f"{a}-ecef"] for a in "xyz")
        out |= dict(zip(POSITION, pymap3d.ecef2geodetic(x, y, z)))
        ecef = [column.get(f"v{a}", nan) for a in "xyz"]
        east, north, up = pymap3d.ecef2enuv(*ecef, lat0=out["lat_deg"], lon0=out["lon_deg"])
        out |= dict(zip(VELOCITY, (north, east, -up)))
        for stds, mark in ((STD[:3], "sd"), (STD[3:], "sdv")):
            square = np.mean([column.get(f"{mark}{a}", nan) ** 2 for a in "xyz"], 0)
            out |= dict.fromkeys(stds, np.sqrt(square))
    else:
        out |= dict(zip(POSITION, (column["latitude"], column["longitude"], column["height"])))
        out |= dict(zip(VELOCITY, (column.get("vn", nan), column.get("ve", nan), -column.get("vu", nan))))
        out |= dict(zip(STD, (column.get(f"sd{a}", nan) for a in ("n", "e", "u", "vn", "ve", "vu"))))
    out["quality"] = pd.Series(column["Q"]).map(READINGS[RTKLIB]).fillna(0).to_numpy()
    return pd.DataFrame(out, index=cells.index)


def _numbers(cells: pd.Series, where: str) -> np.ndarray:
    values = pd.to_numeric(cells, errors="coerce")
    if bool(values.isna().any()):
        line = cells.index[int(np.flatnonzero(values.isna())[0])]
        raise InputError(f"{where}: line {line}: {cells[line]!r} is not a number; correct the line")
    return values.to_numpy()
