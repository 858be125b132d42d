"""Noise of an IMU from a log at rest: ``python -m dlkf.allan dataset=data/bench name=my_imu out=mine``.

Prints the noise of every axis and writes ``out/imu/<name>.yaml``, which ``--config-dir <out> imu=<name>`` takes,
beside the Allan deviations as picture, page and table.
"""

from __future__ import annotations

from dlkf.base.console import make_console
from dlkf.command import command
from dlkf.command.settings import AllanSettings
from dlkf.data.tables import read_drives
from dlkf.data.validate import read_imu
from dlkf.diagnosis.allan import analyse, choose_drive, noise_preset, noise_table, part, write_allan
from dlkf.evaluation.table import as_rich
from dlkf.navigation.imu_errors import imu_spec


@command("allan", AllanSettings)
def main(settings: AllanSettings) -> None:
    """Read, check that the IMU is at rest, fit, write, print."""
    name, base = settings.name, imu_spec(settings.imu)
    drive = choose_drive([row.name for row in read_drives(settings.dataset)], settings.drive)
    imu, rate = part(read_imu(settings.dataset, drive), settings.from_s, settings.to_s)
    log = analyse(drive, imu, rate, base)
    source = f"Allan deviation of {drive}, {log.duration_s / 3600:.3g} h at rest; all else from {base.name}"
    spec = noise_preset(name, (log.fits["accel"], log.fits["gyro"]), base, source, in_run=settings.in_run)
    write_allan(settings.out, log, spec)
    make_console().print(as_rich(noise_table(log)))
    print(f"Preset: {settings.out}/imu/{name}.yaml; report: {settings.out}/allan.html")


if __name__ == "__main__":
    main()
