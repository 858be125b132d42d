"""Tune a Kalman filter: ``python -m dlkf.tune model=mbkf21 dataset=data/per_drive name=town out=mine``.

Writes ``out/tuning/<name>.yaml``, which evaluate and navigate take with ``--config-dir <out> tuning=<name>``, and
logs the search to MLflow.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path

import torch
from rich.console import Console

from dlkf.command import command
from dlkf.command.scored import TuneSettings
from dlkf.console import counting
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.errors import InputError
from dlkf.evaluation.table import as_markdown, as_rich
from dlkf.files import is_url, reached
from dlkf.tracking.runs import start_run, tracking_uri
from dlkf.tuning.found import found_noise, noise_table, write_noise
from dlkf.tuning.study import LIKELIHOOD, check, search, sides, tuning_table, write_tuning


@command("tune", TuneSettings)
def main(told: TuneSettings) -> None:
    """Load, split, search, check, write, log, print."""
    model, name, spec, start = str(told.model), told.name, told.spec, told.tuning
    check(model, told.objective)
    if is_url(told.out):
        raise InputError(f"out={told.out}: --config-dir takes folders of this machine alone; give one")
    reached(told.out)
    protocol, uri = told.protocol(), tracking_uri(told.tracking.uri)
    with counting("Loading drives") as progress:
        drives = load_dataset(
            told.dataset,
            rate_hz=told.rate_hz,
            epoch_s=told.epoch_s,
            dtype=torch.float64,
            drives=told.drives,
            reference=told.objective != LIKELIHOOD,
            progress=progress,
        )
    dataset, out = drives[0].dataset, Path(told.out)
    parts = {}
    if told.objective != LIKELIHOOD:
        parts = sides(drives, told.split, told.fractions, told.split_seed, protocol.length_s)
    with start_run(uri, "tune", f"{model} {dataset}") as run:
        run.log_config(asdict(told))
        run.log_dataset(told.dataset, dataset_digest(told.dataset), "tuning")
        if told.objective == LIKELIHOOD:
            found = found_noise(drives, model, spec, start, minutes=told.minutes, name=name)
            table = noise_table(model, dataset, spec, start, found)
            files = write_noise(out, found, table)
            run.log_metrics({f"found/{k}": v for k, v in found.described().items()})
        else:
            options = {"objective": told.objective, "rounds": told.rounds, "pieces": told.pieces}
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
