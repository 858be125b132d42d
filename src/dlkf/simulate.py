"""Simulated and semi-real drives as a dataset: ``python -m dlkf.simulate dataset=per_drive imu=consumer``."""

from __future__ import annotations

import math
import time

import numpy as np
import pandas as pd

from dlkf.command import command
from dlkf.command.simulated import SimulateSettings
from dlkf.files import placed, readable
from dlkf.simulation.dataset import simulate
from dlkf.simulation.semi_real import simulate_semi_real


def arguments_of_source(arguments: list[str]) -> list[str]:
    """``source=`` alone means the dataset ``semi_real``, not simulated drives' default."""
    given = {argument.partition("=")[0].removeprefix("simulated@") for argument in arguments}
    return [*arguments, "dataset=semi_real"] if "source" in given and "dataset" not in given else arguments


@command("simulate", SimulateSettings, arguments_of_source)
def main(told: SimulateSettings) -> None:
    """Write the dataset to ``out`` (default ``data/<name>``) and say what it holds."""
    start = time.perf_counter()
    out = placed(told.out)
    if told.source:
        simulate_semi_real(told.source, told.recipe, out, overwrite=told.overwrite)
    else:
        simulate(told.recipe, out, overwrite=told.overwrite, workers=told.workers, parallel=told.parallel)
    drives = pd.read_parquet(readable(out / "drives.parquet"))
    hours = drives["duration_s"].sum() / 3600
    made_by = told.recipe
    errors = made_by.dataset.imu_errors
    types = {"fleet": f"of {len(made_by.dataset.fleet)} types", "wide": "of a new type each"}
    imu = types.get(errors, made_by.imu.name)
    print(
        f"{out}: {hours:.3g} h of {'semi-real ' if told.source else ''}drives with IMU {imu} "
        f"({errors}), seed {told.seed}, in {time.perf_counter() - start:.1f} s"
    )
    if "lateral_axle_mps" in drives:
        axle, at_imu = (math.sqrt(np.mean(drives[f"lateral_{at}_mps"].to_numpy() ** 2)) for at in ("axle", "imu"))
        print(f"velocity across the car, RMS above 2 m/s: {axle:.3f} m/s at the rear axle, {at_imu:.3f} m/s at the IMU")
    if told.pictures:
        from dlkf.simulation.pictures import write_pictures  # matplotlib takes a second to load

        print("pictures: " + ", ".join(str(path) for path in write_pictures(out, out / "pictures")))


if __name__ == "__main__":
    main()
