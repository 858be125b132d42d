"""A simulated IMU at rest as a dataset: a log for ``dlkf.allan`` whose noise is known.

python -m pipelines.studies.static_log data/bench --imu consumer --hours 6
python -m dlkf.allan dataset=data/bench imu=consumer name=bench out=outputs/allan
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from dlkf.command.composing import imu_preset
from dlkf.data.schema import new_dataset, write_drive, write_drives_table
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.simulation.imu import corrupt, draw_unit, inverse_mechanisation
from dlkf.simulation.motion.vehicle import Truth
from dlkf.simulation.tables import fix_columns, imu_columns

LAT, LON, HEIGHT = math.radians(52.15), math.radians(9.95), 100.0


def write_static_log(folder: Path, spec: ImuSpec, hours: float, rate_hz: int, seed: int, overwrite: bool) -> None:
    """One drive of a level IMU at rest, with the errors of a unit of the preset's kind."""
    rng = np.random.default_rng(seed)
    n = round(hours * 3600 * rate_hz)
    three, zero = np.arange(3) / rate_hz, np.zeros(3)
    still = Truth(three, zero + LAT, zero + LON, zero + HEIGHT, np.zeros((3, 3)), np.zeros((3, 3)))
    sample = inverse_mechanisation(still)[0]  # at rest every sample is alike
    measured, _ = corrupt(rng, np.tile(sample, (n, 1)), spec, draw_unit(rng, spec), rate_hz)
    t = np.arange(1, n + 1) / rate_hz
    fixes = t[rate_hz - 1 :: rate_hz]
    n_fixes = len(fixes)
    lat, lon, height = (np.full(n_fixes, x) for x in (LAT, LON, HEIGHT))
    fix = fix_columns(fixes, lat, lon, height, np.zeros((n_fixes, 3)), np.full((n_fixes, 6), 0.02), np.full(n_fixes, 4))
    row = {"drive": "static", "source": f"simulation, seed {seed}", "licence": "none: simulated", "imu": spec.name}
    with new_dataset(folder, overwrite) as beside:
        imu, gnss = pd.DataFrame(imu_columns(t, measured)), pd.DataFrame(fix)
        write_drives_table(beside, [write_drive(beside, row, imu, gnss)])


def main() -> int:
    """Simulate and write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--imu", default="consumer", help="a preset of conf/imu")
    arguments.add_argument("--hours", type=float, default=6.0)
    arguments.add_argument("--rate-hz", type=int, default=100)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--overwrite", action="store_true")
    o = arguments.parse_args()
    write_static_log(o.folder, imu_preset(o.imu), o.hours, o.rate_hz, o.seed, o.overwrite)
    print(f"{o.folder}: {o.hours:g} h of {o.imu} at rest, {o.rate_hz} Hz, seed {o.seed}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
