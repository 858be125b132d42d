"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, figures/ and report.html in ``out``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import torch
from rich.console import Console

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.alignment import AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.kinds import drive_kinds
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.evaluation.protocol import Scenes, protocol_from
from dlkf.evaluation.study import study
from dlkf.evaluation.summary import answer, metrics_of
from dlkf.evaluation.table import all_tables, as_rich
from dlkf.files import vacant
from dlkf.filters.build import build_filter
from dlkf.filters.card import without_seen
from dlkf.filters.model_based import Mbkf
from dlkf.filters.saved import grid_of
from dlkf.models import check_baseline, resolve_models
from dlkf.navigation.imu_errors import imu_spec
from dlkf.provenance import provenance
from dlkf.report.evaluation import write_report
from dlkf.running.references import check_reference, referenced
from dlkf.tracking.evaluations import log_evaluation
from dlkf.tracking.runs import tracking_uri


@command("evaluate")
def main(config: dict[str, Any]) -> None:
    """Load, run every model over the same scenes, score, write, print."""
    console = Console(width=None if sys.stdout.isatty() else 110)
    vacant(config["out"], overwrite=config["overwrite"])
    protocol, uri = protocol_from(config), tracking_uri(config["tracking"]["uri"])
    options = {"tuning": config["tuning"], "prior": config["prior"]}
    models = resolve_models(config["model"], imu_spec(config["imu"]), uri, **options)
    check_baseline(config["baseline"], models)
    check_reference(config["reference"])
    grid = grid_of(models.values(), config["rate_hz"], config["epoch_s"])
    with counting("Loading drives") as progress:
        options = {"drives": config["drives"], "reference": config["reference"] == "file", **grid}
        drives = load_dataset(config["dataset"], dtype=torch.float64, progress=progress, **options)
    digest, name = dataset_digest(config["dataset"]), drives[0].dataset
    cards = {model_name: getattr(model, "card", {}) for model_name, model in models.items()}
    drives, seen = without_seen(cards, drives, digest, leave_out=config["unseen"])
    for line in seen:
        console.print(line, style="yellow")
    drives, truth = with_truth(drives, config, console.print)
    scenes = Scenes(drives, protocol)
    for reason in scenes.skipped.values():
        console.print(f"left out: {reason}", style="yellow")
    told = {key: config[key] for key in ("baseline", "settle_s", "injected_bias", "seed")}
    kinds, groups = drive_kinds(config["dataset"]), {d.name: d.group for d in drives}
    scores, made = study(models, scenes, kinds=kinds, groups=groups, **told)
    made_how = {**provenance(), **settings_of(config), "digest": digest, **truth, **grid, **scenes.described()}
    by_time, baseline = scenes.mode == "pieces", config["baseline"]
    write_report(config["out"], name, scores, made, protocol=made_how, by_time=by_time, baseline=baseline)
    tables, title = all_tables(name, made), f"{' '.join(models)} on {name}"
    run = config["tracking"]["log"] and log_evaluation(config, uri, title, digest, metrics_of(made), tables)
    for table in tables:
        console.print(as_rich(table))
    if scenes.outage and not scores.outage.any():
        console.print("no outage fits into the valid truth of these drives; see outage.*", style="yellow")
    for result in made:
        console.print(f"\n[bold]{answer(result)}[/bold]", highlight=False)
    console.print(f"Report: {config['out']}/report.html{f'; MLflow: run {run}' if run else ''}", soft_wrap=True)


def with_truth(drives: list[Drive], config: Mapping[str, Any], say: Callable) -> tuple[list[Drive], dict[str, str]]:
    """The drives with the reference that is asked for, and what is to be said of it."""
    if config["reference"] == "file":
        return drives, {}
    smoother = build_filter("mbkf21", imu_spec(config["imu"]), tuning=config["tuning"])
    assert isinstance(smoother, Mbkf)
    with counting("Making the reference") as progress:
        made = referenced(drives, config["reference"], smoother, AlignConfig.of(config["align"]), progress)
    for reason in made.skipped.values():
        say(f"left out: {reason}", style="yellow")
    say(f"No truth: errors are against the {made.described()}.", style="bold")
    return made.drives, {"reference": made.described()}


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the numbers, for the report."""
    imu = {k: config["imu"][k] for k in ("accel", "gyro")}
    told = {"models": config["model"], "dataset": config["dataset"], "imu": config["imu"]["name"]}
    return told | {"imu values": imu, "tuning": config["tuning"]}


if __name__ == "__main__":
    main()
