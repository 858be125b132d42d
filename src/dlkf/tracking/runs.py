"""Runs in MLflow: an embedded SQLite store here by default, a server by one setting (``tracking.uri``)."""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import yaml

from dlkf.base.errors import InputError
from dlkf.base.files import folder_name, is_url, local_copy
from dlkf.base.own_code import find_own_modules
from dlkf.base.processes import process_label
from dlkf.base.provenance import repository_commit
from dlkf.base.signals import delay_signals
from dlkf.tracking.endings import PROCESS_TAG, close_killed_runs, end_run, mlflow_module, use_store

if TYPE_CHECKING:
    from lightning.pytorch.loggers import MLFlowLogger
    from mlflow import MlflowClient

STORE, ARTIFACTS = "mlflow.db", "mlruns"
SQLITE = "sqlite:///"
RUN_ID = re.compile(r"[0-9a-f]{32}")
PARENT_TAG, NOTE_TAG = "mlflow.parentRunId", "mlflow.note.content"
COMMIT_TAG = "dlkf.commit"  # with + where files were changed, which MLflow's own mlflow.source.git.commit does not say
KIND = {"mlflow.experimentKind": "custom_model_development"}  # else the UI shows pages for language models
KEY_LENGTH, VALUE_LENGTH, NOTE_LENGTH = 250, 6000, 8000  # MLflow's limits
MONITORS = ("val/outage_end_m", "val/loss")  # what training keeps the best weights by, unless it is given another
NOT_IN_NAMES = re.compile(r"[^\w\-. :/]")  # of metrics
SCHEMES = ("sqlite", "http", "https", "file", "postgresql", "mysql", "mssql", "databricks", "uc", "databricks-uc")
LOCKED_S = 15.0  # a writer of many metrics holds the store for less


def tracking_uri(given: str | None = None) -> str:
    """Where runs are kept: ``given``, else ``MLFLOW_TRACKING_URI``, else ``mlflow.db`` in this folder.

    A relative SQLite path is made absolute. Raises InputError for a plain folder, which MLflow refuses.
    """
    uri = given or os.environ.get("MLFLOW_TRACKING_URI") or SQLITE + STORE
    if "://" in uri and uri.partition("://")[0].partition("+")[0] not in SCHEMES:
        raise InputError(f"tracking.uri={uri}: no kind of MLflow store; give sqlite:///<path>.db, or http://<server>")
    if uri.startswith(SQLITE):
        return SQLITE + str(Path(uri.removeprefix(SQLITE)).expanduser().resolve())
    if "://" not in uri or uri.startswith("file:"):
        raise InputError(
            f"tracking.uri={uri} is a plain folder, which MLflow no longer takes; "
            f"give sqlite:///<path>.db or the address of a server (http://…)"
        )
    return uri


def store_missing(uri: str) -> bool:
    """Whether the URI is an embedded store that does not exist yet."""
    return uri.startswith(SQLITE) and not Path(uri.removeprefix(SQLITE)).is_file()


def open_client(uri: str) -> MlflowClient:
    """A client of the store. An embedded store is made or brought up to date by one process at a time: MLflow does not
    see to that, and of two trainings that begin together one would fail."""
    mlflow = mlflow_module()
    if not uri.startswith(SQLITE):
        return mlflow.MlflowClient(uri)
    folder = Path(uri.removeprefix(SQLITE)).parent
    folder.mkdir(parents=True, exist_ok=True)
    _wait_for_lock(uri, "BEGIN; SELECT * FROM sqlite_master")
    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        return mlflow.MlflowClient(uri)
    finally:
        os.close(held)


def check_store(uri: str) -> None:
    """Raises InputError for a store that runs cannot be written to: locked, or a server that does not answer."""
    if uri.startswith(SQLITE):
        _wait_for_lock(uri, "BEGIN IMMEDIATE")
    else:
        with reachable(uri):
            open_client(uri).search_experiments(max_results=1)


def _wait_for_lock(uri: str, lock: str) -> None:
    """Waits for a lock of an embedded store, for a while: MLflow would try again for minutes."""
    if store_missing(uri):
        return
    path = uri.removeprefix(SQLITE)
    try:
        with closing(sqlite3.connect(path, timeout=LOCKED_S)) as store:
            store.executescript(f"{lock}; ROLLBACK")
    except sqlite3.OperationalError as error:
        if "locked" in str(error):  # for all else MLflow has its own checks
            raise InputError(
                f"the MLflow store {path} is locked by another program; wait or close it, then give the same command "
                "again, or another store (tracking.uri=sqlite:///<path>.db)"
            ) from None
    except sqlite3.DatabaseError:
        pass


@contextmanager
def reachable(uri: str) -> Iterator[None]:
    """Turn a failing connection to a tracking server into an InputError."""
    from mlflow.exceptions import MlflowException
    from requests.exceptions import RequestException

    try:
        yield
    except (RequestException, MlflowException) as error:
        no_answer = isinstance(error, RequestException) or "failed with exception" in str(error)
        if not (uri.startswith("http") and no_answer):
            raise
        message = f"the MLflow server {uri} does not answer; start it, or correct tracking.uri"
        raise InputError(message) from None


def experiment_id(client: MlflowClient, name: str) -> str:
    """The experiment of this name, made if need be; artifacts of an embedded store lie beside it.

    Raises InputError if the experiment was deleted, or the store moved away from its artifacts.
    """
    from mlflow.exceptions import MlflowException

    uri, location = client.tracking_uri, None
    if uri.startswith(SQLITE):
        store = Path(uri.removeprefix(SQLITE))
        store.parent.mkdir(parents=True, exist_ok=True)
        location = (store.parent / ARTIFACTS / name).as_uri()
    found = client.get_experiment_by_name(name)
    if found is None:
        try:
            return client.create_experiment(name, artifact_location=location, tags=KIND)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":  # made by another process in the meantime
                raise
            found = client.get_experiment_by_name(name)
    assert found is not None
    if found.lifecycle_stage == "deleted":
        raise InputError(f"the MLflow experiment {name!r} was deleted; restore it or give another name=")
    place = found.artifact_location
    if location is not None and place != location and place.startswith("file:") and ARTIFACTS in place:
        old = Path(unquote(urlsplit(place).path)).parents[1]
        if not old.is_dir():
            raise InputError(
                f"the MLflow store {uri.removeprefix(SQLITE)} has its files in {old}, which is not there: move the "
                "folder back, or begin a new store (tracking.uri=sqlite:///<path>.db)"
            )
    return found.experiment_id


@dataclass(frozen=True)
class TrackedRun:
    """One MLflow run that is being written."""

    id: str
    uri: str
    resumed: bool
    client: MlflowClient

    def log_config(self, config: Mapping[str, Any]) -> None:
        """The whole config as ``config.yaml``, and flattened into parameters (those that are not there yet).

        Values longer than MLflow takes are cut in the parameters, never in the file. The source of a user's own classes
        in the config goes into ``code/``.
        """
        from mlflow.entities import Param

        there = self.client.get_run(self.id).data.params
        new = [Param(k, v) for k, v in flatten_config(config).items() if k not in there]
        self.client.log_batch(self.id, params=new)
        self.client.log_text(self.id, yaml.safe_dump(dict(config), sort_keys=False), "config.yaml")
        for path, file in find_own_modules(config).items():
            self.client.log_artifact(self.id, str(file), str(Path("code", path).parent))

    def log_dataset(self, folder: Path | str, digest: str, context: str) -> None:
        """A dataset folder with its digest: the Dataset column of the UI."""
        from mlflow.entities import DatasetInput, InputTag

        given = DatasetInput(dataset_entity(folder, digest), [InputTag("mlflow.data.context", context)])
        self.client.log_inputs(self.id, datasets=[given])

    def log_metrics(self, metrics: Mapping[str, float], step: int = 0) -> None:
        """Many metrics together; those that are not finite are left out.

        A name of a model may have what MLflow does not take in a metric's (``outage@champion``): a dot stands for it.
        """
        from mlflow.entities import Metric
        from mlflow.utils.time import get_current_time_millis

        now = get_current_time_millis()
        kept = [Metric(NOT_IN_NAMES.sub(".", k), float(v), now, step) for k, v in metrics.items() if math.isfinite(v)]
        self.client.log_batch(self.id, metrics=kept)

    def log_files(self, folder: Path | str) -> None:
        """Everything in a folder, or one file, as artifacts."""
        with local_copy(folder) as path:
            if path.is_dir():
                self.client.log_artifacts(self.id, str(path))
            else:
                self.client.log_artifact(self.id, str(path))

    def note(self, markdown: str) -> None:
        """What the UI shows as the description of the run; whole lines up to MLflow's limit."""
        if len(markdown) > NOTE_LENGTH:
            markdown = markdown[:NOTE_LENGTH].rpartition("\n")[0]
        self.client.set_tag(self.id, NOTE_TAG, markdown)


def dataset_entity(folder: Path | str, digest: str):
    """A dataset folder as MLflow has it: name, digest and place; the data stay where they are."""
    from mlflow.entities import Dataset

    url = str(folder) if is_url(folder) else Path(folder).expanduser().resolve().as_uri()
    kind = url.partition(":")[0] if is_url(folder) else "local"
    return Dataset(folder_name(folder), digest[:36], kind, json.dumps({"uri": url}))


def flatten_config(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """``{"optimizer.lr": "0.001", …}``: names joined by dots, values as JSON, cut at MLflow's limits."""
    params: dict[str, str] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            params |= flatten_config(value, f"{name}.")
        else:
            text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            params[name[:KEY_LENGTH]] = text[:VALUE_LENGTH]
    return params


@contextmanager
def start_run(
    uri: str,
    experiment: str,
    name: str,
    *,
    parent_run_id: str | None = None,
    run_id: str | None = None,
) -> Iterator[TrackedRun]:
    """Open a run, or go on with ``run_id`` if this store has it; its status at the end is how it ended.

    ``parent_run_id`` makes it a child. Status: FINISHED, FAILED after an exception, KILLED after Ctrl-C or SIGTERM.
    Runs of this experiment whose process was killed on this machine are closed as KILLED first. Raises InputError
    where the server does not answer or the experiment was deleted.
    """
    mlflow = mlflow_module()
    with use_store(uri):
        check_store(uri)
        tags = {PROCESS_TAG: process_label()} | ({PARENT_TAG: parent_run_id} if parent_run_id else {})
        tags |= {COMMIT_TAG: commit} if (commit := repository_commit()) else {}
        try:
            with reachable(uri), delay_signals():
                client = open_client(uri)
                group = experiment_id(client, experiment)
                close_killed_runs(client, group)
                resumed = run_id is not None and run_exists(client, run_id)
                if resumed:
                    active = mlflow.start_run(run_id)
                    for key, value in tags.items():  # a point of a grid search started again has another parent
                        client.set_tag(active.info.run_id, key, value)
                else:
                    active = mlflow.start_run(experiment_id=group, run_name=name, tags=tags)
            yield TrackedRun(active.info.run_id, uri, resumed, client)
        except BaseException as error:
            end_run("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED", error)
            raise
        end_run("FINISHED")


def run_exists(client: MlflowClient, run_id: str) -> bool:
    """Whether the store holds this run, not deleted."""
    from mlflow.exceptions import MlflowException

    try:
        return client.get_run(run_id).info.lifecycle_stage == "active"
    except MlflowException as error:
        if error.error_code != "RESOURCE_DOES_NOT_EXIST":
            raise
        return False


def lightning_logger(run: TrackedRun, monitor: str | None = None) -> MLFlowLogger:
    """Lightning's logger on this run. Parameters and the final status stay the run's own business.

    Steps are epochs, so that curves of runs with other batch sizes lie over each other. Of what comes together the
    metric that chooses the weights, ``monitor``, is first, then what chooses them by default: the page that compares
    runs starts with the metric that a run logged first, which should be the one by which a grid's best is chosen. So
    epochs of a new run before the first validation are logged after it, with the time at which they ended.
    """
    from lightning.pytorch.loggers import MLFlowLogger
    from mlflow.entities import Metric
    from mlflow.utils.time import get_current_time_millis

    first = [name for name in (monitor, *MONITORS) if name]

    def rank(name: str) -> tuple[int, bool, str]:
        return first.index(name) if name in first else len(first), not name.endswith("/loss"), name

    class MetricsOnly(MLFlowLogger):
        held: list[Metric] | None = None if run.resumed else []  # None after the first validation

        def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
            """With the epoch as step."""
            rest = {k: metrics[k] for k in sorted(metrics, key=rank) if k != "epoch"}
            epoch = int(metrics.get("epoch", step or 0))
            if self.held is not None and not any(k.startswith("val/") for k in rest):
                now = get_current_time_millis()
                self.held = [*self.held, *(Metric(k, float(v), now, epoch) for k, v in rest.items())]
                return
            super().log_metrics(rest, epoch)
            self.release()

        def release(self) -> None:
            """Log what was held back."""
            held, self.held = self.held or [], None
            run.client.log_batch(run.id, metrics=held)

        def log_hyperparams(self, params: Any) -> None:
            """The run has the whole config already, uncut."""

        def finalize(self, status: str = "success") -> None:
            """The run goes on after training: scores and model follow."""
            self.release()

    return MetricsOnly(run_id=run.id, tracking_uri=run.uri)
