"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, figures/ and report.html in ``out``.
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dlkf.command import command
from dlkf.console import counting
from dlkf.data.kinds import drive_kinds
from dlkf.data.store import load_dataset
from dlkf.evaluation.protocol import Scenes, protocol_from
from dlkf.evaluation.report import all_tables, write_report
from dlkf.evaluation.study import study
from dlkf.evaluation.table import as_rich
from dlkf.models import resolve_models
from dlkf.navigation.imu_errors import imu_spec


@command("evaluate")
def main(cfg: DictConfig) -> None:
    """Load, run every model over the same scenes, score, write, print."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)
    console = Console(width=None if sys.stdout.isatty() else 110)
    protocol = protocol_from(config)
    options = {"tuning": config["tuning"], "prior": config["prior"]}
    models = resolve_models(config["model"], imu_spec(config["imu"]), config["tracking_uri"], **options)
    with counting("Loading drives") as progress:
        drives = load_dataset(
            config["dataset"],
            rate_hz=config["rate_hz"],
            epoch_s=config["epoch_s"],
            dtype=torch.float64,
            drives=config["drives"],
            progress=lambda name, done, total: progress(done, total),
        )
    scenes = Scenes(drives, protocol)
    for reason in scenes.skipped.values():
        console.print(f"left out: {reason}", style="yellow")
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
    name = drives[0].dataset
    write_report(
        config["out"],
        name,
        scores,
        made,
        protocol={
            "models": config["model"],
            "imu": config["imu"]["name"],
            "rate_hz": config["rate_hz"],
            **scenes.described(),
        },
        by_time=scenes.mode == "pieces",
        baseline=config["baseline"],
    )
    for table in all_tables(name, made):
        console.print(as_rich(table))
    if scenes.outage and not scores.outage.any():
        console.print("no outage fits into the valid truth of these drives; see outage.*", style="yellow")
    console.print(f"Report: {config['out']}/report.html")


if __name__ == "__main__":
    main()
