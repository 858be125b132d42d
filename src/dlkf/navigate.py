"""Navigate whole drives: ``python -m dlkf.navigate dataset=data/town out=outputs/town``.

From IMU and GNSS alone; ``reference/`` is never opened. Writes ``out/drive=<id>/solution.parquet`` for every
drive, ``out/report.html`` and ``log.txt``, or nothing (columns: dlkf.running.solution).
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial

import torch

from dlkf.base.callable_module import make_callable
from dlkf.base.console import LOG, show_progress
from dlkf.base.errors import InputError
from dlkf.base.files import absolute_place, folder_name, require_empty, write_into
from dlkf.base.parallel import check_engine, parallel_map
from dlkf.base.provenance import describe_provenance
from dlkf.command import command, list_typed_words
from dlkf.command.settings import NavigateSettings
from dlkf.data.drive import Drive
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.data.tables import drive_clocks
from dlkf.filters.aids.attach import describe_aids
from dlkf.filters.card import domain_warnings
from dlkf.filters.smoother import run_smoother
from dlkf.navigation.imu_errors import AUTO
from dlkf.onboard.compiled_filter import compile_filter, compile_or_keep
from dlkf.onboard.core_drives import run_core_drive, runs_in_core
from dlkf.report.navigation import MOST_DRIVES, TrackOnMap, navigation_page, summary_lines
from dlkf.running import offline
from dlkf.running.exports import choose_formats, export, find_row_qualities, utc_times
from dlkf.running.grid import RunPlan
from dlkf.running.innovations import OF_NETWORK, REMEDY
from dlkf.running.noise_fit import check_finds_noise, generic_filter
from dlkf.running.replay import stream_drives
from dlkf.running.solution import write_solution
from dlkf.tracking.models import list_settings_taken, resolve_model, short_name, takes_tuning, unused_settings


@command("navigate", NavigateSettings)
def main(settings: NavigateSettings) -> None:
    """Load, align, run, write; print a line per drive."""
    formats = choose_formats(settings.export)
    require_empty(settings.out, overwrite=settings.overwrite)
    check_engine(settings.parallel, settings.dataset)
    if not isinstance(settings.model, str):
        raise InputError(f"navigate runs one model at a time, got model={settings.model}")
    spec, tuning = settings.spec, settings.tuning
    preset = spec.name
    if spec.name == AUTO:
        check_finds_noise(settings.model)
    model = resolve_model(settings.model, spec, settings.tracking.uri, **settings.filter_options)
    clocks = drive_clocks(settings.dataset)
    name = short_name(settings.model)
    given = {"aids": settings.aids, "drives": settings.drives, "rate_hz": settings.rate_hz, "epoch_s": settings.epoch_s}
    model, chosen, spacings, rates, grid = RunPlan.of(settings.dataset, model, name, **given)
    step = {key: grid[key] for key in ("rate_hz", "epoch_s")}
    for line in describe_aids({name: model}, chosen):
        print(line)
    for line in domain_warnings({name: model}, settings.dataset, rates, spec.name, grid["rate_hz"]):
        print(line)
    if spec.name != AUTO and (line := unused_settings(settings.model, list_typed_words("imu", "tuning"))):
        print(line)
    skipped: dict[str, str] | None = {} if settings.skip_unaligned else None
    if settings.streaming and (ahead := "smoother" if settings.smoother else "imu=auto" if spec.name == AUTO else ""):
        raise InputError(f"{ahead} looks ahead, a stream cannot: give {ahead} or streaming, not both")
    found_on: list[Drive] | None = None
    if spec.name == AUTO:
        drives = load_dataset(settings.dataset, dtype=torch.float64, reference=False, drives=settings.drives, **grid)
        with show_progress("Finding the noise") as progress:
            model, found_on, found = generic_filter(
                drives, settings.model, spec, tuning, settings.align, chosen,
                progress=progress, compiler=compile_or_keep,
            )  # fmt: skip
        print("found, SI units: " + ", ".join(f"{k} {v:.2g}" for k, v in found.describe().items()))
        print(found.describe_offset())
        if doubt := found.describe_doubt():
            print(doubt)
        spec, tuning = found.imu, found.tuning
    if settings.smoother is not None:
        model = run_smoother(model, settings.smoother)
    if settings.compiled:
        model = compile_filter(model, **step, whole=settings.streaming and runs_in_core(settings.align))
    if found_on is not None:
        navigated = partial(offline.navigate_drives, found_on, model, align=settings.align, skipped=skipped)
    else:
        run = stream_drives if settings.streaming else offline.navigate_dataset
        if settings.streaming and settings.compiled:
            run = partial(stream_drives, through=run_core_drive)
        run = partial(run, absolute_place(settings.dataset), model, align=settings.align, **grid)
        many = offline.CHUNK_SAMPLES if settings.parallel is None else offline.SAMPLES_AT_ONCE // 4
        shares = offline.chunk_drives(spacings, grid["rate_hz"], 1 if settings.streaming else many)
        done = parallel_map(partial(offline.load_chunk, run, skipped is not None), shares, settings.parallel)
        navigated = partial(offline.navigate_chunks, done, len(spacings), skipped=skipped)
    lines, courses = [], []
    taken = list_settings_taken(settings.model)
    shown = f"{name} (imu={preset})" if "imu" in taken else name
    if settings.smoother is not None and not name.endswith("_rts"):
        name, shown = f"{name}, smoothed", f"{shown}, smoothed"
    with write_into(settings.out) as folder, show_progress("Navigating") as progress:
        for result in navigated(progress=progress):
            write_solution(folder / f"drive={result.drive}" / "solution.parquet", result.table)
            when = utc_times(result.table, clocks.get(result.drive), settings.export_clock)
            fixes = spacings[result.drive]
            qualities = find_row_qualities(result.table, fixes.t, fixes.quality)
            export(folder / f"drive={result.drive}", result.table, formats, when, result.drive, qualities)
            lines.append(result.summary(fixes))
            course = TrackOnMap(result, fixes)
            courses.append(course if len(courses) < MOST_DRIVES else course.for_the_map())
        made = {
            **describe_provenance(), "model": settings.model, "dataset": settings.dataset, "drives": settings.drives,
            **step, "aids": [table.name for table in grid["aids"]], "digest": dataset_digest(settings.dataset),
            **{key: value for key, value in (("imu", asdict(spec)), ("tuning", tuning.factors())) if key in taken},
        }  # fmt: skip
        remedy = REMEDY if takes_tuning(settings.model) else OF_NETWORK
        doubt = offline.sigma_warning((course.result for course in courses), name, remedy)
        warnings = [doubt] if doubt else []
        page = navigation_page(name, folder_name(settings.dataset), courses, made, warnings)
        (folder / "report.html").write_text(page, encoding="utf-8")
        left_out = [f"left out: {reason}" for reason in (skipped or {}).values()]
        said = "\n".join((*sorted(lines), *left_out, *summary_lines(shown, courses), *warnings))
        (folder / LOG).write_text(f"{said}\n", encoding="utf-8")
    print(said)
    print(f"Solutions: {settings.out}/drive=*/solution.parquet; report: {settings.out}/report.html")


make_callable(__name__, "dlkf.frames:navigate")

if __name__ == "__main__":
    main()
