"""g-sensitivity of gyroscopes: the rate that they show of specific force, ω̃ = ω + G f + … (Groves 2013, 4.4).

An entry of G is of the order of 0.1 °/s/g for a consumer MEMS, 0.01 °/s/g for a good one. Those of the forward and the
right axis are estimated; the force of the down axis is nearly constant, so that its part is a bias. With the mean force
f̄ of an update interval, Φ has the columns of the gyroscopes' biases (ζ) times f̄,

    Φ_xG_cj = Φ_xζ_c f̄_j,    x = position, velocity, attitude; c = x, y, z; j = x, y
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from dlkf.filters.sources import Parameter, SensorSource
from dlkf.navigation.state import GYRO, PVA, ErrorStates

NAMES = tuple(f"g_sensitivity_{gyro}_{accel}" for gyro in "xyz" for accel in "xy")  # rad/s per m/s²


class GSensitivity(SensorSource):
    """``+g_sensitivity``: six entries of G, without rows of its own; fixes and constraints show G, as they show the
    gyroscopes' biases."""

    parameters: ClassVar[Mapping[str, Parameter]] = dict.fromkeys(NAMES, Parameter(std=1e-4, largest=2e-3))


def has_g_sensitivity(states: ErrorStates) -> bool:
    """Whether a filter has these states."""
    return NAMES[0] in states.others


def add_columns(
    Phi: Float[Tensor, "B n n"], corrected: Float[Tensor, "B M 6"], states: ErrorStates
) -> Float[Tensor, "B n n"]:
    """Φ of an update interval with the columns of G."""
    first = states.of(NAMES[0]).start
    force, Phi = corrected[..., :2].mean(1), Phi.clone()
    of_rate = Phi[:, PVA, GYRO].unsqueeze(-1) * force[:, None, None]
    Phi[:, PVA, first : first + len(NAMES)] = of_rate.flatten(2)
    return Phi


def select_matrix(parameters: Float[Tensor, "B k"], states: ErrorStates) -> Float[Tensor, "B 3 2"]:
    """G among the estimates of all sources."""
    first = states.of(NAMES[0]).start - states.of_others.start
    return parameters[:, first : first + len(NAMES)].unflatten(-1, (3, 2))
