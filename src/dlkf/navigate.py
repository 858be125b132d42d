"""Navigate whole drives: ``python -m dlkf.navigate dataset=data/town out=outputs/town``.

From IMU and GNSS alone; ``reference/`` is never opened. Writes ``out/drive=<id>/solution.parquet`` for every
drive, ``out/report.html`` and ``log.txt``, or nothing (columns: dlkf.running.solution).
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import torch

from dlkf.command import command, typed
from dlkf.command.settings import NavigateSettings
from dlkf.console import LOG, counting
from dlkf.data.drive import Drive
from dlkf.data.store import dataset_digest, drive_rows, load_dataset
from dlkf.data.tables import drive_clocks
from dlkf.errors import InputError
from dlkf.files import absolute, name_of, staged, vacant
from dlkf.filters.card import strangers
from dlkf.filters.saved import grid_of
from dlkf.filters.smoother import smoothed
from dlkf.models import is_told_noise, resolve_model, short_name
from dlkf.navigation.imu_errors import AUTO
from dlkf.onboard.compiled_filter import compiled_filter
from dlkf.parallel import check, each
from dlkf.provenance import provenance
from dlkf.report.navigation import MOST_DRIVES, Course, answers, write_page
from dlkf.running import offline
from dlkf.running.exports import chosen, export, utc_times
from dlkf.running.likelihood import untold
from dlkf.running.replay import stream_drives
from dlkf.running.solution import write_solution


@command("navigate", NavigateSettings)
def main(told: NavigateSettings) -> None:
    """Load, align, run, write; print a line per drive."""
    formats = chosen(told.export)
    vacant(told.out, overwrite=told.overwrite)
    check(told.parallel, told.dataset)
    if not isinstance(told.model, str):
        raise InputError(f"navigate runs one model at a time, got model={told.model}")
    spec, tuning = told.spec, told.tuning
    model = resolve_model(told.model, spec, told.tracking.uri, **told.told)
    clocks = drive_clocks(told.dataset)
    rows, name = drive_rows(told.dataset, told.drives), short_name(told.model)
    spacings = {row.name: offline.Fixes.of(told.dataset, row.name) for row in rows}
    usual = offline.epoch_for(spacings.values(), told.rate_hz or 50.0, model)
    grid = grid_of([model], told.rate_hz, told.epoch_s, usual)
    for line in strangers({name: model}, told.dataset, spacings, spec.name, grid["rate_hz"]):
        print(line)
    if spec.name != AUTO and not is_told_noise(told.model) and (unused := typed("imu", "tuning")):
        print(f"{name} is told no noise: {' '.join(unused)} changes nothing; a Kalman filter would take it")
    skipped: dict[str, str] | None = {} if told.skip_unaligned else None
    if told.streaming and (ahead := "smoother" if told.smoother else "imu=auto" if spec.name == AUTO else ""):
        raise InputError(f"{ahead} looks ahead, a stream cannot: give {ahead} or streaming, not both")
    found_on: list[Drive] | None = None
    if spec.name == AUTO:
        drives = load_dataset(told.dataset, dtype=torch.float64, reference=False, drives=told.drives, **grid)
        with counting("Finding the noise") as progress:
            model, found_on, found = untold(drives, told.model, spec, tuning, told.align, progress=progress)
        print("found: " + ", ".join(f"{k} {v:.2g}" for k, v in found.described().items()))
        print(found.told_of_fixes())
        spec, tuning = found.imu, found.tuning
    if told.smoother is not None:
        model = smoothed(model, told.smoother)
    if told.compiled:
        model = compiled_filter(model, **grid)
    if found_on is not None:
        navigated = partial(offline.navigate_drives, found_on, model, align=told.align, skipped=skipped)
    else:
        run = stream_drives if told.streaming else offline.navigate_dataset
        run = partial(run, absolute(told.dataset), model, align=told.align, **grid)
        many = offline.SAMPLES_AT_ONCE if told.parallel is None else offline.SAMPLES_AT_ONCE // 4
        shares = offline.in_shares(spacings, grid["rate_hz"], 1 if told.streaming else many)
        done = each(partial(offline.share_of, run, skipped is not None), shares, told.parallel)
        navigated = partial(offline.navigate_shares, done, len(rows), skipped=skipped)
    lines, courses = [], []
    with staged(told.out) as folder, counting("Navigating") as progress:
        for result in navigated(progress=progress):
            write_solution(folder / f"drive={result.drive}" / "solution.parquet", result.table)
            when = utc_times(result.table, clocks.get(result.drive), told.export_clock)
            export(folder / f"drive={result.drive}", result.table, formats, when, result.drive)
            lines.append(result.summary(spacings[result.drive]))
            course = Course(result, spacings[result.drive])
            courses.append(course if len(courses) < MOST_DRIVES else course.for_the_map())
        made = {**provenance(), "model": told.model, "dataset": told.dataset, "drives": told.drives, **grid}
        made |= {"digest": dataset_digest(told.dataset), "imu": asdict(spec), "tuning": asdict(tuning)}
        write_page(folder, name, name_of(told.dataset), courses, made)
        left_out = [f"left out: {reason}" for reason in (skipped or {}).values()]
        said = "\n".join((*sorted(lines), *left_out, *answers(name, courses)))
        (folder / LOG).write_text(f"{said}\n")
    print(said)
    print(f"Solutions: {told.out}/drive=*/solution.parquet; report: {told.out}/report.html")


if __name__ == "__main__":
    main()
