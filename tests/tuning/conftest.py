"""Noise is tuned on segments with noise and biases."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def town(noisy_town: Path) -> Path:
    """The world of this room."""
    return noisy_town
