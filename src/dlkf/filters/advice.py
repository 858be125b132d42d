"""What is said of one epoch's noise from outside the Kalman filter: factors, offsets and a forward speed.

Everything is optional, and neutral values change nothing to the bit: a factor of 1, an offset of 0, a speed whose
standard deviation is beyond :data:`ABSENT`. Factors belong to standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

ABSENT = 30.0  # m/s: a speed that is no better known than this is not used


class Advice(NamedTuple):
    """Of one epoch; None: as the filter itself has it."""

    process: Tensor | None = None  # (B, 4, 3) accelerometer and gyroscope noise, their walks; forward, right, down
    fix: Tensor | None = None  # (B, 4) position horizontal and down, velocity horizontal and down
    across: Tensor | None = None  # (B, 2) lateral and vertical constraint
    offset: Tensor | None = None  # (B, 2) m/s, velocity to the right and down that the car has beside its model's
    speed: Tensor | None = None  # (B, 2) m/s, forward speed and its standard deviation

    @property
    def fix_std(self) -> Tensor | None:
        """(B, 6) the factors on a fix's components; horizontal ones are alike, so no direction is preferred."""
        return None if self.fix is None else self.fix[:, [0, 0, 1, 2, 2, 3]]
