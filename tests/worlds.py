"""What all rooms share: three small worlds, commands called as from a shell, an MLflow store made once.

What takes long to make is made by the first worker that asks for it (``once``) and read by all.

``town``: six exact drives of 60 s; ``noisy_town``: six segments with noise and biases, also as the batch ``cars``;
``simulated``: two drives as ``dlkf.simulate`` makes them. A room that means another of them by ``town`` says so in its
conftest.
"""

from __future__ import annotations

import fcntl
import filecmp
import importlib
import os
import pickle
import shutil
import sqlite3
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jaxtyping
import pytest
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository, IConfigRepository
from hydra._internal.defaults_list import DefaultsList, Overrides, create_defaults_list
from hydra._internal.hydra import Hydra
from hydra.core.default_element import ResultDefault
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, _utils

from dlkf.base.config import config_dir
from dlkf.base.points import SWEPT
from dlkf.command.composing import compose_command
from dlkf.data.drive import Batch
from dlkf.onboard import compiled_filter, library
from dlkf.tracking.endings import TRACKING_URI
from dlkf.tracking.grid import PARENT_RUN
from dlkf.tracking.runs import SQLITE, mlflow_module
from tests.cars import Tables, car, car_batch, write_cars, write_segments
from tests.conftest import FIRST_CASE, room
from tests.drives import drives_in
from tests.shell import Ended

SIZE = ("dataset.hours=0.05", "dataset.drive_minutes=1.5", "dataset.imu_rate_hz=50", "seed=3")
SHAPES_CHECKED = {"data", "filters", "navigation", "running", "simulation"}  # rooms of pure functions and of the loop
SHAPES_CHECKED_S = 0.03  # of a test: a filter run for thousands of epochs calls the same functions again and again
WITH_STORE = {"evaluate", "train", "tune"}  # commands that make an MLflow store where there is none, in seconds
CLOCK = pytest.StashKey[threading.Timer]()
SHIPPED_FLAGS = library.FLAGS  # of the compiler; rooms that only use a compiled filter need not wait for -O3


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Shapes are not checked in fixtures."""
    jaxtyping.config.update("jaxtyping_disable", True)
    compiled_filter.FLAGS = library.FLAGS = SHIPPED_FLAGS if room(item) == "onboard" else ("-O1", *SHIPPED_FLAGS[1:])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Shapes and types are checked where functions are tested one by one, at the beginning of the first case
    of every test: the others call the same functions with other numbers, and studies and commands by the thousand."""
    if room(item) in SHAPES_CHECKED and item.stash[FIRST_CASE]:
        jaxtyping.config.update("jaxtyping_disable", False)
        item.stash[CLOCK] = threading.Timer(SHAPES_CHECKED_S, jaxtyping.config.update, ("jaxtyping_disable", True))
        item.stash[CLOCK].start()


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """The clock of the shapes stops with its test."""
    if clock := item.stash.get(CLOCK, None):
        clock.cancel()
        clock.join()


@pytest.fixture(autouse=True)
def mlflow_as_found():
    """What MLflow and a grid search write into the environment ends with the test: a command that another test starts
    would take it for its own store or parent."""
    mine = (PARENT_RUN, SWEPT)
    before = {name: value for name, value in os.environ.items() if name.startswith("MLFLOW_") or name in mine}
    yield
    if mlflow := sys.modules.get("mlflow"):
        mlflow.set_tracking_uri(before.get(TRACKING_URI))
    for name in [name for name in os.environ if name.startswith("MLFLOW_") or name in mine]:
        del os.environ[name]
    os.environ.update(before)


@pytest.fixture(scope="session", autouse=True)
def presets_read_once():
    """Hydra reads the same files with every command, by a parser in Python."""
    read: dict[str, object] = {}
    loader = _utils.get_yaml_loader()

    class Reader(loader):
        def __init__(self, stream):
            self.text = stream if isinstance(stream, str) else stream.read()
            super().__init__(self.text)
            self.name = getattr(stream, "name", self.name)

        def get_single_data(self):
            if self.text not in read:
                read[self.text] = super().get_single_data()
            return read[self.text]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_utils, "get_yaml_loader", lambda: Reader)
        patch.setattr(ConfigRepository, "load_config", load_presets_once(ConfigRepository.load_config))
        patch.setattr(config_loader_impl, "create_defaults_list", list_presets_once())
        compose = ConfigLoaderImpl._compose_config_from_defaults_list
        patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", compose_presets_once(compose))
        yield


def are_shipped(repo: IConfigRepository) -> bool:
    """Whether all presets come from the package's files, which no test changes."""
    return {x.path for x in repo.get_sources() if x.scheme() == "file"} == {str(config_dir())}


def load_presets_once(load: Callable[..., ConfigResult | None]) -> Callable[..., ConfigResult | None]:
    """Each file of presets is made a configuration once."""
    made: dict[str, bytes] = {}  # a copy by pickle takes a sixth of the time of deepcopy

    def load_preset(self: ConfigRepository, config_path: str) -> ConfigResult | None:
        if not are_shipped(self):
            return load(self, config_path)
        if config_path not in made:
            made[config_path] = pickle.dumps(load(self, config_path))
        return pickle.loads(made[config_path])

    return load_preset


def list_presets_once() -> Callable[..., DefaultsList]:
    """Hydra's search for the presets of a command line, once for each choice of them: values decide none."""
    found: dict[tuple, DefaultsList] = {}

    def list_presets(repo: IConfigRepository, config_name: str, overrides_list: list[Override], **options: bool):
        if not are_shipped(repo):
            return create_defaults_list(repo, config_name, overrides_list, **options)
        values = Overrides(repo, overrides_list).config_overrides
        chosen = [x.input_line for x in overrides_list if x not in values]
        key = config_name, *chosen, *options.items()
        if key not in found:
            found[key] = create_defaults_list(repo, config_name, overrides_list, **options)
        return replace(found[key], config_overrides=values)

    return list_presets


def compose_presets_once(compose: Callable[..., DictConfig]) -> Callable[..., DictConfig]:
    """Each list of presets is merged once; what a command line sets in them goes into a copy."""
    made: dict[str, bytes] = {}

    def compose_presets(self: ConfigLoaderImpl, defaults: list[ResultDefault], repo: IConfigRepository) -> DictConfig:
        if not are_shipped(repo):
            return compose(self, defaults, repo)
        if (key := repr(defaults)) not in made:
            made[key] = pickle.dumps(compose(self, defaults, repo))
        return pickle.loads(made[key])

    return compose_presets


Once = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Once:
    """``once("town", make)`` gives a folder that ``make`` filled for the first worker to ask for that name."""
    base = tmp_path_factory.getbasetemp()
    home = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "once"
    home.mkdir(exist_ok=True)

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder, partial = home / name, home / f"{name}.partial"
        with (home / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir()
                make(partial)
                partial.rename(folder)
        return folder

    return made


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
    """Six segments of 60 s with noise and biases."""
    return car_batch(6, 60)


@pytest.fixture(scope="session")
def noisy_town(cars, tmp_path_factory) -> Path:
    """The six segments as a dataset in three groups."""
    return write_segments(tmp_path_factory.mktemp("data") / "town", cars)


@pytest.fixture(scope="session")
def simulated(once: Once) -> Path:
    """Two drives of 90 s in a town."""
    config = compose_command("simulate", "simulated@dataset=per_drive", "dataset.name=town", *SIZE)
    return once("simulated", lambda folder: drives_in(config, folder / "town")) / "town"


@pytest.fixture
def call(request, tmp_path, monkeypatch, capfd):
    """``call("evaluate", "model=ins", …)`` runs the command's main in an empty folder; where it will need an MLflow
    store (a test that is ``whole``), that is there, and gone again if the command was refused and wrote nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Hydra, "get_mode", lambda *_, **__: None)  # composes all once more, to find that none is set
    whole = request.node.get_closest_marker("whole") is not None

    def run(command: str, *arguments: object) -> Ended:
        main = importlib.import_module(f"dlkf.{command}").main
        store = Path("mlflow.db")
        if lent := whole and command in WITH_STORE and not store.exists():
            shutil.copy(empty := request.getfixturevalue("template"), store)
        monkeypatch.setattr(sys, "argv", [f"dlkf.{command}", *map(str, arguments)])
        capfd.readouterr()
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        if lent and code == 2 and filecmp.cmp(store, empty, shallow=False):
            store.unlink()
        out, err = capfd.readouterr()
        return Ended(code, out, err)

    return run


@pytest.fixture(scope="session")
def template(once: Once) -> Path:
    """A store without a run: MLflow takes seconds to make its tables, and SQLite waits for the disk at every commit."""
    from sqlalchemy import Engine, event

    @event.listens_for(Engine, "connect")
    def need_no_disk(connection, _):
        if isinstance(connection, sqlite3.Connection):
            connection.execute("PRAGMA synchronous = OFF")

    def make(folder: Path) -> None:
        mlflow_module().MlflowClient(f"{SQLITE}{folder / 'mlflow.db'}").search_experiments()

    return once("store", make) / "mlflow.db"


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
