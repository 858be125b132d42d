"""What stands around the road and hides satellites: buildings on both sides, tunnels, bridges, garages.

Everything is a function of the distance driven, so a stationary car has the same sky, and the same road
sampled at another rate has the same buildings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Sky:
    """The sky that a receiver on the car has at each of N times.

    ``mask_left``, ``mask_right``: elevation [rad] up to which buildings hide the sky across the road, to the
    left and to the right of the course (right = course + 90°); along the road the sky is open.
    ``blocked``: no sky at all, as in a tunnel or a garage.
    """

    mask_left: Array
    mask_right: Array
    blocked: NDArray[np.bool_]


@dataclass(frozen=True)
class Surroundings(Ranged, where="surroundings", least=0, greatest=1e6):
    """Statistics of what stands along a road; the defaults are open country.

    A side of the road is a row of fronts, ``front_length`` [m] long on average (exponential): with
    probability ``built_share`` a building of log-normal height (median ``building_height`` [m], 40 %), whose
    face is ``building_distance`` [m] from the car (0.7 to 1.5 times), else open. Tunnels, or whatever else covers
    the road, are ``tunnel_length`` [m] long (uniform in 0.5 to 1.5 times) and leave ``tunnel_spacing`` [m] of
    open road in between (uniform in 0.5 to 1.5 times); 0 is none.
    """

    building_height: float = 0.0
    building_distance: float = bounded_field(15.0, 1, 1e6)
    front_length: float = bounded_field(25.0, 1, 1e6)
    built_share: float = bounded_field(0.8, 0, 1)
    tunnel_length: float = 0.0
    tunnel_spacing: float = bounded_field(1000.0, 1, 1e6)

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.tunnel_length < 5:
            raise InputError(f"surroundings: tunnel_length {self.tunnel_length} m is below 5 m (0 is none)")


def sky_along(rng: np.random.Generator, surroundings: Surroundings, distance: Array) -> Sky:
    """The sky at distances (N,) [m] along a road with random surroundings; what lies before its start is its start."""
    distance = np.maximum(distance, 0.0)
    left_rng, right_rng, tunnel_rng = rng.spawn(3)
    return Sky(
        _mask(left_rng, surroundings, distance),
        _mask(right_rng, surroundings, distance),
        _is_covered(tunnel_rng, surroundings, distance),
    )


def _mask(rng: np.random.Generator, surroundings: Surroundings, distance: Array) -> Array:
    """Elevation of the house fronts on one side, atan(height / distance to the face) [rad]."""
    if surroundings.building_height == 0:
        return np.zeros_like(distance)
    fronts = distance.max() / surroundings.front_length
    count = 2 + int(fronts + 10 * fronts**0.5)  # ten sigma more than it takes
    ends = np.cumsum(surroundings.front_length * rng.standard_exponential(count))
    height = surroundings.building_height * np.exp(0.4 * rng.standard_normal(count))
    height[rng.random(count) >= surroundings.built_share] = 0.0
    away = surroundings.building_distance * rng.uniform(0.7, 1.5, count)
    front = np.minimum(np.searchsorted(ends, distance, side="right"), count - 1)
    return np.arctan2(height, away)[front]


def _is_covered(rng: np.random.Generator, surroundings: Surroundings, distance: Array) -> NDArray[np.bool_]:
    """Whether the road is covered: open and covered stretches in turn, the first one open."""
    if surroundings.tunnel_length == 0:
        return np.zeros(distance.shape, dtype=bool)
    mean = np.array((surroundings.tunnel_spacing, surroundings.tunnel_length))
    count = 1 + int(2 * distance.max() / mean.sum())
    ends = np.cumsum(mean * rng.uniform(0.5, 1.5, (count, 2)))
    return np.searchsorted(ends, distance, side="right") % 2 == 1


def in_view(sky: Sky, course: Array, elevation: Array, azimuth: Array) -> NDArray[np.bool_]:
    """Satellites (T, S) that nothing along the road hides; course (T,), elevation and azimuth (T, S) [rad].

    Buildings are walls along the road: one of elevation m straight across hides what is below the plane through
    its upper edge, tan(elevation) < tan(m) |sin(azimuth − course)|, so the sky is open ahead and behind.
    """
    across = np.sin(azimuth - course[:, None])
    wall = np.where(across > 0, np.tan(sky.mask_right)[:, None], np.tan(sky.mask_left)[:, None])
    return (np.tan(elevation) >= wall * np.abs(across)) & ~sky.blocked[:, None]


def hold_visibility(condition: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """Where ``condition`` (T, …) is true and has been for the ``rows`` rows before; before the first it is taken to be.

    A receiver tracks a satellite again only some time after it has come back into view.
    """
    row = np.arange(len(condition)).reshape(-1, *(1,) * (condition.ndim - 1))
    broken = np.maximum.accumulate(np.where(condition, -rows - 1, row), axis=0)
    return row - broken > rows
