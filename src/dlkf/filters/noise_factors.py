"""Factors on one epoch's noise from outside the Kalman filter: from a network, estimates, or tuning by gradient.

Everything is optional, and a factor of 1 changes nothing to the bit. Factors belong to standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class NoiseFactors(NamedTuple):
    """Of one epoch; None: as the filter itself has it."""

    process: Tensor | None = None  # (B, 4, 3) accelerometer and gyroscope noise, their walks; forward, right, down
    fix: Tensor | None = None  # (B, 4) position horizontal and down, velocity horizontal and down
    across: Tensor | None = None  # (B, 2) lateral and vertical constraint
    kept: Tensor | None = None  # (B, 2) share of the information of earlier positions and velocities that still counts

    @property
    def fix_std(self) -> Tensor | None:
        """(B, 6) the factors on a fix's components; horizontal ones are alike, so no direction is preferred."""
        return None if self.fix is None else self.fix[:, [0, 0, 1, 2, 2, 3]]
