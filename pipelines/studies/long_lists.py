"""What a long list of drives costs: ``python -m pipelines.studies.long_lists data/two --hours 42 100``.

The drives of a dataset under new names (links: no room on the disk) until there are so many hours. Each work runs in an
interpreter of its own; printed are its processor time, its time by the clock and the most memory it had, and the least
of ``--repeats`` runs counts. Work is ``open`` (load, check, resample, cut) or a command.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from dlkf.data.schema import drive_file, write_drives_table

KINDS = ("imu", "gnss", "reference")
OPEN = """
import sys, torch
from dlkf.data.segments import cut_segments
from dlkf.data.store import load_dataset
drives = load_dataset(sys.argv[1])
print(len(drives), "drives,", len(cut_segments(drives, 120.0, 60.0, attitude=True)), "segments")
"""
WORKS = {
    "open": ["-c", OPEN, "{data}"],
    "navigate": ["-m", "dlkf.navigate", "model=mbkf15", "dataset={data}", "out={out}"],
    "parallel": ["-m", "dlkf.navigate", "model=mbkf15", "dataset={data}", "out={out}", "parallel=2"],
    "compiled": ["-m", "dlkf.navigate", "model=mbkf15", "dataset={data}", "out={out}", "compiled=true"],
    "both": ["-m", "dlkf.navigate", "model=mbkf15", "dataset={data}", "out={out}", "compiled=true", "parallel=2"],
    "evaluate": ["-m", "dlkf.evaluate", "model=mbkf15", "dataset={data}", "out={out}", "tracking.log=false"],
}


class Cost(NamedTuple):
    """Seconds of processor and by the clock, and the most memory at a time [GB] (of the largest process)."""

    processor_s: float
    clock_s: float
    memory_GB: float


def link_drives(source: Path, out: Path, hours: float) -> int:
    """The drives of ``source`` linked under new names until there are ``hours``; how many they are."""
    known = pd.read_parquet(source / "drives.parquet").to_dict("records")
    rows, seconds = [], 0.0
    while seconds < hours * 3600 - 1:
        row = known[len(rows) % len(known)]
        name = f"{len(rows):06d}"
        for kind in KINDS:
            file = drive_file(out, kind, name)
            file.parent.mkdir(parents=True)
            os.link(drive_file(source, kind, row["drive"]), file)
        rows.append({**row, "drive": name, "group": name})
        seconds += row["duration_s"]
    write_drives_table(out, rows)
    return len(rows)


def cost(work: list[str], environment: Mapping[str, str] | None = None) -> Cost:
    """Of a command of Python in an interpreter of its own, and of the processes that it starts."""
    start, nothing = time.monotonic(), subprocess.DEVNULL
    child = subprocess.Popen([sys.executable, *work], stdout=nothing, stderr=nothing, env=environment)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(work)} ended with code {child.returncode}")
    return Cost(used.ru_utime + used.ru_stime, time.monotonic() - start, used.ru_maxrss / 1e6)


def main() -> None:
    """Link, measure, print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("--hours", type=float, nargs="+", default=[42.0, 100.0])
    arguments.add_argument("--works", nargs="+", choices=WORKS, default=["open", "navigate"])
    arguments.add_argument("--repeats", type=int, default=1)
    o = arguments.parse_args()
    with tempfile.TemporaryDirectory(dir=o.dataset.parent) as home:
        print("| work | hours | drives | processor [s] | clock [s] | memory [GB] |\n|:--|--:|--:|--:|--:|--:|")
        for hours in o.hours:
            data = Path(home) / f"{hours:g}"
            count = link_drives(o.dataset, data, hours)
            for work in o.works:
                runs = []
                for repeat in range(o.repeats):
                    out = Path(home) / f"out-{work}-{data.name}-{repeat}"
                    runs.append(cost([word.format(data=data, out=out) for word in WORKS[work]]))
                best = Cost(*(min(values) for values in zip(*runs)))
                figures = f"{best.processor_s:.1f} | {best.clock_s:.1f} | {best.memory_GB:.2f}"
                print(f"| {work} | {hours:g} | {count} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
