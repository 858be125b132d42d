"""Tune a Kalman filter: ``python -m dlkf.tune model=mbkf21 dataset=data/per_drive name=town out=mine``.

Writes ``out/tuning/<name>.yaml``, which evaluate and navigate take with ``--config-dir <out> tuning=<name>``, and
logs the search to MLflow.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.errors import InputError
from dlkf.evaluation.protocol import protocol_from
from dlkf.evaluation.table import as_markdown, as_rich
from dlkf.filters.build import build_filter
from dlkf.filters.model_based import Mbkf
from dlkf.navigation.imu_errors import imu_spec
from dlkf.tracking.runs import start_run, tracking_uri
from dlkf.tuning.found import found_noise, noise_table, write_noise
from dlkf.tuning.study import LIKELIHOOD, check, search, sides, tuning_table, write_tuning


@command("tune")
def main(config: dict[str, Any]) -> None:
    """Load, split, search, check, write, log, print."""
    model, name, spec = str(config["model"]), str(config["name"]), imu_spec(config["imu"])
    check(model, config["objective"])
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise InputError(f"name={name} must be letters, digits, _ and -: it names a file")
    untuned = build_filter(model, spec, tuning=config["tuning"])
    assert isinstance(untuned, Mbkf)  # as ``check`` has seen
    start = untuned.tuning
    protocol, uri = protocol_from(config), tracking_uri(config["tracking"]["uri"])
    with counting("Loading drives") as progress:
        drives = load_dataset(
            config["dataset"],
            rate_hz=config["rate_hz"],
            epoch_s=config["epoch_s"],
            dtype=torch.float64,
            drives=config["drives"],
            reference=config["objective"] != LIKELIHOOD,
            progress=progress,
        )
    dataset, out = drives[0].dataset, Path(config["out"])
    with start_run(uri, "tune", f"{model} {dataset}") as run:
        run.log_config(config)
        run.log_dataset(config["dataset"], dataset_digest(config["dataset"]), "tuning")
        if config["objective"] == LIKELIHOOD:
            found = found_noise(drives, model, spec, start, minutes=config["minutes"], name=name)
            table = noise_table(model, dataset, spec, start, found)
            files = write_noise(out, found, table)
            run.log_metrics({f"found/{k}": v for k, v in found.described().items()})
        else:
            options = {key: config[key] for key in ("objective", "rounds", "pieces")}
            split = (config[key] for key in ("split", "fractions", "split_seed"))
            parts = sides(drives, *split, length_s=protocol.length_s)
            result = search(model, spec, parts, protocol, start=start, **options)
            table = tuning_table(result, dataset)
            files = write_tuning(out, name, result, table)
            run.log_metrics(result.metrics())
            run.log_metrics({f"tuned/{k}": v for k, v in result.changed.items()})
        for file in files:
            run.log_files(out / file)
        run.note(as_markdown(table))
    Console(width=None if sys.stdout.isatty() else 110).print(as_rich(table))
    print(f"{out}/{files[0]}; for evaluate and navigate: --config-dir {out}; MLflow: run {run.id}")


if __name__ == "__main__":
    main()
