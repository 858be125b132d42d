"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, figures/ and report.html in ``out``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from rich.console import Console

from dlkf.command import command
from dlkf.data.alignment import AlignConfig
from dlkf.data.kinds import drive_kinds
from dlkf.data.store import dataset_digest, drive_rows
from dlkf.evaluation.protocol import protocol_from
from dlkf.evaluation.shares import Work, evaluate_shares
from dlkf.evaluation.study import bias_law, results_of
from dlkf.evaluation.summary import answer, metrics_of
from dlkf.evaluation.table import all_tables, as_rich
from dlkf.files import absolute, name_of, vacant
from dlkf.filters.build import build_filter
from dlkf.filters.card import without_seen
from dlkf.filters.saved import grid_of
from dlkf.models import check_baseline, resolve_models
from dlkf.navigation.imu_errors import imu_spec
from dlkf.parallel import check
from dlkf.provenance import provenance
from dlkf.report.evaluation import write_report
from dlkf.running.offline import SAMPLES_AT_ONCE, Fixes, in_shares
from dlkf.running.references import check_reference
from dlkf.tracking.evaluations import log_evaluation
from dlkf.tracking.runs import tracking_uri


@command("evaluate")
def main(config: dict[str, Any]) -> None:
    """Load, run every model over the same scenes, score, write, print."""
    console = Console(width=None if sys.stdout.isatty() else 110)
    vacant(config["out"], overwrite=config["overwrite"])
    protocol, uri = protocol_from(config), tracking_uri(config["tracking"]["uri"])
    options = {"tuning": config["tuning"], "prior": config["prior"]}
    spec = imu_spec(config["imu"])
    models = resolve_models(config["model"], spec, uri, **options)
    check_baseline(config["baseline"], models)
    check_reference(config["reference"])
    grid = grid_of(models.values(), config["rate_hz"], config["epoch_s"])
    check(config["parallel"], config["dataset"])
    rows, name = drive_rows(config["dataset"], config["drives"]), name_of(config["dataset"])
    digest, kinds = dataset_digest(config["dataset"]), drive_kinds(config["dataset"])
    cards = {model_name: getattr(model, "card", {}) for model_name, model in models.items()}
    rows, seen = without_seen(cards, rows, name, digest, leave_out=config["unseen"])
    for line in seen:
        console.print(line, style="yellow")
    work = Work(
        absolute(config["dataset"]), models, protocol, grid, kinds, {row.name: row.group for row in rows},
        reference=config["reference"], smoother=build_filter("mbkf21", spec, tuning=config["tuning"]),
        align=AlignConfig.of(config["align"]), law=bias_law(config["injected_bias"]), seed=config["seed"],
        shown=config["parallel"] is None,
    )  # fmt: skip
    fixes = {row.name: Fixes.of(config["dataset"], row.name) for row in rows}
    many = SAMPLES_AT_ONCE if config["parallel"] is None else SAMPLES_AT_ONCE // 4
    done = evaluate_shares(work, in_shares(fixes, grid["rate_hz"], many), config["parallel"])
    for reason in done.skipped.values():
        console.print(f"left out: {reason}", style="yellow")
    if done.truth:
        console.print(f"No truth: errors are against the {done.truth['reference']}.", style="bold")
    scores = done.run.scores
    made = results_of(done.run, **{key: config[key] for key in ("baseline", "settle_s", "seed")})
    made_how = {**provenance(), **settings_of(config), "digest": digest, **done.truth, **grid, **done.rules}
    by_time, baseline = done.mode == "pieces", config["baseline"]
    write_report(config["out"], name, scores, made, protocol=made_how, by_time=by_time, baseline=baseline)
    tables, title = all_tables(name, made), f"{' '.join(models)} on {name}"
    run = config["tracking"]["log"] and log_evaluation(config, uri, title, digest, metrics_of(made), tables)
    for table in tables:
        console.print(as_rich(table))
    if done.rules["outage"] and not scores.outage.any():
        console.print("no outage fits into the valid truth of these drives; see outage.*", style="yellow")
    for result in made:
        console.print(f"\n[bold]{answer(result)}[/bold]", highlight=False)
    console.print(f"Report: {config['out']}/report.html{f'; MLflow: run {run}' if run else ''}", soft_wrap=True)


def settings_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the numbers, for the report."""
    imu = {k: config["imu"][k] for k in ("accel", "gyro")}
    told = {"models": config["model"], "dataset": config["dataset"], "imu": config["imu"]["name"]}
    return told | {"imu values": imu, "tuning": config["tuning"]}


if __name__ == "__main__":
    main()
