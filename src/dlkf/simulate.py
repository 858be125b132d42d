"""Simulated and semi-real drives as a dataset: ``python -m dlkf.simulate dataset=per_drive imu=consumer``."""

from __future__ import annotations

import math
import time

import numpy as np
from hydra.core.hydra_config import HydraConfig

from dlkf.base.callable_module import make_callable
from dlkf.base.errors import InputError
from dlkf.base.files import resolve_place
from dlkf.command import command, list_typed_words
from dlkf.command.simulated import SEMI_REAL
from dlkf.data.tables import read_drives_table
from dlkf.simulation.dataset import SimulateSettings, simulate
from dlkf.simulation.semi_real import simulate_semi_real


def choose_dataset(arguments: list[str]) -> list[str]:
    """``source=`` alone means the dataset ``semi_real``, not simulated drives' default."""
    given = {argument.partition("=")[0].removeprefix("simulated@") for argument in arguments}
    return [*arguments, f"dataset={SEMI_REAL}"] if "source" in given and "dataset" not in given else arguments


@command("simulate", SimulateSettings, choose_dataset)
def main(settings: SimulateSettings) -> None:
    """Write the dataset to ``out`` (default ``data/<name>``) and print what it holds."""
    start = time.perf_counter()
    out = resolve_place(settings.out)
    chosen = HydraConfig.get().runtime.choices.get("simulated@dataset")
    if chosen == SEMI_REAL and not settings.source:
        raise InputError(f"dataset={SEMI_REAL} needs source=<dataset of real drives>")
    if settings.recipe.dataset.imu_errors == "fleet" and (typed := list_typed_words("imu")):
        raise InputError(
            f"{typed[0]} has no effect: the IMU of each drive is drawn from dataset.fleet; "
            "dataset.imu_errors=per_drive gives every drive a unit of imu="
        )
    if settings.source and settings.recipe.dataset.sensors:
        raise InputError("sensors= belongs to simulated drives; leave it out with source=")
    if settings.source:
        simulate_semi_real(settings.source, settings.recipe, out, overwrite=settings.overwrite)
    else:
        simulate(
            settings.recipe, out, overwrite=settings.overwrite, workers=settings.workers, parallel=settings.parallel
        )
    drives = read_drives_table(out)
    hours = drives["duration_s"].sum() / 3600
    made_by = settings.recipe
    errors = made_by.dataset.imu_errors
    types = {"fleet": f"of {len(made_by.dataset.fleet)} types", "wide": "of a new type each"}
    imu = types.get(errors, made_by.imu.name)
    print(
        f"{out}: {hours:.3g} h of {'semi-real ' if settings.source else ''}drives with IMU {imu} "
        f"({errors}), seed {settings.seed}, in {time.perf_counter() - start:.1f} s"
    )
    if "lateral_axle_mps" in drives:
        axle, at_imu = (math.sqrt(np.mean(drives[f"lateral_{at}_mps"].to_numpy() ** 2)) for at in ("axle", "imu"))
        print(f"velocity across the car, RMS above 2 m/s: {axle:.3f} m/s at the rear axle, {at_imu:.3f} m/s at the IMU")


make_callable(__name__, "dlkf.frames:simulate")

if __name__ == "__main__":
    main()
