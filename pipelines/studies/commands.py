"""What a user waits for: whole commands, ``python -m pipelines.studies.commands outputs/commands``.

``dlkf --help``, the help of a command, ``dlkf navigate`` on a drive of five minutes, and works on so many ``--hours``
of drives of 20 minutes at 100 Hz: ``open`` (load, check, resample, cut), ``navigate`` from the command to its page in
torch, as C from the cache, on two processes, ``evaluate``. Longer lists are two hours of drives under new names (links:
no room on the disk). Every run is a process of its own, torch with ``--threads``; memory is that of the largest
process. With ``--beside`` another checkout of the project runs the same commands in alternation, and the solutions of
both are compared file by file. The least of the rounds counts; the first also fills the caches, of bytecode as pip
leaves it with an installation.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from dlkf.data.schema import drive_file, write_drives_table

HERE = Path(__file__).parents[2]
IMU_HZ, SHORT_MIN, LINKED_H = 100, 5, 2
KINDS = ("imu", "gnss", "reference")
OPEN = """
import sys, torch
from dlkf.data.segments import cut_segments
from dlkf.data.store import load_dataset
drives = load_dataset(sys.argv[1])
print(len(drives), "drives,", len(cut_segments(drives, 120.0, 60.0, attitude=True)), "segments")
"""
LIST = ["-m", "dlkf", "navigate", "model={model}", "dataset={data}", "out={out}"]
SHORT = ["-m", "dlkf", "navigate", "dataset={home}/short", "out={out}"]
WORKS = {
    "help": ["-m", "dlkf", "--help"],
    "navigate help": ["-m", "dlkf", "navigate", "--help"],
    "five minutes": SHORT,
    "five minutes, compiled": [*SHORT, "compiled=true"],
    "open": ["-c", OPEN, "{data}"],
    "navigate": LIST,
    "parallel": [*LIST, "parallel=2"],
    "compiled": [*LIST, "compiled=true"],
    "both": [*LIST, "compiled=true", "parallel=2"],
    "evaluate": ["-m", "dlkf", "evaluate", "model={model}", "dataset={data}", "out={out}", "tracking.log=false"],
}
USUAL = ("help", "navigate help", "five minutes", "five minutes, compiled", "navigate", "compiled", "evaluate")


class Cost(NamedTuple):
    """Seconds of processor and by the clock, and the most memory at a time [GB] (of the largest process)."""

    processor_s: float
    clock_s: float
    memory_GB: float


def cost(work: list[str], environment: Mapping[str, str]) -> Cost:
    """Of a command of Python in an interpreter of its own, and of the processes that it starts."""
    start, nothing = time.monotonic(), subprocess.DEVNULL
    child = subprocess.Popen([sys.executable, *work], stdout=nothing, stderr=nothing, env=environment)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{' '.join(work)} ended with code {child.returncode}")
    return Cost(used.ru_utime + used.ru_stime, time.monotonic() - start, used.ru_maxrss / 1e6)


def environment(checkout: Path, home: Path, threads: int = 1) -> dict[str, str]:
    """Of a process that runs a checkout, with a cache of its bytecode."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    source = str(checkout.resolve() / "src")
    cache = home / "bytecode" / hashlib.sha256(source.encode()).hexdigest()[:8]
    return {**kept, "PYTHONPATH": source, "PYTHONPYCACHEPREFIX": str(cache.resolve()), "OMP_NUM_THREADS": f"{threads}"}


def simulate(home: Path) -> None:
    """The drives, where they are not there yet."""
    for name, hours, minutes in (("short", SHORT_MIN / 60, SHORT_MIN), ("linked", LINKED_H, 20)):
        if not (home / name).exists():
            settings = f"dataset.hours={hours} dataset.drive_minutes={minutes} dataset.imu_rate_hz={IMU_HZ}"
            work = ["-m", "dlkf", "simulate", "dataset=per_drive", *settings.split(), f"out={home / name}"]
            subprocess.run([sys.executable, *work], check=True, env=environment(HERE, home), stdout=subprocess.DEVNULL)


def link_drives(home: Path, hours: float) -> Path:
    """The two hours of drives linked under new names until there are so many, where they are not there yet."""
    source, out = home / "linked", home / f"{hours:g}h"
    known = pd.read_parquet(source / "drives.parquet").to_dict("records")
    rows, seconds = [], 0.0
    while seconds < hours * 3600 - 1 and not (out / "drives.parquet").exists():
        row = known[len(rows) % len(known)]
        name = f"{len(rows):06d}"
        for kind in KINDS:
            file = drive_file(out, kind, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.unlink(missing_ok=True)  # of a run that was killed
            os.link(drive_file(source, kind, row["drive"]), file)
        rows.append({**row, "drive": name, "group": name})
        seconds += row["duration_s"]
    if rows:
        write_drives_table(out, rows)
    return out


def solutions(out: Path) -> Mapping[str, str]:
    """Digests of the solutions below a folder."""
    found = sorted(out.rglob("solution.parquet"))
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def compare(home: Path, name: str, work: list[str], checkouts: list[Path], rounds: int, threads: int) -> None:
    """Run a work in alternation, print its rows."""
    runs: dict[Path, list[Cost]] = {checkout: [] for checkout in checkouts}
    left: dict[Path, Mapping[str, str]] = {}
    for _ in range(rounds):
        for checkout in checkouts:
            out = home / "out"
            shutil.rmtree(out, ignore_errors=True)
            words = [word.replace("{out}", str(out)) for word in work]
            runs[checkout].append(cost(words, environment(checkout, home, threads)))
            left[checkout] = solutions(out)
    best = {checkout: Cost(*map(min, zip(*of))) for checkout, of in runs.items()}
    first = best[checkouts[-1]]
    for checkout, of in best.items():
        share = f"{of.clock_s / first.clock_s:.2f}, {of.processor_s / first.processor_s:.2f}"
        same = "" if not left[checkout] else "equal" if left[checkout] == left[checkouts[-1]] else "DIFFERENT"
        costs = f"{of.clock_s:.2f} | {of.processor_s:.2f} | {of.memory_GB:.2f}"
        print(f"| {name} | {checkout.resolve().name} | {costs} | {share} | {same} |", flush=True)


def main() -> None:
    """Simulate, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("home", type=Path, help="folder for drives and bytecode")
    parser.add_argument("--beside", type=Path, help="another checkout, to which times are given as a share")
    parser.add_argument("--works", nargs="+", choices=WORKS, default=list(USUAL))
    parser.add_argument("--hours", type=float, nargs="+", default=[2.0, 20.0], help="of the lists of drives")
    parser.add_argument("--model", default="mbkf15", help="of the lists")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    options = parser.parse_args()
    home = options.home.absolute()
    simulate(home)
    checkouts = [HERE, *([options.beside] if options.beside else [])]
    print("| work | checkout | clock [s] | processor [s] | memory [GB] | clock, processor: share | solutions |")
    print("|:--|:--|--:|--:|--:|--:|:--|")
    for name in options.works:
        for hours in options.hours if "{data}" in " ".join(WORKS[name]) else [None]:
            given = {"home": home, "model": options.model, "data": hours and link_drives(home, hours), "out": "{out}"}
            title = f"{name}, {hours:g} h" if hours else name
            work = [word.format(**given) for word in WORKS[name]]
            compare(home, title, work, checkouts, options.rounds, options.threads)


if __name__ == "__main__":
    main()
