"""A small model and two drives."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.saved import save_filter
from tests.cars import write_cars


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
