"""What exported filters need and how near they are: the numbers of ``docs/vehicle.md``.

python -m tests.onboard.measured sizes mbkf21_car plus dlkf       flash, memory, stack, instructions
python -m tests.onboard.measured time mbkf21_car                  Python and C interleaved, p50 and p99 of a row's call
python -m tests.onboard.measured float mbkf21_car --minutes 60    single precision against double
"""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dlkf.data.store import drive_rows
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.onboard.c_source import EXAMPLES, write_source
from dlkf.onboard.check import Latency, write_log
from dlkf.onboard.functions import Grid
from dlkf.onboard.library import CORE, FILTER, build
from dlkf.running.streaming import StreamingFilter
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from tests.onboard.conftest import ARM, IMU, model_of
from tests.onboard.core import Core
from tests.onboard.programs import compile_program, run, stack_of_calls
from tests.onboard.streams import METRES, SOLUTION, calls, through_core

CORTEX_M7 = ("-mcpu=cortex-m7", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-std=c99", "-O2")
SIZES = {"2 s late, 100 Hz": ("-DDLKF_IMU_HZ=100", "-DDLKF_LATE_S=2"), "10 s late, 1000 Hz": ()}
SIZE = '#include <stdio.h>\n#include "dlkf.h"\nint main(void) { printf("%zu", sizeof(dlkf)); }\n'
COURSE_ALONE = "-DDLKF_SEARCH_S=0"
COUNTED_S, TIMED_S = 120.0, 600.0  # of a drive
COUNTED = ("dlkf_turn", "dlkf_search_advance", "dlkf_pose")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", help="sizes, time, float, or several of them with commas")
    parser.add_argument("models", nargs="+")
    parser.add_argument("--minutes", type=float, default=2.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as somewhere:
        tables = a_drive(Path(somewhere), options.minutes)
        for name in options.models:
            folder = Path(somewhere) / name
            folder.mkdir()
            model = model_of(name)
            write_source(folder, model, Grid(50, 0.02), name, {})
            for what in options.what.split(","):
                {"sizes": sizes, "time": times, "float": precision}[what](name, model, tables, folder)


def a_drive(folder: Path, minutes: float) -> CheckedTables:
    """Simulated, with an IMU of 100 Hz."""
    gnss = GnssConfig(lever_arm_b=ARM)
    config = DatasetConfig("one", hours=minutes / 60, drive_minutes=minutes, gnss=gnss)
    data = simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)
    return read_drive(data, drive_rows(data)[0], reference=False)


def first(tables: CheckedTables, seconds: float) -> CheckedTables:
    """The beginning of a drive."""
    imu, gnss = (
        {c: v[x["t"] <= tables.imu["t"][0] + seconds] for c, v in x.items()} for x in (tables.imu, tables.gnss)
    )
    return replace(tables, imu=imu, gnss=gnss)


def sizes(name: str, model: Any, tables: CheckedTables, folder: Path) -> None:
    """Lines of a table, for one model."""
    flash = {}
    for source in (*CORE, *FILTER):
        run(["arm-none-eabi-gcc", *CORTEX_M7, "-c", folder / source, "-o", folder / "x.o"])
        text, data, *_ = run(["arm-none-eabi-size", folder / "x.o"]).stdout.splitlines()[1].split()
        flash[source] = int(text) + int(data)
    core = sum(flash[x] for x in CORE)
    print(f"{name}: flash, core {core / 1e3:.0f} kB, search {flash['heading.c'] / 1e3:.0f} kB, "
          f"filter {(flash['step.c'] + flash['weights.c']) / 1e3:.0f} kB", flush=True)  # fmt: skip
    (folder / "size.c").write_text(SIZE)
    for label, flags in SIZES.items():
        found = []
        for more in ((), (COURSE_ALONE,)):
            run(["gcc", *flags, *more, f"-I{folder}", folder / "size.c", "-o", folder / "size"])
            found.append(f"{int(run([folder / 'size']).stdout) / 1e3:.0f} kB")
        print(f"{name}: sizeof(dlkf), fixes {label}: {found[0]}, without search {found[1]}", flush=True)
    deepest = stack_of_calls("arm-none-eabi-gcc", folder, folder, CORTEX_M7)
    worst = max(deepest, key=lambda function: deepest[function])
    print(f"{name}: stack {deepest[worst]} B, of {worst}", flush=True)
    print(f"{name}: instructions {counted(folder, tables)}", flush=True)


def counted(folder: Path, tables: CheckedTables) -> str:
    """Instructions of calls on this machine, from callgrind over a drive."""
    log = folder / "drive.csv"
    write_log(log, first(tables, COUNTED_S))
    program = compile_program("gcc", folder, EXAMPLES / "navigate.c", folder / "navigate", ("-g", "-O2", "-fno-inline"))
    command = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={folder / 'out'}", program, "--samples", "--arm"]
    with log.open() as lines:
        subprocess.run([*command, *map(str, ARM)], stdin=lines, check=True, capture_output=True)
    listing = run(["callgrind_annotate", "--inclusive=yes", "--threshold=100", folder / "out"]).stdout
    made = (folder / "out").read_text()
    parts = []
    for function in COUNTED:
        found = re.search(rf"^ *([\d,]+) .*:{function}(?:'2)? ", listing, re.MULTILINE)
        times = called(made, function)
        if found and times:
            parts.append(f"{function} {int(found[1].replace(',', '')) / times:,.0f} ({times} calls)")
    return ", ".join(parts)


def called(text: str, function: str) -> int:
    """How often callgrind saw a function called."""
    names = dict(re.findall(r"cfn=\((\d+)\)(?: ([^\n]+))?", text)) | dict(re.findall(r"fn=\((\d+)\) ([^\n]+)", text))
    number = next((k for k, name in names.items() if name == function), "-")
    return sum(map(int, re.findall(rf"cfn=\({number}\)[^\n]*\ncalls=(\d+)", text)))


def times(name: str, model: Any, tables: CheckedTables, folder: Path) -> None:
    """Calls that close an update interval, in Python and in C interleaved."""
    both = {"Python": StreamingFilter(model, lever_arm_b=ARM), "C": Core(build(folder), ARM)}
    spent: dict[str, list[float]] = {x: [] for x in both}
    for call in calls(first(tables, TIMED_S)):
        for kind, stream in both.items():
            began = time.perf_counter()
            receipt = getattr(stream, call.kind)(*call.arguments)
            took = time.perf_counter() - began
            if len(receipt[1]):
                spent[kind].append(took)
    latencies = {kind: Latency.of(x[20:]) for kind, x in spent.items()}
    print("\n".join(f"{name}, a row in {k}: p50 {x.p50:.3f} ms, p99 {x.p99:.3f} ms" for k, x in latencies.items()))


def precision(name: str, model: Any, tables: CheckedTables, folder: Path) -> None:
    """Positions, velocities and attitudes of both precisions over a drive."""
    single, solutions = folder / "single", []
    single.mkdir()
    write_source(single, model, Grid(50, 0.02, torch.float32), name, {})
    for at in (folder, single):
        solutions.append(through_core(Core(build(at), ARM), calls(tables)).solution)
    apart = np.abs(solutions[0] - solutions[1])
    for columns, unit in (
        (("lat_deg", "lon_deg", "height_m"), "m"), (("vel_n", "vel_e", "vel_d"), "m/s"), (("roll", "pitch"), "rad"),
    ):  # fmt: skip
        x = np.stack([apart[:, SOLUTION.index(c)] * METRES.get(c, 1.0) for c in columns], -1)
        rms = np.sqrt(np.square(x).sum(-1).mean())
        print(f"{name}, float against double over {len(x)} s: {', '.join(columns)} largest {x.max():.2g} {unit}, "
              f"RMS {rms:.2g}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
