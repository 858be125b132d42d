"""Test sets of ``plus`` for :mod:`pipelines.studies.plus`: simulated drives of other laws than those that its network
was trained with, and real motion with the errors of an IMU added.

    python -m pipelines.studies.simulated_laws gears rough --data data/plus    makes these sets

``tones`` vibrates at other frequencies, ``patches`` has rough patches that begin and end and no vibration, ``askew``
has mounts some 5° off (1σ per axis) and rough roads, ``steady`` drives minutes at constant speed, ``puck`` has
positions alone with 2 m of error that wanders over 40 s and a 1σ of 0.4 of the true one (``puck_other`` 3 m, 90 s, 0.6;
``puck_slow`` 1.5 m, 300 s, 0.8, IMU types not trained on; ``puck_white`` 1.5 m of white noise and the true 1σ),
``good`` has good IMUs alone, ``others`` IMU types not trained on; ``gears`` an engine with six gears and no wheel that
shakes, ``cvt`` one that turns at nearly one speed, and wheels; ``soft_mount`` both on a mount that rings at 12 Hz,
``rough`` loud bursts from bad roads, ``phone`` a holder that rings at 9 Hz and sways, with IMU types not trained on;
``pyins_*`` are made by python-ins.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

from pipelines.studies.parity import write_drives

from dlkf.command.composing import imu_preset
from dlkf.command.simulated import compose_recipe
from dlkf.simulation.dataset import simulate
from dlkf.simulation.motion import chassis

TONES = ((28.0, 0.0, 0.5), (0.0, 0.37, 0.2), (14.0, 0.8, 0.3))  # of `tones`: Hz at rest, per metre, share of the power
COMMON = ("dataset.hours=3.6", "dataset.drive_minutes=18")
SILENT = ("dataset.chassis.vibration=0", "dataset.chassis.vibration_rate=0")
STEADY = (
    "dataset.vehicle.manoeuvres={stretch: 0.7, turn: 0.15, stop: 0.15, eight: 0.0, slowest: 0.3, "
    "turn_deg: [10.0, 90.0], stretch_s: [60.0, 180.0], stop_s: [3.0, 30.0]}"
)
PATCHES = ("+dataset.chassis.roughness_spread=1.3", "+dataset.chassis.roughness_length=80")


def positions(std: float, wander: float, wander_s: float, factor: float) -> tuple[str, ...]:
    """A receiver of positions alone: 1σ of white noise and of what wanders [m], its time, and the share it reports."""
    return (
        f"dataset.gnss.std_horizontal={std}", f"dataset.gnss.std_vertical={2 * std}", f"+dataset.gnss.wander={wander}",
        f"+dataset.gnss.wander_s={wander_s}", f"+dataset.gnss.std_factor={factor}", "dataset.gnss.quality=1",
        "receiver=white",
    )  # fmt: skip


def shaking(**sizes: float) -> tuple[str, ...]:
    """A car that vibrates by sources of :class:`dlkf.simulation.motion.shaking.Shaking` alone."""
    return *SILENT, *(f"+dataset.chassis.shaking.{name}={value}" for name, value in sizes.items())


NOT_GOOD = ("automotive_mems", "lifelike_mems", "consumer", "icm20602", "bmi055")
SIMULATED: Mapping[str, tuple[str, ...]] = {
    "tones": ("simulated@dataset=fleet", "seed=7101"),
    "patches": ("simulated@dataset=fleet", "seed=7102", *SILENT, *PATCHES),
    "askew": (
        "simulated@dataset=other_imus", "seed=7103", "dataset.chassis.mounting_std_deg=5",
        "dataset.chassis.roughness=512e-6",
    ),
    "steady": ("simulated@dataset=fleet", "seed=7104", *SILENT, "dataset.chassis.roughness=4e-6", STEADY),
    "puck": ("simulated@dataset=fleet", "seed=7105", *positions(0.5, 2.0, 40, 0.4)),
    "puck_other": ("simulated@dataset=fleet", "seed=8105", *positions(0.6, 3.0, 90, 0.6)),
    "puck_slow": ("simulated@dataset=other_imus", "seed=8108", *positions(0.4, 1.5, 300, 0.8)),
    "puck_white": ("simulated@dataset=fleet", "seed=8109", *positions(1.5, 0.0, 40, 1.0)),
    "good": ("simulated@dataset=fleet", "seed=7106", *(f"~dataset.fleet.{kind}" for kind in NOT_GOOD)),
    "others": ("simulated@dataset=other_imus", "seed=7107"),
    "gears": ("simulated@dataset=fleet", "seed=9301", *shaking(engine=0.4, gears=6, wander=0.005)),
    "cvt": (
        "simulated@dataset=fleet", "seed=9304",
        *shaking(engine=0.4, gears=0, shift_hz=45, wander=0.03, wheel=0.05, wheel_turns=0.5),
    ),
    "soft_mount": (
        "simulated@dataset=fleet", "seed=9308",
        *shaking(engine=0.4, wheel=0.1, rumble=0.4, mount_hz=12, mount_damping=0.1, rattle=5),
    ),
    "rough": (
        "simulated@dataset=fleet", "seed=9402", "dataset.chassis.roughness=512e-6",
        *shaking(engine=0.5, rumble=2.0, bursts=1.0, turning=0.03, rattle=10),
    ),
    "phone": (
        "simulated@dataset=other_imus", "seed=9401", "dataset.chassis.roughness=256e-6",
        *shaking(engine=0.5, wheel=0.1, rumble=1.0, bursts=0.8, mount_hz=9, mount_damping=0.08, turning=0.05,
                 sway=0.003, rattle=8),
    ),
    "fleet": ("simulated@dataset=fleet", "seed=601"),
}  # fmt: skip
PYTHON_INS = {"pyins_adis": "adis16465_i2nav", "pyins_consumer": "consumer"}
INJECTED = {"kitti_consumer": ("consumer", 21), "kitti_adis": ("adis16465_i2nav", 22)}


def simulate_sets(data: Path, real: Path | None, wanted: Collection[str]) -> None:
    """Those of the wanted test sets that are not there yet."""
    for name, words in SIMULATED.items():
        if name in wanted and not (data / name).is_dir():
            with_tones = chassis.TONES
            chassis.TONES = TONES if name == "tones" else with_tones
            try:
                simulate(compose_recipe(*words, *COMMON), data / name, workers=1)
            finally:
                chassis.TONES = with_tones
    for name, imu in PYTHON_INS.items():
        if name in wanted and not (data / name).is_dir():
            write_drives(data / name, imu_preset(imu), 12, 18)
    for name, (imu, seed) in INJECTED.items() if real is not None else ():
        if name in wanted and not (data / name).is_dir():
            words = [f"source={real}/kitti", f"imu={imu}", f"seed={seed}", f"out={data / name}"]
            subprocess.run([sys.executable, "-m", "dlkf.simulate", *words], check=True)


def main() -> None:
    """Make the sets that are named, or all."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("sets", nargs="*", help="all of them if none is named")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where they lie, or are made")
    arguments.add_argument("--real", type=Path, help="folder with kitti, whose motion kitti_* take")
    options = arguments.parse_args()
    simulate_sets(options.data, options.real, options.sets or (*SIMULATED, *PYTHON_INS, *INJECTED))


if __name__ == "__main__":
    main()
