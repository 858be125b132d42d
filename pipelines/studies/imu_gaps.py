"""What a gap of the IMU in the middle of an outage costs a filter in a vehicle.

    python -m pipelines.studies.imu_gaps real/kitti real/wid_mru data/plus/fleet --models mbkf21_car plus

Every ``--every`` seconds of a drive, from ``--first`` on, GNSS is withheld for ``--length`` seconds, and samples are
missing for so long from ``AT`` seconds into the outage on. The core in C runs from ``--first`` seconds before. A row
for each dataset, filter and gap: horizontal error at the end of the outage (RMS, geometric mean [m]), NEES, RMS of the
heading error [°] where the reference has one, outages without output at their end.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dlkf.base.angles import wrap_angle
from dlkf.data.store import drive_rows
from dlkf.data.tables import Columns
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.frames.navigation import load
from dlkf.onboard.c_source import COLUMNS
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.onboard.core import Core
from dlkf.running.replay import replay_drive

AT = 10.37  # s after the last fix
EARTH_M = 6.371e6


def run(core: Core, tables: CheckedTables, begin: float, gap: float, before: float, length: float) -> list[float]:
    """Error [m], NEES and heading error [rad] at the end of an outage; NaN without output there."""
    imu, gnss = (_between(x, begin - before, begin + length) for x in (tables.imu, tables.gnss))
    t = imu["t"] - begin
    imu = {name: x[(t <= AT) | (t > AT + gap)] for name, x in imu.items()}
    gnss = {name: x[gnss["t"] <= begin] for name, x in gnss.items()}
    last = None
    for receipt in replay_drive(core, imu, gnss):
        last = receipt.rows[-1] if len(receipt.rows) else last
    row = {} if last is None else dict(zip(COLUMNS, last))
    if row.get("t", -np.inf) < begin + length - 1.5:
        return [np.nan] * 3
    ref = tables.reference
    assert ref is not None
    k = int(np.argmin(np.abs(ref["t"] - row["t"])))
    north = np.radians(row["lat_deg"] - ref["lat_deg"][k]) * EARTH_M
    east = np.radians(row["lon_deg"] - ref["lon_deg"][k]) * EARTH_M * np.cos(np.radians(row["lat_deg"]))
    nees = 0.5 * ((north / row["std_pos_n"]) ** 2 + (east / row["std_pos_e"]) ** 2)
    return [float(np.hypot(north, east)), float(nees), float(wrap_angle(row["yaw"] - ref["yaw"][k]))]


def summarise(rows: np.ndarray) -> list[str]:
    """RMS, geometric mean, NEES, RMS of the heading [°] and how many have no output."""
    error, nees, yaw = rows[~np.isnan(rows[:, 0])].T
    if not len(error):
        return [*4 * ["–"], str(len(rows))]
    yaw = yaw[~np.isnan(yaw)]
    heading = f"{np.degrees(np.sqrt(np.mean(yaw**2))):.2f}" if len(yaw) else "–"
    numbers = np.sqrt(np.mean(error**2)), np.exp(np.log(error).mean()), nees.mean()
    return [*(f"{x:.2f}" for x in numbers), heading, str(len(rows) - len(error))]


def outages(tables: CheckedTables, first: float, every: float, length: float) -> Iterator[float]:
    """Times of the last fix before each, of those with a valid reference at both ends."""
    t0, t1 = tables.imu["t"][[0, -1]]
    ref = tables.reference
    if ref is None:
        return
    for begin in np.arange(t0 + first, t1 - length, every):
        k = np.searchsorted(ref["t"], (begin, begin + length))
        if ref["valid"][np.minimum(k, len(ref["t"]) - 1)].all():
            yield float(begin)


def _between(table: Columns, first: float, last: float) -> Columns:
    inside = (table["t"] > first) & (table["t"] <= last)
    return {name: x[inside] for name, x in table.items()}


def main() -> None:
    """A table of all datasets, filters and gaps."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("datasets", nargs="+", type=Path)
    arguments.add_argument("--models", nargs="+", default=["mbkf21_car", "plus"])
    arguments.add_argument("--gaps", nargs="+", type=float, default=[0.0, 0.3, 0.5, 1.0, 2.0, 2.9, 4.0], help="s")
    arguments.add_argument("--first", type=float, default=60.0, help="s of GNSS")
    arguments.add_argument("--every", type=float, default=60.0, help="s")
    arguments.add_argument("--length", type=float, default=40.0, help="s")
    o = arguments.parse_args()
    print("| data | filter | gap [s] | outages | RMS | geometric mean | NEES | heading [°] | no output |")
    print("|:--|:--|--:|--:|--:|--:|--:|--:|--:|")
    for folder in o.datasets:
        drives = [read_drive(folder, row) for row in drive_rows(folder)]
        for model in o.models:
            tuning = "untuned" if model.startswith("plus") else "any_car"
            library = compile_filter(load(model, tuning=tuning), 50.0, 1.0, whole=True).library
            for gap in o.gaps:
                rows = [
                    run(Core(library.path, x.row.lever_arm_b), x, begin, gap, o.first, o.length)
                    for x in drives
                    for begin in outages(x, o.first, o.every, o.length)
                ]
                cells = [folder.name, model, f"{gap:g}", str(len(rows)), *summarise(np.array(rows).reshape(-1, 3))]
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
