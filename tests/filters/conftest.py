"""Filters without what they find out of their receiver."""

import math

import pytest

from dlkf.filters import fix_noise, position_errors


@pytest.fixture
def claimed(monkeypatch) -> None:
    """Fixes have the white noise that is claimed, whatever they show."""
    monkeypatch.setattr(fix_noise.FixNoise, "inflate_fix", lambda self, epoch: epoch)
    monkeypatch.setattr(position_errors, "LARGEST_SLOW", 0.0)
    monkeypatch.setattr(position_errors, "YOUNG_S", math.inf)
    monkeypatch.setattr(position_errors.PositionErrors, "noise", lambda self, epoch, std: std.new_ones(1, 4))
    monkeypatch.setattr(position_errors.PositionErrors, "add_slow_std", lambda self, std: std)
