"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, figures/ and report.html in ``out``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.alignment import AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.kinds import drive_kinds
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.errors import InputError
from dlkf.evaluation.protocol import Scenes, protocol_from
from dlkf.evaluation.study import study
from dlkf.evaluation.summary import answer, metrics_of
from dlkf.evaluation.table import all_tables, as_rich
from dlkf.files import vacant
from dlkf.filters.build import build_filter
from dlkf.filters.card import without_seen
from dlkf.models import check_baseline, grid_of, resolve_models
from dlkf.navigation.imu_errors import imu_spec
from dlkf.provenance import provenance
from dlkf.report.evaluation import write_report
from dlkf.running.references import KINDS, referenced
from dlkf.tracking.evaluations import log_evaluation
from dlkf.tracking.runs import tracking_uri

SMOOTHER = "mbkf21"  # makes a reference where there is none


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Load, run every model over the same scenes, score, write, print."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    console = Console(width=None if sys.stdout.isatty() else 110)
    vacant(config["out"], overwrite=config["overwrite"])
    protocol, uri = protocol_from(config), tracking_uri(config["tracking"]["uri"])
    options = {"tuning": config["tuning"], "prior": config["prior"]}
    models = resolve_models(config["model"], imu_spec(config["imu"]), uri, **options)
    check_baseline(config["baseline"], models)
    if config["reference"] not in KINDS:
        raise InputError(f"reference={config['reference']} is none of {', '.join(KINDS)}")
    grid = grid_of(models.values(), config["rate_hz"], config["epoch_s"])
    with counting("Loading drives") as progress:
        drives = load_dataset(
            config["dataset"],
            dtype=torch.float64,
            drives=config["drives"],
            reference=config["reference"] == "file",
            progress=lambda name, done, total: progress(done, total),
            **grid,
        )
    cards = {name: getattr(model, "card", {}) for name, model in models.items()}
    drives, seen = without_seen(cards, drives, dataset_digest(config["dataset"]), leave_out=config["unseen"])
    for line in seen:
        console.print(line, style="yellow")
    drives, truth = with_truth(drives, config, console.print)
    scenes = Scenes(drives, protocol)
    for reason in scenes.skipped.values():
        console.print(f"left out: {reason}", style="yellow")
    name = drives[0].dataset
    digest = dataset_digest(config["dataset"])
    scores, made = study(
        models,
        scenes,
        kinds=drive_kinds(config["dataset"]),
        groups={d.name: d.group for d in drives},
        baseline=config["baseline"],
        settle_s=config["settle_s"],
        injected_bias=config["injected_bias"],
        seed=config["seed"],
    )
    made_how = {**provenance(), **settings_of(config), "digest": digest, **truth, **grid, **scenes.described()}
    by_time, baseline = scenes.mode == "pieces", config["baseline"]
    write_report(config["out"], name, scores, made, protocol=made_how, by_time=by_time, baseline=baseline)
    tables, run = all_tables(name, made), None
    if config["tracking"]["log"]:
        run = log_evaluation(config, uri, f"{' '.join(models)} on {name}", digest, metrics_of(made), tables)
    for table in tables:
        console.print(as_rich(table))
    if scenes.outage and not scores.outage.any():
        console.print("no outage fits into the valid truth of these drives; see outage.*", style="yellow")
    for result in made:
        console.print(f"\n[bold]{answer(result)}[/bold]", highlight=False)
    where = f"; MLflow: run {run}" if run else ""
    console.print(f"Report: {config['out']}/report.html{where}", soft_wrap=True)


def with_truth(drives: list[Drive], config: Mapping[str, Any], say: Callable) -> tuple[list[Drive], dict[str, str]]:
    """The drives with the reference that is asked for, and what is to be said of it."""
    if config["reference"] == "file":
        return drives, {}
    smoother = build_filter(SMOOTHER, imu_spec(config["imu"]), tuning=config["tuning"])
    with counting("Making the reference") as progress:
        made = referenced(drives, config["reference"], smoother, AlignConfig.of(config["align"]), progress)
    for reason in made.skipped.values():
        say(f"left out: {reason}", style="yellow")
    sigma = f"1σ {made.horizontal_m:.2g} m horizontal, {made.vertical_m:.2g} m vertical (median, as it says itself)"
    what = "smoothed solution with all fixes" if config["reference"] == "smoothed" else "good fixes"
    say(f"No truth: errors are against the {what}, {sigma}.", style="bold")
    return made.drives, {"reference": f"{what}, {sigma}"}


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the numbers, for the report."""
    imu = {k: v for k, v in config["imu"].items() if k in ("accel", "gyro")}
    told = {"models": config["model"], "dataset": config["dataset"], "imu": config["imu"]["name"], "imu values": imu}
    return told | {"tuning": config["tuning"]}


if __name__ == "__main__":
    main()
