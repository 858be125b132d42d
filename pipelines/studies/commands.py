"""What a user waits for: whole commands, ``python -m pipelines.studies.commands outputs/commands``.

``dlkf --help``, the help of a command, ``dlkf navigate`` on a drive of five minutes and on 20 hours of drives of 20
minutes, 100 Hz, from the command to its page, in torch and as C from the cache, and ``dlkf evaluate`` on two hours.
Every run is a process of its own, torch with ``--threads``. With ``--beside`` another checkout of the project runs the
same commands in alternation, and the solutions of both are compared file by file. The least of the rounds counts; the
first also fills the caches, of bytecode as pip leaves it with an installation.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from pipelines.studies.long_lists import Cost, cost, link_drives

HERE = Path(__file__).parents[2]
IMU_HZ, SHORT_MIN, LONG_H, LINKED_H = 100, 5, 20, 2
WORKS = {
    "dlkf --help": ["--help"],
    "dlkf navigate --help": ["navigate", "--help"],
    "five minutes, page": ["navigate", "dataset={home}/short", "out={out}"],
    "five minutes, page, compiled": ["navigate", "dataset={home}/short", "out={out}", "compiled=true"],
    "2 h, page": ["navigate", "model={model}", "dataset={home}/two", "out={out}"],
    "20 h, page": ["navigate", "model={model}", "dataset={home}/long", "out={out}"],
    "20 h, page, compiled": ["navigate", "model={model}", "dataset={home}/long", "out={out}", "compiled=true"],
    "2 h, evaluate": ["evaluate", "model={model}", "dataset={home}/two", "out={out}", "tracking.log=false"],
}


def environment(checkout: Path, home: Path, threads: int = 1) -> dict[str, str]:
    """Of a process that runs a checkout, with a cache of its bytecode."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    source = str(checkout.resolve() / "src")
    cache = home / "bytecode" / hashlib.sha256(source.encode()).hexdigest()[:8]
    return {**kept, "PYTHONPATH": source, "PYTHONPYCACHEPREFIX": str(cache.resolve()), "OMP_NUM_THREADS": f"{threads}"}


def simulate(home: Path) -> None:
    """The drives, where they are not there yet."""
    for name, hours, minutes in (("short", SHORT_MIN / 60, SHORT_MIN), ("two", LINKED_H, 20)):
        if not (home / name).exists():
            settings = f"dataset.hours={hours} dataset.drive_minutes={minutes} dataset.imu_rate_hz={IMU_HZ}"
            work = ["-m", "dlkf", "simulate", "dataset=per_drive", *settings.split(), f"out={home / name}"]
            subprocess.run([sys.executable, *work], check=True, env=environment(HERE, home), stdout=subprocess.DEVNULL)
    if not (home / "long").exists():
        link_drives(home / "two", home / "long", LONG_H)


def solutions(out: Path) -> Mapping[str, str]:
    """Digests of the solutions below a folder."""
    found = sorted(out.rglob("solution.parquet"))
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def compare(home: Path, checkouts: list[Path], works: list[str], model: str, rounds: int, threads: int) -> None:
    """Run in alternation, print a row for each work."""
    print("| work | checkout | clock [s] | processor [s] | memory [GB] | clock, processor: share | solutions |")
    print("|:--|:--|--:|--:|--:|--:|:--|")
    for work in works:
        runs: dict[Path, list[Cost]] = {checkout: [] for checkout in checkouts}
        left: dict[Path, Mapping[str, str]] = {}
        for _ in range(rounds):
            for checkout in checkouts:
                out = home / "out"
                shutil.rmtree(out, ignore_errors=True)
                words = [word.format(home=home, out=out, model=model) for word in WORKS[work]]
                runs[checkout].append(cost(["-m", "dlkf", *words], environment(checkout, home, threads)))
                left[checkout] = solutions(out)
        best = {checkout: Cost(*map(min, zip(*of))) for checkout, of in runs.items()}
        first = best[checkouts[-1]]
        for checkout, of in best.items():
            share = f"{of.clock_s / first.clock_s:.2f}, {of.processor_s / first.processor_s:.2f}"
            same = "" if not left[checkout] else "equal" if left[checkout] == left[checkouts[-1]] else "DIFFERENT"
            costs = f"{of.clock_s:.2f} | {of.processor_s:.2f} | {of.memory_GB:.2f}"
            print(f"| {work} | {checkout.resolve().name} | {costs} | {share} | {same} |", flush=True)


def main() -> None:
    """Simulate, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("home", type=Path, help="folder for drives and bytecode")
    parser.add_argument("--beside", type=Path, help="another checkout, to which times are given as a share")
    parser.add_argument("--works", nargs="+", choices=WORKS, default=list(WORKS))
    parser.add_argument("--model", default="mbkf15", help="of the 20 h")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    options = parser.parse_args()
    home = options.home.absolute()
    simulate(home)
    checkouts = [HERE, *([options.beside] if options.beside else [])]
    compare(home, checkouts, options.works, options.model, options.rounds, options.threads)


if __name__ == "__main__":
    main()
