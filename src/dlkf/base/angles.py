"""Angles on a circle."""

from __future__ import annotations

from typing import Any

import numpy as np


def wrap_angle(angle: Any, half: float = np.pi) -> Any:
    """The same angle from −half a turn up to it, in the unit of ``half``."""
    return (angle + half) % (2 * half) - half


def circular_median(angle: np.ndarray) -> tuple[float, np.ndarray]:
    """Median of angles [rad], from −π to π, and how far they are from it."""
    mean = float(np.angle(np.exp(1j * angle).mean()))
    around = wrap_angle(angle - mean)
    middle = float(np.median(around))
    return wrap_angle(mean + middle), around - middle
