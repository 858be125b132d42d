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
from dlkf.data.readers.formats.text import decoded
from dlkf.data.readers.frames import LogTable
from dlkf.data.schema import POSITION, STD, VELOCITY

QUALITY = {1: 4, 2: 5, 3: 2, 4: 2, 5: 1, 6: 2}  # fix, float, SBAS, DGPS, single, PPP
ZONES = {"GPST": "gps", "UTC": "utc"}


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """The solution's rows; InputError for a solution of baselines, which has no place on the Earth."""
    lines = decoded(path, None).splitlines()
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
    rows, numbers = [], []
    for k, line in enumerate(lines):
        if line.strip() and not line.startswith("%"):
            rows.append([c.strip() for c in line.split(separator)])
            numbers.append(k + 1)
    notes = ()
    usual = len(rows[0]) if rows else 0
    if len(rows) > 1 and len(rows[-1]) < usual:
        notes = (f"{path.name}: line {numbers[-1]}, the last, is cut off: left out",)
        rows, numbers = rows[:-1], numbers[:-1]
    if not rows:
        raise InputError(f"{path}: has no rows; leave the drive out or give its data")
    short = [n for row, n in zip(rows, numbers) if len(row) != usual]
    if short:
        raise InputError(f"{path}: line {short[0]}: has another number of cells than line {numbers[0]}")
    return LogTable(
        _frame(pd.DataFrame(rows, index=pd.Index(numbers)), names, ZONES[zone], path), path, "line", {}, notes
    )


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
        dms = [numbers[:, 3 * k : 3 * k + 3] for k in range(2)]
        angles = [np.where(np.signbit(d[:, 0]), -1, 1) * (np.abs(d) @ [1, 1 / 60, 1 / 3600]) for d in dms]
        numbers = np.concatenate((np.stack(angles, -1), numbers[:, 6:]), 1)
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
    out["quality"] = pd.Series(column["Q"]).map(QUALITY).fillna(0).to_numpy()
    return pd.DataFrame(out, index=cells.index)


def _numbers(cells: pd.Series, where: str) -> np.ndarray:
    values = pd.to_numeric(cells, errors="coerce")
    if bool(values.isna().any()):
        line = cells.index[int(np.flatnonzero(values.isna())[0])]
        raise InputError(f"{where}: line {line}: {cells[line]!r} is not a number; correct the line")
    return values.to_numpy()
