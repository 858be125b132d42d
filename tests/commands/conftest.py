"""Commands run on simulated drives."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def town(simulated: Path) -> Path:
    """The world of this room."""
    return simulated
