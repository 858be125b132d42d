"""A filter for a vehicle, as C without libraries: ``python -m dlkf.export model=mbkf21_car out=outputs/onboard``.

Writes ``step.c`` with its header and description, an example and a ROS 2 node that use it, and a drive for the
example; then runs the exported filter and the original over that drive and says how far they are apart.
"""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path

import torch

from dlkf.command import command
from dlkf.command.settings import ExportSettings
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_checked
from dlkf.errors import InputError
from dlkf.files import is_url, staged, vacant
from dlkf.filters.saved import grid_of
from dlkf.filters.smoother import Smoothed
from dlkf.models import resolve_model, short_name
from dlkf.onboard.c_source import CPP, write_source
from dlkf.onboard.check import checked, write_log
from dlkf.onboard.functions import Grid
from dlkf.onboard.library import compiler
from dlkf.provenance import provenance
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig

EXAMPLES = ("navigate.cpp", "ros2_node.cpp", "CMakeLists.txt")
ARM = (1.0, 0.3, -1.2)  # m, IMU to antenna of the simulated car


@command("export", ExportSettings)
def main(told: ExportSettings) -> None:
    """Resolve, write, check, print."""
    vacant(told.out, overwrite=told.overwrite)
    imu = told.spec
    model = resolve_model(str(told.model), imu, told.tracking.uri, **told.told)
    if isinstance(model, Smoothed):
        raise InputError(f"model={told.model} looks ahead, which a vehicle cannot; take it without _rts")
    given = grid_of([model], told.rate_hz, told.epoch_s)
    grid = Grid(round(given["rate_hz"] * given["epoch_s"]), 1 / given["rate_hz"])
    with staged(told.out) as folder, tempfile.TemporaryDirectory() as somewhere:
        dataset = told.dataset
        if dataset is None:
            drive = DatasetConfig("check", hours=5 / 60, drive_minutes=5.0, gnss=GnssConfig(lever_arm_b=ARM))
            dataset = simulate_dataset(drive, imu, 0, Path(somewhere) / "check", progress=False, workers=1)
        tables = read_checked(dataset, drive_rows(dataset, told.drive)[0], reference=False)
        drive = drive_from_tables(tables, "", given["rate_hz"], given["epoch_s"], torch.float64)
        layout = write_source(folder, model, grid, short_name(told.model), provenance())
        for name in EXAMPLES:
            (folder / name).write_text((CPP / name).read_text())
        write_log(folder / "drive.csv", tables, drive)
        if compiler() is None:
            lines = ["not checked: no C compiler here (cc, gcc or clang)"]
        else:
            lines = checked(Path(somewhere), folder, model, grid, layout, tables, drive, told.latency)
    arm = " ".join(f"{x:g}" for x in tables.row.lever_arm_b)
    print(f"{short_name(told.model)} as C in {told.out}: {layout.size} numbers of memory, step.h says how")
    print("\n".join(lines))
    if not is_url(told.out):
        print(f"Try it: cd {shlex.quote(told.out)} && cmake -B build && cmake --build build "
              f"&& build/navigate --arm {arm} < drive.csv > solution.csv")  # fmt: skip


if __name__ == "__main__":
    main()
