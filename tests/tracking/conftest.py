"""A store made once and copied for every test (a fresh one costs seconds), a small model, two drives."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter
from dlkf.tracking.grid import PARENT_RUN, SWEPT
from dlkf.tracking.runs import SQLITE, mlflow_module
from tests.data.conftest import write_cars


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


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Path:
    """A filter as training saves it, untrained and small."""
    torch.manual_seed(0)
    small = {"cnn_channels": 4, "lstm_hidden": 8, "lstm_layers": 1, "dense": [8, 8]}
    folder = tmp_path_factory.mktemp("trained") / "best"
    save_filter(LearnedFilter(LearnedConfig.from_mapping({"network": small})), folder)
    return folder


@pytest.fixture(scope="session")
def cars(tmp_path_factory) -> Path:
    """Two drives of 30 s."""
    return write_cars(tmp_path_factory.mktemp("data") / "cars", 2, seconds=30.0)
