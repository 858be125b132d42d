"""Score filters on a dataset: ``python -m dlkf.evaluate model=[ins,mbkf15] dataset=data/town imu=consumer``.

Prints the results table and leaves metrics.json, table.md, table.csv, report.html and log.txt in ``out``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

from rich.console import Console

from dlkf.base.callable_module import make_callable
from dlkf.base.console import make_console, save_log
from dlkf.base.files import absolute_place, folder_name, require_empty
from dlkf.base.parallel import check_engine
from dlkf.base.provenance import describe_provenance
from dlkf.command import command, list_typed_words
from dlkf.command.scored import EvaluateSettings
from dlkf.data.kinds import drive_kinds, drive_rates
from dlkf.data.store import choose_aids, dataset_digest, drive_rows
from dlkf.evaluation.chunks import SHORT, EvaluationJob, evaluate_chunks, suggest_more_outages
from dlkf.evaluation.outages import UNUSED, check_outages, describe_rounding, describe_unused
from dlkf.evaluation.protocol import REFUSED
from dlkf.evaluation.results import Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.sensors import sensor_table
from dlkf.evaluation.study import choose_baseline, make_results
from dlkf.evaluation.summary import FEW, collect_metrics, describe_untuned, headline, sigma_warnings
from dlkf.evaluation.table import ResultTable, all_tables, as_markdown, as_rich, result_tables
from dlkf.filters.aids.attach import aid_columns, describe_aids, find_tables, refuse_left_out, with_aids
from dlkf.filters.build import build_filter, is_filter
from dlkf.filters.card import card_of_tuning, domain_warnings, select_scored_drives
from dlkf.filters.saved import choose_grid
from dlkf.report.evaluation import write_report
from dlkf.running.grid import UsableFixes
from dlkf.running.offline import SAMPLES_AT_ONCE, chunk_drives
from dlkf.running.references import check_reference
from dlkf.tracking.grid import start_point
from dlkf.tracking.models import resolve_models, unused_settings
from dlkf.tracking.runs import check_store, tracking_uri


class EvaluationRun(NamedTuple):
    """Scores of an evaluation, its results per kind of data, how it was done, on which data, against which filter, and
    what was said of drives and filters; advice on few outages."""

    scores: Scores
    results: list[Results]
    protocol: Mapping[str, Any]
    digest: str
    baseline: str
    sensors: ResultTable | None
    notes: Sequence[str]
    advice: str


def evaluate_dataset(settings: EvaluateSettings, console: Console, typed: Sequence[str] = ()) -> EvaluationRun:
    """Load, run every model over the same scenes, score; messages on the way go to ``console``.

    ``typed``: what was typed of ``imu`` and ``tuning``.
    """
    protocol, spec = settings.protocol(settings.align), settings.spec
    models = resolve_models(settings.models, spec, tracking_uri(settings.tracking.uri), **settings.filter_options)
    unused = [unused_settings(model, typed) for model in settings.models]
    if all(unused):  # beside a model that takes them nobody wonders
        console.print("\n".join(unused), style="yellow", highlight=False, soft_wrap=True)
    baseline = choose_baseline(settings.baseline, models)
    check_reference(settings.reference)
    chosen = choose_aids(settings.dataset, settings.aids, settings.drives)
    if settings.aids is not None:
        refuse_left_out(models, chosen)
    models = {model_name: with_aids(model, chosen) for model_name, model in models.items()}
    taken = dict.fromkeys(table for model in models.values() for table in find_tables(model))
    check_engine(settings.parallel, settings.dataset)
    rows, name = drive_rows(settings.dataset, settings.drives), folder_name(settings.dataset)
    rates = drive_rates(settings.dataset, [row.name for row in rows])
    step = choose_grid(models.values(), settings.rate_hz, settings.epoch_s, rates=rates.values())
    grid = {**step, "aids": tuple(taken)}
    digest, kinds = dataset_digest(settings.dataset), drive_kinds(settings.dataset)
    cards = {model_name: getattr(model, "card", {}) for model_name, model in models.items()}
    kalman = [model_name for model_name in models if is_filter(model_name) and model_name != "ins"]
    cards |= card_of_tuning(kalman, settings.tuning)
    rows, seen = select_scored_drives(cards, rows, name, digest, leave_out=settings.unseen)
    rates = {row.name: rates[row.name] for row in rows if row.name in rates}
    strange = domain_warnings(models, settings.dataset, rates, spec.name, grid["rate_hz"])
    untuned = describe_untuned(models, settings.tuning, spec.name)
    rounded = describe_rounding(protocol.outage, step["epoch_s"])
    unlike = f"no ratios: baseline={baseline} is not among the models" if baseline not in models else ""
    notes = [*seen, *strange, *filter(None, (untuned, rounded, unlike))]
    for line in notes:
        console.print(line, style="yellow")
    for line in describe_aids(models, chosen):
        console.print(line, highlight=False)
    work = EvaluationJob(
        absolute_place(settings.dataset), models, protocol, grid, kinds, {row.name: row.group for row in rows},
        reference=settings.reference, smoother=build_filter("mbkf21", spec, tuning=settings.tuning),
        align=settings.align, law=settings.injected_bias, seed=settings.seed,
        shown=settings.parallel is None and not console.quiet,
    )  # fmt: skip
    fixes = {row.name: UsableFixes.of(settings.dataset, row.name) for row in rows}
    many = SAMPLES_AT_ONCE if settings.parallel is None else SAMPLES_AT_ONCE // 4
    chunks = chunk_drives(fixes, grid["rate_hz"], many)
    done = evaluate_chunks(work, chunks, settings.parallel)
    for reason in done.rules["skipped"].values():
        console.print(f"left out: {reason}", style="yellow")
    for drive, said in done.rules.get(REFUSED, {}).items():
        console.print(f"drive {drive}: rejected as implausible: {said}", style="yellow", highlight=False)
    if SHORT in done.rules:
        console.print(f"left out: {done.rules[SHORT]}", style="yellow", highlight=False)
    if done.truth:
        console.print(f"No truth: errors are against the {done.truth['reference']}.", style="bold")
    if settings.mode == "auto" and done.rules["mode"] == "drives":
        said = f"no segment of {settings.length_s:g} s with a known attitude: evaluating whole drives, mode=drives"
        console.print(said, style="yellow")
    scores = done.scores
    check_outages(protocol.outage, scores.outage, max(x.span_s for x in fixes.values()))
    if protocol.outage and (unused := describe_unused(protocol.outage, scores.outage, *scores.ends)):
        console.print(unused, style="yellow", highlight=False)
        done.rules[UNUSED] = unused
    results = make_results(scores, baseline=baseline, settle_s=settings.settle_s, seed=settings.seed)
    made_how = {
        **describe_provenance(), "models": settings.model, "dataset": settings.dataset, "imu": spec.name,
        "tuning": settings.tuning.factors(), "imu values": {"accel": asdict(spec.accel), "gyro": asdict(spec.gyro)},
        "digest": digest, **done.truth, **step, **done.rules, "aids": [table.name for table in taken],
    }  # fmt: skip
    sensors = sensor_table(scores, {model_name: aid_columns(model) for model_name, model in models.items()})
    of_kinds, advice = [int(r.count["outages"]) for r in results], ""
    if done.rules["mode"] == "segments" and any(0 < n < FEW for n in of_kinds):
        advice = suggest_more_outages(work, chunks, sum(of_kinds), settings.parallel)
    return EvaluationRun(scores, results, made_how, digest, baseline, sensors, notes, advice)


@command("evaluate", EvaluateSettings)
def main(settings: EvaluateSettings) -> None:
    """Score, write, print."""
    console = make_console()
    require_empty(settings.out, overwrite=settings.overwrite)
    uri, name = tracking_uri(settings.tracking.uri), folder_name(settings.dataset)
    if settings.tracking.log:
        check_store(uri)
    done = evaluate_dataset(settings, console, list_typed_words("imu", "tuning"))
    results, segments = done.results, done.protocol["mode"] == "segments"
    write_report(
        settings.out, name, done.scores, results, protocol=done.protocol, by_time=segments, baseline=done.baseline,
        more=[done.sensors] if done.sensors else (), figures=settings.figures,
    )  # fmt: skip
    for result in results:
        console.print(as_rich(result_tables(name, result)[-1]))
        console.print(f"[bold]{headline(result)}[/bold]", highlight=False)
    for line in sigma_warnings(done.scores):
        console.print(line, style="yellow", highlight=False, soft_wrap=True)
    if done.advice:
        console.print(done.advice, style="yellow", highlight=False, soft_wrap=True)
    save_log(console, settings.out)
    kept = ""
    if settings.tracking.log:
        with start_point(uri, settings.name, f"{' '.join(done.scores.filters)} on {name}") as run:
            run.log_config(asdict(settings))
            run.log_dataset(settings.dataset, done.digest, "evaluation")
            run.log_metrics(collect_metrics(results))
            run.log_files(settings.out)
            run.note("\n".join(as_markdown(t) for t in all_tables(name, results)))
        kept = f"; MLflow: run {run.id}"
    console.print(f"Report: {settings.out}/report.html{kept}", soft_wrap=True, markup=False)


make_callable(__name__, "dlkf.frames:evaluate")


if __name__ == "__main__":
    main()
