"""What all rooms share: three small worlds, commands called as from a shell, an MLflow store made once.

``town``: six exact drives of 60 s; ``noisy_town``: six pieces with noise and biases, also as the batch ``cars``;
``simulated``: two drives as ``dlkf.simulate`` makes them. A room that means another of them by ``town`` says so in its
conftest.
"""

from __future__ import annotations

import importlib
import shutil
import sys
from pathlib import Path

import jaxtyping
import pytest

from dlkf.command.composing import composed
from dlkf.data.drive import Batch
from dlkf.points import SWEPT
from dlkf.tracking.grid import PARENT_RUN
from dlkf.tracking.runs import SQLITE, mlflow_module
from tests.cars import Tables, car, car_batch, write_cars, write_pieces
from tests.drives import drives_in
from tests.shell import Ended

SIZE = ("dataset.hours=0.05", "dataset.drive_minutes=1.5", "dataset.imu_rate_hz=50", "seed=3")


SHAPES_CHECKED = {"data", "filters", "navigation", "running", "simulation"}  # rooms of pure functions and of the loop


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Shapes and types are checked where functions are tested one by one; studies and commands, which call the same
    functions by the thousand, run as a user's do, in half of the time."""
    room = item.path.relative_to(Path(__file__).parent).parts[0]
    jaxtyping.config.update("jaxtyping_disable", room not in SHAPES_CHECKED)


@pytest.fixture
def without_shape_checks(monkeypatch):
    """For a test that runs a filter for thousands of epochs."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(scope="session")
def tables() -> Tables:
    """One minute of the exact car."""
    return car()


@pytest.fixture(scope="session")
def town(tmp_path_factory) -> Path:
    """Six exact drives of 60 s in six groups."""
    return write_cars(tmp_path_factory.mktemp("data") / "town", 6)


@pytest.fixture(scope="session")
def cars() -> Batch:
    """Six pieces of 60 s with noise and biases."""
    return car_batch(6, 60)


@pytest.fixture(scope="session")
def noisy_town(cars, tmp_path_factory) -> Path:
    """The six pieces as a dataset in three groups."""
    return write_pieces(tmp_path_factory.mktemp("data") / "town", cars)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Path:
    """Two drives of 90 s in a town."""
    config = composed("simulate", "simulated@dataset=per_drive", "dataset.name=town", *SIZE)
    return drives_in(config, tmp_path_factory.mktemp("data") / "town")


@pytest.fixture
def call(tmp_path, monkeypatch, capfd):
    """``call("evaluate", "model=ins", …)`` runs the command's main in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(command: str, *arguments: object) -> Ended:
        main = importlib.import_module(f"dlkf.{command}").main
        monkeypatch.setattr(sys, "argv", [f"dlkf.{command}", *map(str, arguments)])
        capfd.readouterr()
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        out, err = capfd.readouterr()
        return Ended(code, out, err)

    return run


@pytest.fixture(scope="session")
def template(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("store") / "mlflow.db"
    mlflow_module().MlflowClient(SQLITE + str(path)).search_experiments()
    return path


@pytest.fixture
def uri(template, tmp_path, monkeypatch) -> str:
    """An empty store in the working folder of the test."""
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_RUN_ID", PARENT_RUN, SWEPT):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    shutil.copy(template, tmp_path / "mlflow.db")
    return SQLITE + str(tmp_path / "mlflow.db")


@pytest.fixture
def client(uri):
    return mlflow_module().MlflowClient(uri)
