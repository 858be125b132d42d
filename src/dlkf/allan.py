"""Noise of an IMU from a log at rest: ``python -m dlkf.allan dataset=data/bench name=my_imu out=mine``.

Prints the noise of every axis and writes ``out/imu/<name>.yaml``, which ``--config-dir <out> imu=<name>`` takes,
beside the Allan deviations as picture, page and table.
"""

from __future__ import annotations

import re
import sys
from typing import Any

from rich.console import Console

from dlkf.command import command
from dlkf.data.tables import read_drives
from dlkf.data.validate import read_imu
from dlkf.diagnosis.allan import preset
from dlkf.diagnosis.allan_report import analyse, chosen, noise_table, part, write_allan
from dlkf.errors import InputError
from dlkf.evaluation.table import as_rich
from dlkf.navigation.imu_errors import imu_spec


@command("allan")
def main(config: dict[str, Any]) -> None:
    """Read, check that the IMU is at rest, fit, write, print."""
    name, in_run, base = str(config["name"]), config["in_run"], imu_spec(config["imu"])
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise InputError(f"name={name} must be letters, digits, _ and -: it names a file")
    if in_run not in ("fit", "keep"):
        raise InputError(f"in_run={in_run} is none of fit, keep")
    drive = chosen([row.name for row in read_drives(config["dataset"])], config["drive"])
    imu, rate = part(read_imu(config["dataset"], drive), config["from_s"], config["to_s"])
    log = analyse(drive, imu, rate, base)
    source = f"Allan deviation of {drive}, {log.duration_s / 3600:.3g} h at rest; all else from {base.name}"
    spec = preset(name, (log.fits["accel"], log.fits["gyro"]), base, source, in_run=in_run)
    write_allan(config["out"], log, spec)
    Console(width=None if sys.stdout.isatty() else 110).print(as_rich(noise_table(log)))
    print(f"Preset: {config['out']}/imu/{name}.yaml; report: {config['out']}/allan.html")


if __name__ == "__main__":
    main()
