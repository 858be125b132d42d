"""Grid search: parent run, children, final status, comparison; with sweeps that take no training."""

import atexit
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from dlkf.base.points import SWEPT, Failure, collect_failures, report_failure
from dlkf.base.processes import MACHINE
from dlkf.command.sweeps import job_folder
from dlkf.tracking.comparison import best_validation, monitored_metric
from dlkf.tracking.endings import PROCESS_TAG
from dlkf.tracking.grid import PARENT_RUN, GridParent, keep_point, parent_status, run_name, swept_overrides
from dlkf.tracking.runs import mlflow_module, start_run
from tests.shell import PATIENCE_S

TASK = ["+experiment=outage", "optimizer.lr=1e-3,1e-4", "filter@model=dlkf", "seed=range(2)", "data.x=[1,2]"]


def sweep_config(uri, task=TASK, params=None):
    hydra = {"overrides": {"task": list(task)}, "sweeper": {"params": params}}
    return OmegaConf.create({"name": "town", "tracking": {"uri": uri}, "hydra": hydra})


def point(uri, name, rms=None, error=None, experiment="town"):
    """A child as the train command makes it."""
    with start_run(uri, experiment, name, parent_run_id=os.environ[PARENT_RUN]) as run:
        run.log_config({"optimizer": {"lr": name}, "seed": 0, "tracking": {"uri": uri + name}})
        if error:
            raise error
        run.log_metrics({"val/outage_end_m": 2 * rms}, step=1)
        run.log_metrics({"val/outage_end_m": 3 * rms}, step=2)
        run.log_metrics({"test/dlkf/outage_end_horizontal_m": rms, "test/mbkf15/outage_end_horizontal_m": 9.0})
    return run


def test_only_what_is_swept_counts(uri):
    config = sweep_config(uri, params={"loss.prior": "0,1", "trainer.max_epochs": "5"})
    swept = swept_overrides(config)
    assert swept == {"loss.prior": "0,1", "optimizer.lr": "1e-3,1e-4", "seed": "range(2)"}


def test_a_sweep_that_finishes(uri, client, capsys):
    """Parent and children in one experiment; the table lists what differs, by the best validation of each."""
    grid = GridParent()
    grid.on_multirun_start(sweep_config(uri))
    parent = os.environ[PARENT_RUN]
    assert run_name("town", ["+experiment=outage", "optimizer.lr=0.001", "seed=1"]) == "lr=0.001 seed=1"
    worse, better = point(uri, "worse", 5.0), point(uri, "better", 2.0)
    grid.on_multirun_end(OmegaConf.create())
    assert PARENT_RUN not in os.environ and SWEPT not in os.environ
    found = client.get_run(parent)
    assert found.info.status == "FINISHED" and found.info.run_name == "grid lr 1e-3,1e-4 × seed range(2)"
    assert found.data.params == {"optimizer.lr": "1e-3,1e-4", "seed": "range(2)"}
    for run in (worse, better):
        child = client.get_run(run.id)
        assert child.data.tags["mlflow.parentRunId"] == parent
        assert child.info.experiment_id == found.info.experiment_id
    printed = capsys.readouterr().out
    assert printed.index("better") < printed.index("worse") and parent in printed
    assert found.data.tags["best_run"] == "better"
    assert found.data.metrics["test/dlkf/outage_end_horizontal_m"] == 2.0, "scores of the best beside the grid"
    title = "Horizontal error at the end of the outages, RMS [m]; test segments, runs by their validation"
    assert title in printed.splitlines() and "better" in found.data.tags["mlflow.note.content"]
    table = mlflow_module().artifacts.load_text(f"{found.info.artifact_uri}/comparison.csv").splitlines()
    assert table[0].startswith("run,run_id,status,optimizer.lr,val/outage_end_m,test/dlkf/")
    assert table[1] == f"worse,{worse.id},FINISHED,worse,10.0,5.0,9.0"


def test_a_failed_child_fails_the_parent_but_not_the_table(uri, client, capsys):
    """Hydra leaves out on_multirun_end then; what runs at exit does the same work."""
    grid = GridParent()
    grid.on_multirun_start(sweep_config(uri))
    parent = os.environ[PARENT_RUN]
    point(uri, "good", 5.0)
    with pytest.raises(ValueError):
        point(uri, "bad", error=ValueError())
    grid.close(ended=False)
    assert client.get_run(parent).info.status == "FAILED"
    printed = capsys.readouterr().out
    assert "| good | FINISHED | 10.0             | 5.00 | 9.00   |" in printed
    assert "| bad  | FAILED   |                  |" in printed
    grid.close(ended=False)
    assert capsys.readouterr().out == "", "closed once"


def test_children_that_were_cut_down_do_not_stay_running(uri, client):
    grid = GridParent()
    grid.on_multirun_start(sweep_config(uri))
    parent = client.get_run(os.environ[PARENT_RUN])
    tags = {"mlflow.parentRunId": parent.info.run_id}
    child = client.create_run(parent.info.experiment_id, tags=tags)
    grid.close(ended=False)
    assert client.get_run(child.info.run_id).info.status == "FAILED"
    assert client.get_run(parent.info.run_id).info.status == "FAILED"


def test_a_grid_given_again_keeps_the_points_that_finished(uri, client):
    """After a kill, or where another point failed; of a grid search that finished every point is trained again."""
    task = sweep_config(uri)
    broken = GridParent()
    broken.on_multirun_start(task)
    first = os.environ[PARENT_RUN]
    done = point(uri, "done", 5.0)
    assert not keep_point(uri, done.id), "it runs still"
    atexit.unregister(broken.close)
    client.set_tag(first, PROCESS_TAG, f"{MACHINE}-0-1")

    again = GridParent()
    again.on_multirun_start(task)
    assert client.get_run(first).info.status == "KILLED"
    second = os.environ[PARENT_RUN]
    assert keep_point(uri, done.id) and not keep_point(uri, "0" * 32)
    assert client.get_run(done.id).data.tags["mlflow.parentRunId"] == second
    again.on_multirun_end(OmegaConf.create())
    assert client.get_run(second).info.status == "FINISHED"
    assert not keep_point(uri, done.id), "no grid search runs"

    third = GridParent()
    third.on_multirun_start(task)
    assert not keep_point(uri, done.id)
    third.close(ended=False)


def test_children_in_other_experiments_are_found(uri, client, capsys):
    """A sweep over experiment=a,b changes the name and with it the MLflow experiment."""
    grid = GridParent()
    grid.on_multirun_start(sweep_config(uri))
    point(uri, "elsewhere", 1.0, experiment="city")
    grid.on_multirun_end(OmegaConf.create())
    assert "elsewhere" in capsys.readouterr().out


def test_a_point_that_never_began_a_run_is_named(uri, client, capsys):
    """It failed on its settings; the parent says so, and the other is compared and its champion registered."""
    grid = GridParent()
    with collect_failures():
        grid.on_multirun_start(sweep_config(uri))
        parent = os.environ[PARENT_RUN]
        point(uri, "good", 5.0)
        assert report_failure(Failure("lr=fast", "optimizer.lr is 'fast', must be a number", mistake=True), 1)
        grid.on_multirun_end(OmegaConf.create())
    found = client.get_run(parent)
    assert found.info.status == "FAILED" and found.data.tags["best_run"] == "good"
    assert "failed: lr=fast: optimizer.lr is 'fast'" in found.data.tags["mlflow.note.content"]
    assert "failed: lr=fast" in capsys.readouterr().out


def test_validation_is_what_kept_the_weights(uri, client):
    """The loss where no outages were validated; epochs from which no weights are kept do not count."""
    with start_run(uri, "town", "one") as run:
        run.log_config({"trainer": {"monitor": None, "best_from_epoch": 2}})
        for epoch, loss in enumerate((0.1, 0.2, 0.7, 0.5)):
            run.log_metrics({"val/loss": loss}, step=epoch)
    found = client.get_run(run.id)
    assert monitored_metric([found]) == "val/loss" and best_validation(client, found, "val/loss") == 0.5
    with start_run(uri, "town", "two") as run:
        run.log_config({"trainer": {"monitor": "val/gain_std"}})
        run.log_metrics({"val/loss": 1.0, "val/outage_end_m": 1.0, "val/gain_std": 3.0})
    assert monitored_metric([client.get_run(run.id)]) == "val/gain_std"


def test_keys_are_short_where_they_can_be(monkeypatch):
    monkeypatch.setenv(PARENT_RUN, "x")
    monkeypatch.setenv(SWEPT, '["optimizer.lr", "scoring.outage.first_s", "callbacks.outage.first_s"]')
    words = ["optimizer.lr=1", "scoring.outage.first_s=2", "callbacks.outage.first_s=3", "seed=4"]
    assert run_name("town", words) == "lr=1 scoring.outage.first_s=2 callbacks.outage.first_s=3"


def test_a_grid_over_nothing_has_short_names(uri, client):
    """-m without values to go over: the folder of its one point is its number, not all that was given."""
    words = ["model=mbkf15", "dataset=data/town", "outage.duration_s=[30,60]"]
    job = OmegaConf.create({"job": {"num": 0}, "overrides": {"task": words}})
    grid = GridParent()
    grid.on_multirun_start(sweep_config(uri, words))
    parent = os.environ[PARENT_RUN]
    assert job_folder(job) == "0"
    point(uri, "only", 5.0)
    grid.on_multirun_end(OmegaConf.create())
    assert client.get_run(parent).info.run_name == "grid of one point"
    grid.on_multirun_start(sweep_config(uri, [*words, "imu=consumer,bmi270"]))
    job.overrides.task.append("imu=bmi270")
    assert job_folder(job) == "0-imu=bmi270"
    grid.close(ended=False)


@pytest.mark.parametrize(
    ("statuses", "ended", "status"),
    [
        (["FINISHED", "FINISHED"], True, "FINISHED"),
        (["FINISHED", "FAILED"], True, "FAILED"),
        (["FINISHED", "KILLED"], False, "KILLED"),
        (["FINISHED"], False, "FAILED"),
        ([], True, "FAILED"),
    ],
)
def test_the_parent_ends_as_its_children_do(statuses, ended, status):
    assert parent_status(statuses, ended) == status


def test_a_single_run_is_named_by_what_was_changed(monkeypatch):
    monkeypatch.delenv(PARENT_RUN, raising=False)
    overrides = ["+experiment=outage", "+profile=quick", "seed=1", "tracking.uri=x", "filter@model=dlkf_literal"]
    assert run_name("outage", overrides) == "seed=1 model=dlkf_literal outage quick"
    assert run_name("town", ["name=town"]) == "town"


def test_a_store_that_cannot_be_opened_stops_the_sweep(uri, capsys):
    """Hydra would turn any other exception of a callback into a warning."""
    with pytest.raises(SystemExit) as end:
        GridParent().on_multirun_start(sweep_config("./mlruns"))
    assert end.value.code == 2 and capsys.readouterr().err.count("\n") == 1


PROGRAM = """
import os, sys
from hydra import main
from dlkf.tracking.runs import start_run, tracking_uri

@main(version_base="1.3", config_path=".", config_name="conf")
def task(cfg):
    with start_run(tracking_uri(), cfg.name, f"x={cfg.x}", parent_run_id=os.environ["DLKF_PARENT_RUN_ID"]) as run:
        for step in range(20):
            run.log_metrics({"train/loss": 1.0 / (step + 1)}, step)
        if cfg.x == 3:
            raise ValueError("three")
        run.log_metrics({"test/dlkf/position_rms_m": float(cfg.x)})

if __name__ == "__main__":
    task()
"""
CONF = """
name: town
x: 0
tracking: {uri: null}
hydra:
  output_subdir: null
  callbacks: {grid: {_target_: dlkf.tracking.grid.GridParent}}
"""


def swept(folder: Path, client, *launcher: str, **environment: str) -> None:
    """Three points, the last of which fails: the parent's id reaches worker processes, all write into one store."""
    (folder / "sweep.py").write_text(PROGRAM)
    (folder / "conf.yaml").write_text(CONF)
    done = subprocess.run(
        [sys.executable, "sweep.py", "-m", "x=1,2,3", *launcher],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 1 and "ValueError: three" in done.stderr
    experiment = client.get_experiment_by_name("town").experiment_id
    runs = {r.info.run_name: r for r in client.search_runs([experiment])}
    assert {name: r.info.status for name, r in runs.items()} == {
        "grid x 1,2,3": "FAILED", "x=1": "FINISHED", "x=2": "FINISHED", "x=3": "FAILED"
    }  # fmt: skip
    parent = runs["grid x 1,2,3"].info.run_id
    assert all(r.data.tags["mlflow.parentRunId"] == parent for n, r in runs.items() if n != "grid x 1,2,3")
    assert all(len(client.get_metric_history(runs[f"x={k}"].info.run_id, "train/loss")) == 20 for k in (1, 2, 3))
    assert "Position error, RMS [m]" in done.stdout and parent in done.stdout


@pytest.mark.commands
def test_a_real_sweep_with_a_failing_point(uri, client, tmp_path):
    """Through Hydra into SQLite, at once from two processes."""
    swept(tmp_path, client, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")


@pytest.fixture
def postgresql():
    """The URI of an empty PostgreSQL database of a server of this machine; no test where none is installed."""
    pytest.importorskip("psycopg2")
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    where = str(programs[-1]) if programs else None
    initdb, server = (shutil.which(name, path=where) or shutil.which(name) for name in ("initdb", "postgres"))
    if not initdb or not server:
        pytest.skip("no PostgreSQL here")
    owner = {"user": "postgres"} if os.geteuid() == 0 else {}  # it does not run as root
    with tempfile.TemporaryDirectory(dir="/tmp") as home, socket.socket() as free:  # a socket's path must be short
        if owner:
            shutil.chown(home, "postgres")
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        given = {"cwd": home, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **owner}
        subprocess.run([initdb, "-D", f"{home}/data", "-A", "trust", "-U", "mlflow"], check=True, **given)
        options = ["-h", "127.0.0.1", "-p", str(port), "-k", home, "-c", "fsync=off"]
        process = subprocess.Popen([server, "-D", f"{home}/data", *options], **given)
        try:
            end = time.monotonic() + 60
            while time.monotonic() < end:
                try:
                    socket.create_connection(("127.0.0.1", port), 1).close()
                    break
                except OSError:
                    time.sleep(0.2)
            yield f"postgresql+psycopg2://mlflow@127.0.0.1:{port}/postgres"
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(60)


def slurm_nodes() -> list[str]:
    """What this machine's Slurm has, one line a partition; none where there is no Slurm, or it does not answer."""
    if shutil.which("sinfo") is None:
        return []
    return subprocess.run(["sinfo", "--noheader", "--states=idle"], capture_output=True, text=True).stdout.splitlines()


@pytest.mark.served
@pytest.mark.parametrize("launcher", ["submitit_local", "submitit_slurm"])
def test_a_sweep_of_slurms_launcher_into_postgresql(launcher, postgresql, tmp_path, monkeypatch):
    """A job per point, or a process in its place where there is no Slurm, into one real PostgreSQL."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    if launcher == "submitit_slurm" and not slurm_nodes():
        pytest.skip("no Slurm with a free node here")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(PARENT_RUN, raising=False)
    monkeypatch.delenv(SWEPT, raising=False)
    client = mlflow_module().MlflowClient(postgresql)
    client.search_experiments()  # makes the tables
    given = ("hydra.launcher.cpus_per_task=1",) if launcher == "submitit_slurm" else ()
    swept(tmp_path, client, f"hydra/launcher={launcher}", *given, MLFLOW_TRACKING_URI=postgresql)
