"""Models: logged without a pickle, fetched by run, version or alias, run as a pyfunc."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from omegaconf import OmegaConf

import dlkf
from dlkf.base.errors import InputError
from dlkf.data.rows import example_drive
from dlkf.data.schema import drive_file
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import load_filter, save_filter
from dlkf.tracking.comparison import choose_best
from dlkf.tracking.grid import PARENT_RUN, GridParent
from dlkf.tracking.registry import REQUIRED, check_registration, download_model, log_model, register_model
from dlkf.tracking.runs import mlflow_module, start_run
from tests.cars import write_cars
from tests.docs.pages import ROOT
from tests.shell import PATIENCE_S

TRAINING_PAGE = ROOT / "docs" / "training.md"


@pytest.fixture
def logged(uri, weights):
    """A finished run with a registered model; the folder it was logged from is gone."""
    folder = shutil.copytree(weights, "best")
    with start_run(uri, "town", "one") as run:
        run.log_dataset("data/town", "0123", "training")
        run.log_metrics({"train/loss": 3.0}, step=0)
        log_model(run, folder, register="town", alias="champion", metrics={"test/dlkf/rms_m": 2.5})
    shutil.rmtree(folder)
    return run


def same_weights(folder, weights) -> bool:
    one, other = load_filter(folder).state_dict(), load_filter(weights).state_dict()
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def test_every_name_of_a_model_leads_to_its_weights(logged, uri, weights):
    for spec in (
        logged.id,
        f"runs:/{logged.id}",
        f"runs:/{logged.id}/model",
        "models:/town@champion",
        "models:/town/1",
        "models:/town/latest",
        "models:/town",
    ):
        assert same_weights(download_model(spec, uri), weights), spec
    assert same_weights(download_model(logged.id), weights), "the store of this folder by default"


def test_the_model_stands_with_its_scores_and_data(logged, client):
    run = client.get_run(logged.id)
    (model,) = client.search_logged_models([run.info.experiment_id])
    assert [(m.key, m.value, m.dataset_name) for m in model.metrics] == [("test/dlkf/rms_m", 2.5, "town")]
    assert run.data.metrics == {"train/loss": 3.0, "test/dlkf/rms_m": 2.5}
    assert len(client.get_metric_history(logged.id, "test/dlkf/rms_m")) == 1


def test_an_alias_moves_to_the_newer_version(logged, uri, client, weights):
    with start_run(uri, "town", "two") as run:
        model_uri = log_model(run, weights, register="town", alias="champion")
    assert client.get_model_version_by_alias("town", "champion").version in (2, "2")
    assert same_weights(download_model(model_uri, uri), weights)
    with start_run(uri, "village", "three") as run:
        log_model(run, weights, alias="candidate")  # registered under the experiment's name
    assert same_weights(download_model("models:/village@candidate", uri), weights)


def test_the_pyfunc_gives_what_navigate_gives(logged, uri, weights, cars):
    """Same rows from the first fix on, to the rounding of drives that run together. Folders and a table of the drives
    mean the same."""
    mlflow = mlflow_module()
    mlflow.set_tracking_uri(uri)
    model = mlflow.pyfunc.load_model("models:/town@champion")
    (call,) = re.findall(r"mlflow\.pyfunc\.load_model\(.*?\)\.predict\(.*?\)", TRAINING_PAGE.read_text())
    given = eval(call.replace("outage@", "town@").replace("data/town", str(cars)))
    pd.testing.assert_frame_equal(given, model.predict(pd.DataFrame({"dataset": [str(cars)]})))
    wanted = {f"car-{k}": navigate_car(cars, f"car-{k}", weights) for k in range(2)}
    assert set(given.drive) == set(wanted) and set(given.dataset) == {str(cars)}
    for drive, rows in given.groupby("drive"):
        pd.testing.assert_frame_equal(
            rows.drop(columns=["dataset", "drive"]).reset_index(drop=True), wanted[drive], rtol=1e-9, atol=1e-9
        )
    table = pd.concat(
        pd.read_parquet(drive_file(cars, kind, drive), partitioning=None).assign(drive=drive)
        for drive in wanted
        for kind in ("imu", "gnss")
    )
    pd.testing.assert_frame_equal(model.predict(table), given.drop(columns="dataset"), check_exact=True)
    example = model.predict(model.input_example)
    assert set(example.drive) == {"example"} and np.isfinite(example.vel_n).all() and len(example) >= 8
    with pytest.raises(Exception, match="lacks accel_x"):
        model.predict(table.drop(columns="accel_x"))


def navigate_car(folder, drive, model) -> pd.DataFrame:
    """What ``dlkf.navigate`` makes of the tables of a drive."""
    kinds = [kind for kind in ("imu", "gnss", "speed", "heading", "baro") if (folder / kind).is_dir()]
    tables = {k: pd.read_parquet(drive_file(folder, k, drive), partitioning=None) for k in kinds}
    return pd.DataFrame(dlkf.navigate(tables.pop("imu"), tables.pop("gnss"), model=model, **tables))


def test_the_pyfunc_takes_the_sensors_of_a_folder(call, uri, tmp_path):
    """``plus`` with wheel speed, heading and barometer, as ``navigate`` takes them, on fixes 4 s apart."""
    assert call("register", "model=plus", "name=plus", f"tracking.uri={uri}").code == 0
    mlflow = mlflow_module()
    mlflow.set_tracking_uri(uri)
    folder = write_cars(tmp_path / "wheels", aids={}, seconds=40.0, gnss_hz=0.25)
    given = mlflow.pyfunc.load_model("models:/plus/1").predict({"dataset": [str(folder)]})
    assert given["speed_used"].sum() > 5 and given["heading_used"].sum() > 5 and given["baro_used"].sum() > 5
    wanted = navigate_car(folder, "car-0", "plus")
    pd.testing.assert_frame_equal(given.drop(columns=["dataset", "drive"]), wanted, check_exact=True)


def test_the_filter_that_comes_along_is_registered_with_its_card(uri, call):
    """``model=plus``: a run of its own, a version with card, signature and example, and the same solution from it."""
    done = call("register", "model=plus", "name=plus", "alias=champion", f"tracking.uri={uri}")
    assert done.code == 0 and "models:/plus@champion" in done.out, done.err
    mlflow = mlflow_module()
    mlflow.set_tracking_uri(uri)
    assert "65 h of simulated drives" in mlflow.MlflowClient(uri).get_model_version("plus", "1").description
    model = mlflow.pyfunc.load_model("models:/plus@champion")
    answer = model.predict(model.input_example)
    assert len(answer) >= 8 and np.isfinite(answer.vel_n).all()
    assert call("register", "model=nobody", "name=plus", f"tracking.uri={uri}").code == 2
    assert call("register", "model=plus", "run=" + "0" * 32, "name=plus").code == 2


@pytest.mark.served
@pytest.mark.parametrize("name", ["town", "plus"])
def test_it_is_served_and_called_over_http(name, logged, uri, call):
    """``mlflow models serve`` in the environment at hand: a table of a drive as JSON, its solution comes back."""
    if name == "plus":
        assert call("register", "model=plus", "name=plus", "alias=champion", f"tracking.uri={uri}").code == 0
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "mlflow", "models", "serve", "-m", f"models:/{name}@champion", "-p", str(port)]
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))  # MLflow calls uvicorn by name
    environment = {**os.environ, "MLFLOW_TRACKING_URI": uri, "OMP_NUM_THREADS": "1", "PATH": path}
    server = subprocess.Popen([*command, "--env-manager", "local"], env=environment, start_new_session=True)
    try:
        end = time.monotonic() + PATIENCE_S
        while server.poll() is None and time.monotonic() < end:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/ping", timeout=2)
                break
            except OSError:
                time.sleep(0.5)
        body = {"dataframe_split": json.loads(example_drive().to_json(orient="split", index=False))}
        body["params"] = {"lever_arm_x_m": 0.0}
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/invocations", json.dumps(body).encode(), {"Content-Type": "application/json"}
        )
        answer = pd.DataFrame(json.load(urllib.request.urlopen(request, timeout=PATIENCE_S))["predictions"])
    finally:
        os.killpg(server.pid, signal.SIGTERM)
        server.wait(PATIENCE_S)
    assert set(answer.drive) == {"example"} and len(answer) >= 8
    mlflow = mlflow_module()
    mlflow.set_tracking_uri(uri)
    here = mlflow.pyfunc.load_model(f"models:/{name}@champion").predict(example_drive())
    assert np.allclose(answer[["lat_deg", "vel_n"]].astype(float), here[["lat_deg", "vel_n"]], atol=1e-9)


# Nothing but what a logged model's requirements bring, with what those require themselves, can be imported after this.
ONLY_REQUIRED = f"""
import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from packaging.requirements import Requirement
there, wanted = set(), {list(REQUIRED)!r}
while wanted:
    name = wanted.pop().lower().replace("_", "-").replace(".", "-")
    if name in there:
        continue
    try:
        needs = [Requirement(text) for text in requires(name) or ()]
    except PackageNotFoundError:
        continue
    there.add(name)
    wanted += [need.name for need in needs if need.marker is None or need.marker.evaluate({{"extra": ""}})]
foreign = {{
    module
    for module, brought_by in packages_distributions().items()
    if not {{d.lower().replace("_", "-").replace(".", "-") for d in brought_by}} & there
}} - {{"dlkf"}}
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in foreign:
            raise ModuleNotFoundError(f"No module named {{name!r}}: no requirement of the model brings it")
sys.meta_path.insert(0, Refuse())
assert {{"rich", "hydra", "lightning"}} <= foreign and "torch" not in foreign
"""


def test_a_network_of_one_s_own_comes_with_its_model(uri, client, cars, tmp_path, monkeypatch):
    """Also what its module imports; elsewhere, where the modules are not on the path, the model still loads."""
    mine = tmp_path / "mine"
    (mine / "parts").mkdir(parents=True)
    (mine / "parts" / "sizes.py").write_text("WIDTH = 4\n")
    (mine / "mean_network.py").write_text(
        "import torch\nfrom torch import nn\nfrom parts.sizes import WIDTH\n\n\nclass Mean(nn.Module):\n"
        "    width = WIDTH\n\n    def start(self, batch_size, like):\n        return ()\n\n"
        "    def forward(self, window, components, memory):\n        return components[:, :WIDTH], memory\n"
    )
    names, config = ("mean_network", "parts", "parts.sizes"), {"network": {"_target_": "mean_network.Mean"}}
    with monkeypatch.context() as here:
        here.syspath_prepend(str(mine))
        save_filter(LearnedFilter(LearnedConfig.from_mapping(config)), tmp_path / "best")
        with start_run(uri, "town", "one") as run:
            run.log_config({"model": config})
            log_model(run, tmp_path / "best", register="town", alias="champion")
        for name in names:
            del sys.modules[name]
    assert [a.path for a in client.list_artifacts(run.id, "code")] == ["code/mean_network.py", "code/parts"]
    shutil.rmtree(mine)
    mlflow = mlflow_module()
    mlflow.set_tracking_uri(uri)
    before = list(sys.path)
    monkeypatch.setattr(sys, "path", list(before))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    answer = mlflow.pyfunc.load_model("models:/town@champion").predict({"dataset": [str(cars)]})
    assert len(answer) > 20 and np.isfinite(answer.vel_n).all()
    for name in names:
        del sys.modules[name]
    monkeypatch.setattr(sys, "path", list(before))
    with pytest.raises(InputError, match="No module named 'mean_network'"):
        load_filter(tmp_path / "best")
    again = navigate_car(cars, "car-0", "models:/town@champion")
    one = answer[answer.drive == "car-0"].drop(columns=["dataset", "drive"])
    pd.testing.assert_frame_equal(again, one, rtol=1e-9, atol=1e-9)
    assert sys.path[: len(before)] == before, "what is installed comes first"
    for name in names:
        del sys.modules[name]


@pytest.mark.commands
def test_a_logged_model_brings_its_code_and_no_pickle(logged, uri, cars):
    """Loaded in an interpreter where pickles are refused and its requirements alone can be imported."""
    folder = download_model("models:/town/1", uri).parents[1]
    assert not [p for p in folder.rglob("*") if p.suffix in (".pkl", ".pickle", ".pt", ".ckpt", ".pyc")]
    requirements = (folder / "requirements.txt").read_text().split()
    assert all("==" in line and "+" not in line for line in requirements) and len(requirements) == 10
    program = (
        f"{ONLY_REQUIRED}import sys, mlflow, pandas\n"
        "from mlflow.environment_variables import MLFLOW_ALLOW_PICKLE_DESERIALIZATION as allowed\n"
        "assert not allowed.get()\n"
        f"model = mlflow.pyfunc.load_model({str(folder)!r})\n"
        f"assert len(model.predict(pandas.DataFrame({{'dataset': [{str(cars)!r}]}}))) > 20\n"
        "import dlkf\n"
        f"assert dlkf.__file__.startswith({str(folder)!r}), dlkf.__file__\n"
        "assert not {'hydra', 'lightning', 'omegaconf'} & set(sys.modules)\n"
        "dlkf.Stream('mbkf15', imu_type='consumer')\n"  # its presets came along
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env={"MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false", "OMP_NUM_THREADS": "1", "PATH": ""},
    )
    assert done.returncode == 0, done.stderr


def test_unknown_models_are_refused_in_one_line(logged, uri):
    for spec, says in {
        "0" * 32: "has no run",
        "runs:/nonsense": "has no run",
        "models:/city@champion": r"has no model 'city'; known: town",
        "models:/town@old": r"no alias 'old'; known: champion \(version 1\)",
        "models:/town/7": "no version 7; known: 1",
        "models:/town/champion": "malformed",
        "models:/m-" + "0" * 32: "has no model",
    }.items():
        with pytest.raises(InputError, match=says) as error:
            download_model(spec, uri)
        assert "\n" not in str(error.value), spec


def test_runs_without_a_model(uri, client):
    with pytest.raises(ValueError), start_run(uri, "town", "one") as run:
        raise ValueError
    with pytest.raises(InputError, match=r"logged no model.*FAILED"):
        download_model(run.id, uri)
    with start_run(uri, "town", "child", parent_run_id=run.id):
        pass
    with pytest.raises(InputError, match="parent run of a grid search"):
        download_model(run.id, uri)


def test_no_store_is_made_by_looking_for_a_model(tmp_path, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no MLflow store"):
        download_model("models:/town@champion")
    assert list(tmp_path.iterdir()) == []


def test_lost_files_are_said(logged, uri, tmp_path):
    shutil.rmtree(tmp_path / "mlruns")
    with pytest.raises(InputError, match="cannot be read") as error:
        download_model(logged.id, uri)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "alias"), [("a/b", None), ("a", "latest"), ("a", "v2"), ("a", "no way")])
def test_names_the_registry_would_refuse(name, alias):
    with pytest.raises(InputError):
        check_registration(name, alias)
    check_registration("town", "champion")
    check_registration(None, None)


@pytest.mark.commands
def test_a_store_that_was_moved_says_so(logged, uri, weights, tmp_path):
    """It names absolute places; a new run would write to where it was."""
    old, new = tmp_path / "here", tmp_path / "there"
    old.mkdir()
    with start_run(f"sqlite:///{old}/mlflow.db", "town", "one") as run:
        log_model(run, weights, register="town")
    old.rename(new)
    there = f"sqlite:///{new}/mlflow.db"
    with pytest.raises(InputError, match="move its folder back"):
        download_model("models:/town/1", there)
    with pytest.raises(InputError, match="move the folder back"), start_run(there, "town", "two"):
        pass
    assert not old.exists()
    new.rename(old)
    assert same_weights(download_model("models:/town/1", f"sqlite:///{old}/mlflow.db"), weights)


def test_the_best_of_a_grid_is_registered_at_its_end(uri, client, weights, capsys):
    """Not the last: the one with the least validation error."""
    grid = GridParent()
    config = {"name": "town", "tracking": {"uri": uri, "alias": "champion"}}
    hydra = {"overrides": {"task": ["seed=0,1,2"]}, "sweeper": {"params": None}}
    grid.on_multirun_start(OmegaConf.create(config | {"hydra": hydra}))
    parent, ids = os.environ[PARENT_RUN], []
    for rms in (5.0, 2.0, 3.0):
        with start_run(uri, "town", f"rms {rms}", parent_run_id=parent) as run:
            run.log_metrics({"val/outage_end_m": rms})
            log_model(run, weights)
        ids.append(run.id)
    grid.on_multirun_end(OmegaConf.create())
    assert client.get_model_version_by_alias("town", "champion").run_id == ids[1]
    assert "Registered the best, rms 2.0: models:/town/1" in capsys.readouterr().out
    assert choose_best(client, parent).info.run_id == ids[1] and choose_best(client, ids[2]).info.run_id == ids[2]
    version = client.get_model_version("town", register_model(client, ids[0], "town"))
    assert version.run_id == ids[0] and "rms 5.0" in version.description


@pytest.mark.parametrize("alias", ["latest", "v3", "a b"])
def test_a_grid_with_a_bad_alias_does_not_start(uri, alias, capsys):
    config = {"name": "town", "tracking": {"uri": uri, "alias": alias}}
    hydra = {"overrides": {"task": ["seed=0,1"]}, "sweeper": {"params": None}}
    with pytest.raises(SystemExit) as end:
        GridParent().on_multirun_start(OmegaConf.create(config | {"hydra": hydra}))
    assert end.value.code == 2 and capsys.readouterr().err.count("\n") == 1
