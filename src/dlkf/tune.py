"""Tune a Kalman filter: ``python -m dlkf.tune model=mbkf21 dataset=data/per_drive name=town out=mine``.

Writes ``out/tuning/<name>.yaml``, which evaluate and navigate take with ``--config-dir <out> tuning=<name>``, with the
recordings that it was fitted on, and logs the search to MLflow.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch

from dlkf.base.console import make_console, show_progress
from dlkf.base.errors import InputError
from dlkf.base.files import folder_name, is_url, require_store
from dlkf.command import command
from dlkf.command.scored import TuneSettings
from dlkf.data.store import choose_aids, dataset_digest, load_dataset
from dlkf.evaluation.outages import describe_rounding
from dlkf.evaluation.table import as_markdown, as_rich
from dlkf.filters.aids.attach import refuse_left_out
from dlkf.filters.build import FilterName, build_filter
from dlkf.filters.tuning import FittedOn
from dlkf.onboard.compiled_filter import compile_or_keep
from dlkf.running.noise_fit import Evidence, find_noise
from dlkf.tracking.runs import start_run, tracking_uri
from dlkf.tuning.study import (
    LIKELIHOOD,
    check_settings,
    noise_table,
    search,
    train_test_drives,
    tuning_table,
    write_noise,
    write_tuning,
)


@command("tune", TuneSettings)
def main(settings: TuneSettings) -> None:
    """Load, split, search, check, write, log, print."""
    chosen = choose_aids(settings.dataset, settings.aids, settings.drives)
    model = FilterName.parse(str(settings.model)).add(table.name for table in chosen)
    name, spec, start = settings.name, settings.spec, settings.tuning
    check_settings(model, settings.objective)
    if settings.aids is not None:
        refuse_left_out({model: build_filter(model, spec)}, chosen)
    if is_url(settings.out):
        raise InputError(f"out={settings.out}: --config-dir takes folders of this machine alone; give one")
    require_store(settings.out)
    protocol, uri = settings.protocol(), tracking_uri(settings.tracking.uri)
    if rounded := describe_rounding(protocol.outage, settings.epoch_s):
        print(rounded)
    with show_progress("Loading drives") as progress:
        drives = load_dataset(
            settings.dataset,
            rate_hz=settings.rate_hz,
            epoch_s=settings.epoch_s,
            dtype=torch.float64,
            drives=settings.drives,
            aids=chosen,
            reference=settings.objective != LIKELIHOOD,
            progress=progress,
        )
    dataset, out = drives[0].dataset, Path(settings.out)
    parts = {}
    if settings.objective != LIKELIHOOD:
        parts = train_test_drives(drives, settings.split, settings.fractions, settings.split_seed, protocol.length_s)
    with start_run(uri, "tune", f"{model} {dataset}") as run:
        run.log_config(asdict(settings))
        digest = dataset_digest(settings.dataset)
        run.log_dataset(settings.dataset, digest, "tuning")
        recordings = sorted({drive.group for drive in parts.get("train", drives)})
        fitted_on = FittedOn(folder_name(settings.dataset), digest, recordings)
        if settings.objective == LIKELIHOOD:
            evidence = Evidence.of(drives, settings.minutes)
            with show_progress(f"Noise for {model}") as bar:
                found = find_noise(evidence, model, spec, start, called=name, progress=bar, compiler=compile_or_keep)
            table = noise_table(model, dataset, spec, start, found)
            files = write_noise(out, found, table, fitted_on)
            run.log_metrics({f"found/{k}": v for k, v in found.describe().items()})
        else:
            result = search(
                model,
                spec,
                parts,
                protocol,
                start=start,
                objective=settings.objective,
                rounds=settings.rounds,
                segments=settings.segments,
                prior=settings.filter_options["prior"],
            )
            table = tuning_table(result, dataset)
            files = write_tuning(out, name, result, table, fitted_on)
            run.log_metrics(result.metrics())
            run.log_metrics({f"tuned/{k}": v for k, v in result.changed.items()})
        for file in files:
            run.log_files(out / file)
        run.note(as_markdown(table))
    make_console().print(as_rich(table))
    print(f"{out}/{files[0]}; for evaluate and navigate: --config-dir {out}; MLflow: run {run.id}")


if __name__ == "__main__":
    main()
