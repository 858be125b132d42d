"""Runs: where they go, what they hold, how they end, how they are gone on with."""

import json
import subprocess
import sys
import time

import pytest
import yaml

from dlkf.errors import InputError
from dlkf.tracking import runs as tracking
from dlkf.tracking.runs import (
    VALUE_LENGTH,
    flattened,
    lightning_logger,
    mlflow_module,
    start_run,
    store_missing,
    tracking_uri,
)

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


def test_trainings_that_begin_together_share_a_new_store(tmp_path):
    begin = (
        f"from dlkf.tracking.runs import client_of; client_of('sqlite:///{tmp_path}/mlflow.db').search_experiments()"
    )
    together = [subprocess.Popen([sys.executable, "-c", begin], stderr=subprocess.PIPE) for _ in range(3)]
    said = [p.communicate()[1] for p in together]
    assert [p.returncode for p in together] == [0, 0, 0], said


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
    assert len(flattened(config)["long"]) == VALUE_LENGTH
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
        logger.finalize("success")
        assert client.get_run(run.id).info.status == "RUNNING"
    found = client.get_run(run.id)
    assert list(found.data.metrics) == ["train/loss", "train/gradient_norm"] and found.data.params == {}
    assert [(m.value, m.step) for m in client.get_metric_history(run.id, "train/loss")] == [(0.5, 7)]


def test_system_metrics_are_sampled_every_second(uri, client, monkeypatch):
    """MLflow's own interval of ten seconds leaves short runs empty."""
    monkeypatch.setattr(tracking, "SAMPLES_PER_POINT", 1)
    with start_run(uri, "town", "one", system_metrics=True) as run:
        time.sleep(1.3)
    assert "system/cpu_utilization_percentage" in client.get_run(run.id).data.metrics


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
    assert json.loads(flattened(CONFIG)["data.datasets"]) == ["a", "b"]
