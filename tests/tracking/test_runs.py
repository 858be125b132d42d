"""Runs: where they go, what they hold, how they end, how they are gone on with."""

import gc
import json
import os
import signal
from contextlib import nullcontext
from multiprocessing import Pipe

import pytest
import yaml
from sqlalchemy.engine.default import DefaultDialect
from sqlalchemy.orm import loading

from dlkf.base.errors import InputError, Terminated
from dlkf.base.signals import delay_signals
from dlkf.tracking.endings import PROCESS_TAG, TRACKING_URI
from dlkf.tracking.runs import (
    VALUE_LENGTH,
    flatten_config,
    lightning_logger,
    mlflow_module,
    open_client,
    start_run,
    store_missing,
    tracking_uri,
)
from tests.shell import PATIENCE_S, start_fork

CONFIG = {"name": "town", "seed": 1, "optimizer": {"lr": 1e-3}, "data": {"datasets": ["a", "b"]}, "none": None}


def open_run(uri, name="one", **kwargs):
    return start_run(uri, "town", name, **kwargs)


def test_the_store_is_here_by_default(tmp_path, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    assert tracking_uri() == f"sqlite:///{tmp_path}/mlflow.db" and store_missing(tracking_uri())
    assert tracking_uri("sqlite:///runs/x.db") == f"sqlite:///{tmp_path}/runs/x.db"
    assert tracking_uri("http://server:5000") == "http://server:5000"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://other")
    assert tracking_uri(None) == "http://other"
    with pytest.raises(InputError, match="plain folder"):
        tracking_uri("./mlruns")


@pytest.mark.whole
def test_trainings_that_begin_together_share_a_new_store(tmp_path):
    def begin():
        open_client(f"sqlite:///{tmp_path}/mlflow.db").search_experiments()

    together = [start_fork(tmp_path, tmp_path / f"said {k}", begin) for k in range(2)]
    for k, process in enumerate(together):
        process.join(PATIENCE_S)
        assert process.exitcode == 0, (tmp_path / f"said {k}").read_text()


def test_a_run_holds_what_was_logged(uri, client, tmp_path):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "table.csv").write_text("a,b\n")
    with open_run(uri) as run:
        assert client.get_run(run.id).info.status == "RUNNING"
        run.log_config(CONFIG)
        run.log_dataset("data/town", "0123abcd", "training")
        run.log_metrics({"test/dlkf/position_rms_m": 1.5, "test/dlkf/drift": float("nan")})
        run.log_files(tmp_path / "report")
        run.note("# Town")
    found = client.get_run(run.id)
    assert found.info.status == "FINISHED" and found.info.run_name == "one"
    assert found.data.params["optimizer.lr"] == "0.001" and found.data.params["none"] == "null"
    assert found.data.metrics == {"test/dlkf/position_rms_m": 1.5}
    assert found.data.tags["mlflow.note.content"] == "# Town"
    (given,) = found.inputs.dataset_inputs
    assert (given.dataset.name, given.dataset.digest) == ("town", "0123abcd")
    kept = mlflow_module().artifacts.load_text(f"{found.info.artifact_uri}/config.yaml")
    assert yaml.safe_load(kept) == CONFIG
    assert {a.path for a in client.list_artifacts(run.id)} == {"config.yaml", "table.csv"}
    assert found.info.artifact_uri.startswith(f"file://{tmp_path}/"), "artifacts lie beside the store"


def test_a_run_of_changed_code_says_so(uri, client, monkeypatch):
    """MLflow's own tag is the commit alone. Outside of a clone there is none."""
    for commit in ("0123456789+", None):
        monkeypatch.setattr("dlkf.tracking.runs.repository_commit", lambda commit=commit: commit)
        with open_run(uri) as run:
            pass
        assert client.get_run(run.id).data.tags.get("dlkf.commit") == commit


def test_a_registered_model_names_its_metrics(uri, client):
    with open_run(uri) as run:
        run.log_metrics({"test/outage@seed2/outage_end_horizontal_m": 3.0, "test/mbkf15+my:Limit/n": 1.0})
    kept = client.get_run(run.id).data.metrics
    assert kept == {"test/outage.seed2/outage_end_horizontal_m": 3.0, "test/mbkf15.my:Limit/n": 1.0}


def test_a_long_note_ends_with_a_whole_line(uri, client):
    with open_run(uri) as run:
        run.note("a line\n" * 2000)
    kept = client.get_run(run.id).data.tags["mlflow.note.content"]
    assert len(kept) <= 8000 and kept.endswith("a line")


def test_parameters_are_cut_at_the_limits_of_mlflow(uri, client):
    """Also more parameters than fit into one request."""
    config = {"long": "x" * 10_000, "k" * 300: 1} | {f"p{i}": i for i in range(250)}
    assert len(flatten_config(config)["long"]) == VALUE_LENGTH
    with open_run(uri) as run:
        run.log_config(config)
    assert len(client.get_run(run.id).data.params) == 252


@pytest.mark.parametrize(
    ("error", "status"),
    [(ValueError, "FAILED"), (InputError, "FAILED"), (SystemExit, "FAILED"), (KeyboardInterrupt, "KILLED")],
)
def test_the_status_tells_how_a_run_ended(uri, client, error, status):
    with pytest.raises(error), open_run(uri) as run:
        raise error
    assert client.get_run(run.id).info.status == status


@pytest.mark.parametrize("given", [None, "http://127.0.0.1:9"])
def test_the_store_of_a_run_is_that_of_what_it_starts_and_of_nothing_later(given, uri, monkeypatch):
    """``mlflow.set_tracking_uri`` alone writes the store into the environment of all that this process ever starts."""
    if given:
        monkeypatch.setenv(TRACKING_URI, given)
    before = mlflow_module().get_tracking_uri()
    for ends in (nullcontext(), pytest.raises(KeyboardInterrupt)):
        with ends, open_run(uri):
            assert os.environ[TRACKING_URI] == mlflow_module().get_tracking_uri() == uri
            if not isinstance(ends, nullcontext):
                raise KeyboardInterrupt
        assert os.environ.get(TRACKING_URI) == given and mlflow_module().get_tracking_uri() == before


@pytest.mark.parametrize("statement", ["INSERT", "UPDATE"])
def test_a_signal_inside_a_write_of_mlflow_ends_the_run(statement, uri, client, monkeypatch):
    """The frames of the exception hold SQLite's cursor, and so the lock that the last write of the run waits for."""
    armed = []

    def interrupted(write):
        def run(self, cursor, text, *rest, **more):
            write(self, cursor, text, *rest, **more)
            if armed and text.lstrip().startswith(statement):
                armed.clear()
                raise Terminated

        return run

    for name in ("do_execute", "do_executemany"):
        monkeypatch.setattr(DefaultDialect, name, interrupted(getattr(DefaultDialect, name)))
    with pytest.raises(Terminated), open_run(uri) as run:
        run.log_metrics({"loss": 2.0})
        armed.append(True)
        run.log_metrics({"loss": 1.0, "rms": 3.0}, step=1)
    assert armed == [] and client.get_run(run.id).info.status == "KILLED"


def test_a_signal_between_rows_that_mlflow_reads_ends_the_run_at_once(uri, client, monkeypatch):
    """An open cursor in a cycle of objects: its lock would keep the end of the run waiting for 20 s, or for ever."""
    armed, processor = [], loading._instance_processor

    def interrupted(*given, **more):
        if armed:
            armed.clear()
            raise Terminated
        return processor(*given, **more)

    monkeypatch.setattr(loading, "_instance_processor", interrupted)
    tries, end = [], mlflow_module().end_run

    def counted(status):
        tries.append(status)
        end(status)
        tries.append("done")

    monkeypatch.setattr(mlflow_module(), "end_run", counted)
    gc.disable()
    try:
        with pytest.raises(Terminated), open_run(uri) as run:
            run.log_metrics({"loss": 2.0})
            armed.append(True)
            run.log_metrics({"loss": 1.0}, step=1)
    finally:
        gc.enable()
    assert armed == [] and tries == ["KILLED", "done"], "the first try met a lock"
    assert client.get_run(run.id).info.status == "KILLED"


def test_the_run_of_a_process_that_was_killed_is_closed_by_the_next(uri, client, tmp_path):
    """One that still runs, here or on another machine, is let be."""
    ours, theirs = Pipe()

    def dies_in_a_run():
        with open_run(uri) as run:
            theirs.send(run.id)
            theirs.recv()
            os.kill(os.getpid(), signal.SIGKILL)

    other = start_fork(tmp_path, tmp_path / "said", dies_in_a_run)
    assert ours.poll(PATIENCE_S), (tmp_path / "said").read_text()
    killed = ours.recv()
    with open_run(uri) as run:
        elsewhere = client.create_run(client.get_run(run.id).info.experiment_id, tags={PROCESS_TAG: "elsewhere 1 2"})
        assert client.get_run(killed).info.status == "RUNNING"
    ours.send("now")
    other.join(PATIENCE_S)
    assert client.get_run(killed).info.status == "RUNNING", "nobody was there to say so"
    with open_run(uri) as again:
        assert client.get_run(killed).info.status == "KILLED"
        assert client.get_run(again.id).info.status == client.get_run(elsewhere.info.run_id).info.status == "RUNNING"


def test_a_signal_waits_for_a_block_and_a_second_one_does_not(monkeypatch):
    before = signal.signal(signal.SIGTERM, lambda *_: done.append("handled"))
    done: list[str] = []
    try:
        with delay_signals():
            signal.raise_signal(signal.SIGTERM)
            done.append("block")
        assert done == ["block", "handled"]
        with delay_signals():
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            done.append("late")
        assert done == ["block", "handled", "handled", "late"]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_going_on_continues_the_same_run(uri, client):
    """Nothing logged before is lost, and logging the same config again is no conflict."""
    with pytest.raises(KeyboardInterrupt), open_run(uri) as run:
        run.log_config(CONFIG)
        run.log_metrics({"loss": 2.0}, step=0)
        raise KeyboardInterrupt
    with open_run(uri, "other name", run_id=run.id, parent_run_id="f" * 32) as again:
        assert again.resumed and again.id == run.id
        assert client.get_run(run.id).info.status == "RUNNING"
        again.log_config(CONFIG | {"seed": 2, "new": True})
        again.log_metrics({"loss": 1.0}, step=1)
    found = client.get_run(run.id)
    assert found.info.status == "FINISHED" and found.info.run_name == "one"
    assert found.data.params["seed"] == "1" and found.data.params["new"] == "true"
    assert [(m.step, m.value) for m in client.get_metric_history(run.id, "loss")] == [(0, 2.0), (1, 1.0)]
    assert found.data.tags["mlflow.parentRunId"] == "f" * 32, "the grid search it now belongs to"
    assert len(client.search_runs([found.info.experiment_id])) == 1


def test_a_run_that_is_gone_is_begun_anew(uri, client):
    with open_run(uri, run_id="0" * 32) as run:
        assert not run.resumed and run.id != "0" * 32
    client.delete_run(run.id)
    with open_run(uri, run_id=run.id) as another:
        assert another.id != run.id


def test_lightning_writes_into_the_run_and_does_not_end_it(uri, client):
    with open_run(uri) as run:
        logger = lightning_logger(run)
        logger.log_hyperparams({"lr": 1})
        logger.log_metrics({"epoch": 7, "train/gradient_norm": 2.0, "train/loss": 0.5}, step=3)
        logger.log_metrics({"epoch": 8, "val/a": 1.0, "val/loss": 0.5, "val/outage_end_m": 3.0}, step=4)
        logger.finalize("success")
        assert client.get_run(run.id).info.status == "RUNNING"
    found = client.get_run(run.id)
    # what chooses the best of a grid is what MLflow compares runs by first, also where epoch 7 is not validated
    kept = ["val/outage_end_m", "val/loss", "val/a", "train/loss", "train/gradient_norm"]
    assert list(found.data.metrics) == kept and found.data.params == {}
    assert [(m.value, m.step) for m in client.get_metric_history(run.id, "train/loss")] == [(0.5, 7)]


def test_epochs_before_an_end_without_validation_are_logged(uri, client):
    """And those of a run that goes on at once: it has its first metric already."""
    with open_run(uri) as run:
        logger = lightning_logger(run)
        logger.log_metrics({"epoch": 0, "train/loss": 2.0})
        logger.log_metrics({"epoch": 1, "train/loss": 1.0})
        assert not client.get_run(run.id).data.metrics
        logger.finalize("failed")
    with open_run(uri, run_id=run.id) as again:
        lightning_logger(again).log_metrics({"epoch": 2, "train/loss": 0.5})
    history = client.get_metric_history(run.id, "train/loss")
    assert [(m.value, m.step) for m in history] == [(2.0, 0), (1.0, 1), (0.5, 2)]


def test_mistakes_are_one_line(uri, client, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    client.delete_experiment(client.create_experiment("town"))
    with pytest.raises(InputError, match="was deleted"), open_run(uri):
        pass
    nobody = start_run("http://127.0.0.1:9", "town", "one")
    with pytest.raises(InputError, match=r"does not answer.*tracking\.uri") as error, nobody:
        pass
    assert "\n" not in str(error.value)


def test_names_survive_as_json():
    assert json.loads(flatten_config(CONFIG)["data.datasets"]) == ["a", "b"]
