"""Navigate whole drives: ``python -m dlkf.navigate model=mbkf15 dataset=data/town out=outputs/town``.

From IMU and GNSS alone; ``reference/`` is never opened. Writes ``out/drive=<id>/solution.parquet`` for every
drive and ``out/report.html``, or nothing (columns: dlkf.running.solution).
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import Any

import torch

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.alignment import AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.store import dataset_digest, drive_rows, load_dataset
from dlkf.data.tables import time_zeros
from dlkf.errors import InputError
from dlkf.files import absolute, name_of, staged, vacant
from dlkf.filters.saved import grid_of
from dlkf.filters.smoother import smoothed
from dlkf.filters.tuning import Tuning
from dlkf.models import resolve_model, short_name
from dlkf.navigation.imu_errors import AUTO, imu_spec
from dlkf.onboard.compiled_filter import compiled_filter
from dlkf.parallel import check, each
from dlkf.provenance import provenance
from dlkf.report.navigation import Course, answers, write_page
from dlkf.running import offline
from dlkf.running.exports import chosen, export, utc_times
from dlkf.running.likelihood import untold
from dlkf.running.replay import stream_drives
from dlkf.running.solution import write_solution
from dlkf.settings import settings_from


@command("navigate")
def main(config: dict[str, Any]) -> None:
    """Load, align, run, write; print a line per drive."""
    formats = chosen(config["export"])
    vacant(config["out"], overwrite=config["overwrite"])
    check(config["parallel"], config["dataset"])
    if not isinstance(config["model"], str):
        raise InputError(f"navigate runs one model at a time, got model={config['model']}")
    spec, tuning = imu_spec(config["imu"], auto=True), config["tuning"]
    model = resolve_model(config["model"], spec, config["tracking"]["uri"], tuning=tuning, prior=config["prior"])
    zeros = time_zeros(config["dataset"])
    rows = drive_rows(config["dataset"], config["drives"])
    spacings = {row.name: offline.Fixes.of(config["dataset"], row.name) for row in rows}
    usual = offline.epoch_for(spacings.values(), config["rate_hz"] or 50.0, model)
    grid = grid_of([model], config["rate_hz"], config["epoch_s"], usual)
    skipped: dict[str, str] | None = {} if config["skip_unaligned"] else None
    align = AlignConfig.of(config["align"])
    if config["streaming"] and (ahead := "smoother" if config["smoother"] else "imu=auto" if spec.name == AUTO else ""):
        raise InputError(f"{ahead} looks ahead, a stream cannot: give {ahead} or streaming, not both")
    found_on: list[Drive] | None = None
    if spec.name == AUTO:
        drives = load_dataset(config["dataset"], dtype=torch.float64, reference=False, drives=config["drives"], **grid)
        with counting("Finding the noise") as progress:
            told = settings_from(Tuning, tuning, "tuning")
            model, found_on, found = untold(drives, config["model"], spec, told, align, progress=progress)
        print("found: " + ", ".join(f"{k} {v:.2g}" for k, v in found.described().items()))
        spec, tuning = found.imu, asdict(found.tuning)
    if config["smoother"] is not None:
        model = smoothed(model, config["smoother"])
    if config["compiled"]:
        model = compiled_filter(model, **grid)
    if found_on is not None:
        navigated = partial(offline.navigate_drives, found_on, model, align=align, skipped=skipped)
    else:
        run = stream_drives if config["streaming"] else offline.navigate_dataset
        run = partial(run, absolute(config["dataset"]), model, align=align, **grid)
        many = offline.SAMPLES_AT_ONCE if config["parallel"] is None else offline.SAMPLES_AT_ONCE // 4
        shares = offline.in_shares(spacings, grid["rate_hz"], 1 if config["streaming"] else many)
        done = each(partial(offline.share_of, run, skipped is not None), shares, config["parallel"])
        navigated = partial(offline.navigate_shares, done, len(rows), skipped=skipped)
    lines, courses = [], []
    with staged(config["out"]) as folder, counting("Navigating") as progress:
        for result in navigated(progress=progress):
            write_solution(folder / f"drive={result.drive}" / "solution.parquet", result.table)
            when = utc_times(result.table, zeros.get(result.drive), config["export_clock"])
            export(folder / f"drive={result.drive}", result.table, formats, when, result.drive)
            lines.append(result.summary(spacings[result.drive]))
            courses.append(Course(result, spacings[result.drive]))
        made = {**provenance(), **{k: config[k] for k in ("model", "dataset", "drives")}, **grid}
        made |= {"digest": dataset_digest(config["dataset"]), "imu": asdict(spec), "tuning": dict(tuning)}
        write_page(folder, short_name(config["model"]), name_of(config["dataset"]), courses, made)
    print("\n".join(sorted(lines)))
    for reason in (skipped or {}).values():
        print(f"left out: {reason}")
    print("\n".join(answers(short_name(config["model"]), courses)))
    print(f"Solutions: {config['out']}/drive=*/solution.parquet; report: {config['out']}/report.html")


if __name__ == "__main__":
    main()
