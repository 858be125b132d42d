"""Commands run on simulated drives."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def town(simulated: Path) -> Path:
    """The world of this room."""
    return simulated


@pytest.fixture
def copy(town, tmp_path) -> Path:
    """One that may be spoilt."""
    return Path(shutil.copytree(town, tmp_path / "town"))
