"""Which satellites buildings, tunnels and the horizon leave to a receiver, and for how long it has had them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlkf.simulation.gnss.surroundings import Sky

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]


def in_view(sky: Sky, course: Array, elevation: Array, azimuth: Array) -> Mask:
    """Satellites (T, S) that nothing along the road hides; course (T,), elevation and azimuth (T, S) [rad].

    Buildings are walls along the road: one of elevation m straight across hides what is below the plane through
    its upper edge, tan(elevation) < tan(m) |sin(azimuth − course)|, so the sky is open ahead and behind.
    """
    across = np.sin(azimuth - course[:, None])
    wall = np.where(across > 0, np.tan(sky.mask_right)[:, None], np.tan(sky.mask_left)[:, None])
    return (np.tan(elevation) >= wall * np.abs(across)) & ~sky.blocked[:, None]


def hold_visibility(condition: Mask, rows: int) -> Mask:
    """Where ``condition`` (T, …) is true and has been for the ``rows`` rows before; before the first it is taken to be.

    A receiver tracks a satellite again only some time after it has come back into view.
    """
    row = np.arange(len(condition)).reshape(-1, *(1,) * (condition.ndim - 1))
    broken = np.maximum.accumulate(np.where(condition, -rows - 1, row), axis=0)
    return row - broken > rows
