"""Filters without what they find out of their receiver."""

import pytest

from dlkf.filters import position_errors


@pytest.fixture
def claimed(monkeypatch) -> None:
    """Positions have the white noise that is claimed, whatever the fixes show."""
    monkeypatch.setattr(position_errors, "WANDER", 0.0)
    monkeypatch.setattr(position_errors.PositionErrors, "noise", lambda self, epoch, std: std.new_ones(1, 4))
