"""Train a filter and score it against the baselines: ``python -m dlkf.train +experiment=outage``.

Simulated datasets that are missing are made first. Killed at any moment, the same command goes on where it
stopped, in the same MLflow run.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from dlkf.classes import made
from dlkf.command import command, same_command
from dlkf.command.composing import configuration_hash
from dlkf.command.simulated import HOUR_SEED, make_missing
from dlkf.console import keep_said, talking
from dlkf.data.store import dataset_digest
from dlkf.evaluation.protocol import fitting
from dlkf.evaluation.summary import answer
from dlkf.evaluation.table import all_tables, as_rich
from dlkf.settings import settings_from
from dlkf.tracking.grid import PARENT_RUN, run_name
from dlkf.tracking.registry import check_registration, log_model
from dlkf.tracking.runs import check_store, lightning_logger, start_run, tracking_uri
from dlkf.training.fit import check_fit
from dlkf.training.processes import is_further
from dlkf.training.run_folder import checked_digests, run_folder, write_state
from dlkf.training.settings import TrainSettings
from dlkf.training.study import left_out, run_study, train_along
from dlkf.training.summary import key_metrics, note


@command("train")
def main(config: dict[str, Any]) -> None:
    """Data, run, study, table."""
    console = talking()
    told = settings_from(TrainSettings, config, "")
    tracking, settings, data = told.tracking, told.study, made(told.data, "data")
    check_store(uri := tracking_uri(tracking.uri))
    check_registration(tracking.register, tracking.alias, ("tracking.register", "tracking.alias"))
    folder, state = run_folder(told.name, configuration_hash(config), resume=told.resume)
    if is_further():
        train_along(settings, data, folder)
        return
    check_fit(settings.fit)
    if told.scoring.outage is not None:
        fitting(told.scoring.outage, data.eval_length_s, "data.eval_length_s", "scoring.outage")
    make_missing(data.datasets, console)
    data.setup()
    make_missing([told.scoring.hour] if told.scoring.hour else [], console, HOUR_SEED)
    console.print(data.describe())
    for line in left_out(settings, data):
        console.print(f"left out: {line}", style="yellow", highlight=False)
    if state:
        console.print(f"going on with the unfinished run in {folder}")
    name = run_name(told.name, HydraConfig.get().overrides.task)
    parent = os.environ.get(PARENT_RUN)
    begun = {"parent_run_id": parent, "run_id": state.get("run_id"), "system_metrics": tracking.system_metrics}
    with start_run(uri, told.name, name, **begun) as run:
        write_state(folder, run_id=run.id, data=checked_digests(data.datasets, state))
        run.log_config(config)
        for dataset in data.datasets:
            run.log_dataset(dataset, dataset_digest(dataset), "training")
        outcome = run_study(settings, data, folder, lightning_logger(run), console.print, same_command("train"))
        for table in (*all_tables(", ".join(Path(d).name for d in data.datasets), outcome.results), *outcome.tables):
            console.print(as_rich(table))
        keep_said(console, folder / "report")
        run.log_files(folder / "report")
        run.note(note(settings, data.datasets, outcome))
        chosen = {} if parent else {"register": tracking.register, "alias": tracking.alias}  # of a grid the best is
        log_model(run, outcome.weights, metrics=key_metrics(outcome), **chosen)
        write_state(folder, finished=True)
    for result in outcome.results:
        console.print(f"\n[bold]{answer(result)}[/bold]", highlight=False)
    seconds = ", ".join(f"{k} {v:.0f} s" for k, v in outcome.seconds.items())
    console.print(f"{seconds}\nReport: {folder}/report/report.html\nModel:  {outcome.weights}\nMLflow: run {run.id}")


if __name__ == "__main__":
    main()
