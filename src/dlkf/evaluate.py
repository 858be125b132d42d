"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, figures/, report.html and log.txt in ``out``.
"""

from __future__ import annotations

from dataclasses import asdict

from dlkf.command import command
from dlkf.command.scored import EvaluateSettings
from dlkf.console import keep_said, talking
from dlkf.data.kinds import drive_kinds
from dlkf.data.store import dataset_digest, drive_rows
from dlkf.evaluation.outages import check_outages
from dlkf.evaluation.shares import Work, evaluate_shares
from dlkf.evaluation.study import results_of
from dlkf.evaluation.summary import FEW, answer, metrics_of
from dlkf.evaluation.table import all_tables, as_markdown, as_rich
from dlkf.files import absolute, name_of, vacant
from dlkf.filters.build import build_filter
from dlkf.filters.card import strangers, without_seen
from dlkf.filters.saved import grid_of
from dlkf.models import check_baseline, resolve_models
from dlkf.parallel import check
from dlkf.provenance import provenance
from dlkf.report.evaluation import write_report
from dlkf.running.offline import SAMPLES_AT_ONCE, Fixes, in_shares
from dlkf.running.references import check_reference
from dlkf.tracking.grid import start_point
from dlkf.tracking.runs import check_store, tracking_uri


@command("evaluate", EvaluateSettings)
def main(told: EvaluateSettings) -> None:
    """Load, run every model over the same scenes, score, write, print."""
    console = talking()
    vacant(told.out, overwrite=told.overwrite)
    protocol, uri, spec = told.protocol(told.align), tracking_uri(told.tracking.uri), told.spec
    if told.tracking.log:
        check_store(uri)
    models = resolve_models(told.models, spec, uri, **told.told)
    check_baseline(told.baseline, models)
    check_reference(told.reference)
    grid = grid_of(models.values(), told.rate_hz, told.epoch_s)
    check(told.parallel, told.dataset)
    rows, name = drive_rows(told.dataset, told.drives), name_of(told.dataset)
    digest, kinds = dataset_digest(told.dataset), drive_kinds(told.dataset)
    cards = {model_name: getattr(model, "card", {}) for model_name, model in models.items()}
    rows, seen = without_seen(cards, rows, name, digest, leave_out=told.unseen)
    strange = strangers(models, told.dataset, [row.name for row in rows], spec.name, grid["rate_hz"])
    for line in (*seen, *strange):
        console.print(line, style="yellow")
    work = Work(
        absolute(told.dataset), models, protocol, grid, kinds, {row.name: row.group for row in rows},
        reference=told.reference, smoother=build_filter("mbkf21", spec, tuning=told.tuning),
        align=told.align, law=told.injected_bias, seed=told.seed, shown=told.parallel is None,
    )  # fmt: skip
    fixes = {row.name: Fixes.of(told.dataset, row.name) for row in rows}
    many = SAMPLES_AT_ONCE if told.parallel is None else SAMPLES_AT_ONCE // 4
    done = evaluate_shares(work, in_shares(fixes, grid["rate_hz"], many), told.parallel)
    for reason in done.skipped.values():
        console.print(f"left out: {reason}", style="yellow")
    if done.short:
        console.print(f"left out: {done.short}", style="yellow", highlight=False)
    if done.truth:
        console.print(f"No truth: errors are against the {done.truth['reference']}.", style="bold")
    if told.mode == "auto" and done.mode == "drives":
        said = f"no piece of {told.length_s:g} s with a known attitude: whole drives, from their own alignment"
        console.print(said, style="yellow")
    scores = done.run.scores
    check_outages(protocol.outage, scores.outage)
    made = results_of(done.run, baseline=told.baseline, settle_s=told.settle_s, seed=told.seed)
    decided = {"models": told.model, "dataset": told.dataset, "imu": spec.name, "tuning": asdict(told.tuning)}
    decided["imu values"] = {"accel": asdict(spec.accel), "gyro": asdict(spec.gyro)}
    made_how = {**provenance(), **decided, "digest": digest, **done.truth, **grid, **done.rules}
    by_time, baseline = done.mode == "pieces", told.baseline
    write_report(told.out, name, scores, made, protocol=made_how, by_time=by_time, baseline=baseline)
    tables, title = all_tables(name, made), f"{' '.join(models)} on {name}"
    for table in tables:
        console.print(as_rich(table))
    for result in made:
        console.print(f"\n[bold]{answer(result)}[/bold]", highlight=False)
    if done.mode == "pieces" and any(0 < int(r.count.get("outages") or 0) < FEW for r in made):
        console.print("Few outages; mode=drives has them over all of every drive, about twice as many.", style="yellow")
    keep_said(console, told.out)
    kept = ""
    if told.tracking.log:
        with start_point(uri, told.name, title) as run:
            run.log_config(asdict(told))
            run.log_dataset(told.dataset, digest, "evaluation")
            run.log_metrics(metrics_of(made))
            run.log_files(told.out)
            run.note("\n".join(as_markdown(t) for t in tables))
        kept = f"; MLflow: run {run.id}"
    console.print(f"Report: {told.out}/report.html{kept}", soft_wrap=True)


if __name__ == "__main__":
    main()
