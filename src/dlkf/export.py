"""A filter for a vehicle, as C without libraries: ``python -m dlkf.export model=mbkf21_car out=outputs/onboard``.

Writes the filter (``step.c``), the core round it (``dlkf.h``), an example and a ROS 2 node that use it, and a drive for
the example; then runs the core and the original over that drive and says how far they are apart.
"""

from __future__ import annotations

import shlex
import tempfile
from pathlib import Path

import torch

from dlkf.base.errors import InputError
from dlkf.base.files import is_url, require_empty, write_into
from dlkf.base.provenance import describe_provenance
from dlkf.command import command, list_typed_words
from dlkf.command.settings import ExportSettings
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import read_drive
from dlkf.filters.aids.attach import add_chosen_aids, find_tables
from dlkf.filters.card import describe_slow_drives
from dlkf.filters.saved import choose_grid
from dlkf.filters.smoother import SmoothedSolution
from dlkf.onboard.c_source import EXAMPLES, write_source
from dlkf.onboard.check import check_export, write_log
from dlkf.onboard.functions import Grid
from dlkf.onboard.library import find_compiler
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.sensors import BaroConfig, HeadingConfig, SensorsConfig, WheelConfig
from dlkf.tracking.models import resolve_model, short_name, unused_settings

COPIED = ("navigate.c", "ros2_node.cpp", "CMakeLists.txt")
ARM = (1.0, 0.3, -1.2)  # m, IMU to antenna of the simulated car
SENSORS = SensorsConfig(WheelConfig(scale=0.02, delay_s=0.1), HeadingConfig(), BaroConfig())  # of its


@command("export", ExportSettings)
def main(settings: ExportSettings) -> None:
    """Resolve, write, check, print."""
    require_empty(settings.out, overwrite=settings.overwrite)
    imu = settings.spec
    model = resolve_model(str(settings.model), imu, settings.tracking.uri, **settings.filter_options)
    if line := unused_settings(str(settings.model), list_typed_words("imu", "tuning")):
        print(line)
    if isinstance(model, SmoothedSolution):
        raise InputError(f"model={settings.model} looks ahead, which a vehicle cannot; take it without _rts")
    name = short_name(settings.model)
    if settings.aids is not None:
        model = add_chosen_aids(name, model, settings.aids)
    given = choose_grid([model], settings.rate_hz, settings.epoch_s)
    for line in describe_slow_drives({name: model}, [given["rate_hz"]], "this export has"):
        print(line)
    dtype = {"double": torch.float64, "float": torch.float32}[settings.precision]
    grid = Grid(round(given["rate_hz"] * given["epoch_s"]), 1 / given["rate_hz"], dtype)
    with write_into(settings.out) as folder, tempfile.TemporaryDirectory() as somewhere:
        dataset = settings.dataset
        if dataset is None:
            sensors = SENSORS if find_tables(model) else None
            gnss = GnssConfig(lever_arm_b=ARM)
            drive = DatasetConfig("check", hours=5 / 60, drive_minutes=5.0, gnss=gnss, sensors=sensors)
            dataset = simulate_dataset(drive, imu, 0, Path(somewhere) / "check", progress=False, workers=1)
        tables = read_drive(dataset, drive_rows(dataset, settings.drive)[0], reference=False)
        drive = drive_from_tables(tables, "", given["rate_hz"], given["epoch_s"], torch.float64, find_tables(model))
        layout = write_source(folder, model, grid, name, describe_provenance())
        for example in COPIED:
            (folder / example).write_text((EXAMPLES / example).read_text())
        write_log(folder / "drive.csv", tables)
        if find_compiler() is None:
            lines = ["not checked: no C compiler here (cc, gcc or clang)"]
        else:
            lines = check_export(Path(somewhere), folder, model, grid, layout, tables, drive, settings.latency)
    arm = " ".join(f"{x:g}" for x in tables.row.lever_arm_b)
    print(f"{name} as C in {settings.out}: dlkf.h describes the calls")
    print("\n".join(lines))
    if not is_url(settings.out):
        print(f"Try it: cd {shlex.quote(settings.out)} && cmake -B build && cmake --build build "
              f"&& build/navigate --arm {arm} < drive.csv > solution.csv")  # fmt: skip


if __name__ == "__main__":
    main()
