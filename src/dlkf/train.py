"""Train a filter and score it against the baselines: ``python -m dlkf.train +experiment=outage``.

Simulated datasets that are missing are made first. Killed at any moment, the same command goes on where it
stopped, in the same MLflow run.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from dlkf.base.classes import instantiate
from dlkf.base.console import make_console, save_log
from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.command import command, repeat_command
from dlkf.command.composing import configuration_hash
from dlkf.command.simulated import HOUR_SEED, simulate_missing
from dlkf.data.store import dataset_digest
from dlkf.evaluation.protocol import drives_that_fit
from dlkf.evaluation.summary import describe_verdict, headline
from dlkf.evaluation.table import as_rich, result_tables
from dlkf.tracking.grid import PARENT_RUN, keep_point, run_name
from dlkf.tracking.registry import check_registration, log_model
from dlkf.tracking.runs import check_store, lightning_logger, start_run, tracking_uri
from dlkf.training.fit import check_fit
from dlkf.training.processes import is_worker
from dlkf.training.run_folder import check_digests, finished_before, hold_folder, run_folder, write_state
from dlkf.training.settings import TrainSettings, drop_unused
from dlkf.training.study import (
    key_metrics,
    list_left_out_drives,
    list_seen_recordings,
    note,
    run_study,
    train_with_baselines,
)


@command("train")
def main(config: dict[str, Any]) -> None:
    """Data, run, study, table."""
    console = make_console()
    overrides = HydraConfig.get().overrides.task
    if not overrides:
        raise InputError(
            "give what to train: +experiment=outage is the paper's network (with +profile=quick in minutes, with "
            "+profile=tiny as a trial), data.datasets=[…] your own drives; --help lists the experiments"
        )
    given = settings_from(TrainSettings, config, "")
    tracking, settings, data = given.tracking, given.study, instantiate(given.data, "data", ("setup", "describe"))
    check_store(uri := tracking_uri(tracking.uri))
    check_registration(tracking.register, tracking.alias, ("tracking.register", "tracking.alias"))
    folder, state = run_folder(given.name, configuration_hash(config), resume=given.resume)
    if is_worker():
        train_with_baselines(settings, data, folder)
        return
    name, parent = run_name(given.name, overrides), os.environ.get(PARENT_RUN)
    if parent and given.resume and (done := finished_before(folder, data.datasets, config)) and keep_point(uri, done):
        console.print(f"finished already in an interrupted grid search: MLflow run {done}")
        return
    check_fit(settings.fit, data)
    if given.scoring.outage is not None:
        drives_that_fit(given.scoring.outage, data.eval_length_s, "data.eval_length_s", "scoring.outage")
    simulate_missing(data.datasets, console)
    data.setup()
    simulate_missing([given.scoring.hour] if given.scoring.hour else [], console, HOUR_SEED)
    console.print(data.describe())
    left_out = [f"left out: {line}" for line in list_left_out_drives(settings, data)]
    for line in [*left_out, *list_seen_recordings(settings, data)]:
        console.print(line, style="yellow", highlight=False)
    if state:
        console.print(f"resuming the unfinished run in {folder}")
    begun = start_run(uri, given.name, name, parent_run_id=parent, run_id=state.get("run_id"))
    with hold_folder(folder), begun as run:
        write_state(folder, run_id=run.id, **check_digests(data.datasets, config, state))
        run.log_config(drop_unused(config))
        for dataset in data.datasets:
            run.log_dataset(dataset, dataset_digest(dataset), "training")
        logger = lightning_logger(run, given.trainer.monitor)
        outcome = run_study(settings, data, folder, logger, console.print, repeat_command("train"))
        for result in outcome.results:
            console.print(as_rich(result_tables(", ".join(Path(d).name for d in data.datasets), result)[-1]))
        save_log(console, folder / "report")
        run.log_files(folder / "report")
        run.note(note(settings, data.datasets, outcome))
        chosen = {} if parent else {"register": tracking.register, "alias": tracking.alias}  # of a grid the best is
        log_model(run, outcome.weights, metrics=key_metrics(outcome), **chosen)
        write_state(folder, finished=True)
    for result in outcome.results:
        console.print(f"[bold]{describe_verdict(result, outcome.name) or headline(result)}[/bold]", highlight=False)
    seconds = ", ".join(f"{k} {v:.0f} s" for k, v in outcome.seconds.items())
    console.print(f"{seconds}\nReport: {folder}/report/report.html\nModel:  {outcome.weights}\nMLflow: run {run.id}")


if __name__ == "__main__":
    main()
