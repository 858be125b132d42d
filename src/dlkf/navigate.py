"""Navigate whole drives: ``python -m dlkf.navigate model=mbkf15 dataset=data/town out=outputs/town``.

From IMU and GNSS alone; ``reference/`` is never opened. Writes ``out/drive=<id>/solution.parquet`` for every
drive and ``out/report.html``, or nothing (columns: dlkf.running.solution).
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.alignment import AlignConfig
from dlkf.data.store import dataset_digest, drive_rows
from dlkf.data.tables import time_zeros
from dlkf.errors import InputError
from dlkf.files import staged, vacant
from dlkf.filters.smoother import smoothed
from dlkf.filters.tuning import Tuning
from dlkf.models import grid_of, resolve_model, short_name
from dlkf.navigation.imu_errors import AUTO, imu_spec
from dlkf.onboard.compiled_filter import compiled_filter
from dlkf.provenance import provenance
from dlkf.report.navigation import Course, answers, write_page
from dlkf.running.exports import chosen, export, utc_times
from dlkf.running.likelihood import untold
from dlkf.running.offline import Fixes, epoch_for, in_shares, navigate_shares
from dlkf.running.replay import stream_drives
from dlkf.running.solution import write_solution
from dlkf.settings import settings_from


@command("navigate")
def main(cfg: DictConfig) -> None:
    """Load, align, run, write; print a line per drive."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    formats = chosen(config["export"])
    vacant(config["out"], overwrite=config["overwrite"])
    if not isinstance(config["model"], str):
        raise InputError(f"navigate runs one model at a time, got model={config['model']}")
    spec, tuning = imu_spec(config["imu"], auto=True), config["tuning"]
    model = resolve_model(config["model"], spec, config["tracking"]["uri"], tuning=tuning, prior=config["prior"])
    zeros = time_zeros(config["dataset"])
    rows = drive_rows(config["dataset"], config["drives"])
    spacings = {row.name: Fixes.of(config["dataset"], row.name) for row in rows}
    usual = epoch_for(spacings.values(), config["rate_hz"] or 50.0, model)
    grid = {"drives": config["drives"], **grid_of([model], config["rate_hz"], config["epoch_s"], usual)}
    skipped: dict[str, str] | None = {} if config["skip_unaligned"] else None
    align = AlignConfig.of(config["align"])
    if config["streaming"]:
        if ahead := "smoother" if config["smoother"] is not None else "imu=auto" if spec.name == AUTO else "":
            raise InputError(f"{ahead} looks ahead, a stream cannot: give {ahead} or streaming, not both")
        if config["compiled"]:
            model = compiled_filter(model, grid["rate_hz"], grid["epoch_s"])
        navigated = partial(stream_drives, config["dataset"], model, align=align, skipped=skipped, **grid)
    else:
        shares = in_shares(config["dataset"], spacings, rate_hz=grid["rate_hz"], epoch_s=grid["epoch_s"])
        if spec.name == AUTO:
            drives = [drive for share in shares for drive in share]
            with counting("Finding the noise") as progress:
                told = settings_from(Tuning, tuning, "tuning")
                model, drives, found = untold(drives, config["model"], spec, told, align, progress=progress)
            print("found: " + ", ".join(f"{k} {v:.2g}" for k, v in found.described().items()))
            spec, tuning, shares = found.imu, asdict(found.tuning), [drives]
        if config["smoother"] is not None:
            model = smoothed(model, config["smoother"])
        if config["compiled"]:
            model = compiled_filter(model, grid["rate_hz"], grid["epoch_s"])
        navigated = partial(navigate_shares, shares, model, len(rows), align=align, skipped=skipped)
    lines, courses = [], []
    with staged(config["out"]) as folder, counting("Navigating") as progress:
        for result in navigated(progress=progress):
            write_solution(folder / f"drive={result.drive}" / "solution.parquet", result.table)
            when = utc_times(result.table, zeros.get(result.drive), config["export_clock"])
            export(folder / f"drive={result.drive}", result.table, formats, when, result.drive)
            lines.append(result.summary(spacings[result.drive]))
            courses.append(Course(result, spacings[result.drive]))
        made = {**provenance(), **{k: config[k] for k in ("model", "dataset")}, **grid}
        made |= {"digest": dataset_digest(config["dataset"]), "imu": asdict(spec), "tuning": dict(tuning)}
        write_page(folder, short_name(config["model"]), Path(config["dataset"]).resolve().name, courses, made)
    print("\n".join(sorted(lines)))
    for reason in (skipped or {}).values():
        print(f"left out: {reason}")
    print("\n".join(answers(short_name(config["model"]), courses)))
    print(f"Solutions: {config['out']}/drive=*/solution.parquet; report: {config['out']}/report.html")


if __name__ == "__main__":
    main()
