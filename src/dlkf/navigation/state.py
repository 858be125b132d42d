"""The navigation state and its error state: names, slices, ⊞ and ⊖."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.attitude import rotation_from_vector, vector_from_rotation

POSITION = slice(0, 3)
VELOCITY = slice(3, 6)
ATTITUDE = slice(6, 9)
ACCEL = slice(9, 12)
GYRO = slice(12, 15)
PVA = slice(0, 9)
PV = slice(0, 6)
IMU = slice(9, 15)
STATES = 15
MATRICES = ("none", "scale", "full")
STRUCTURE = ("mounting_yaw", "mounting_pitch", "rear_axle", "sideslip", "pitch_gradient")


@dataclass(frozen=True)
class ErrorStates:
    """Error states of a filter: the 15 above, then those of the sensor matrices, then those of the car.

    ``matrix`` of M in measured = (I + M) true + bias: ``none`` (15 states), ``scale`` its diagonal (21), ``full``
    also the misalignments (33). Columns 15… hold the accelerometers' elements, then the gyroscopes', each the
    diagonal first, then row by row. ``structure`` adds the five of :data:`STRUCTURE`
    (:mod:`dlkf.filters.constraints`), ``others`` at the end those of further sensors by name
    (:class:`dlkf.filters.sources.Parameter`).

    ``position``, ``velocity``, ``attitude``, ``accel``, ``gyro`` and ``of(name)`` are the places of states, so that a
    measurement's H is written as ``H[..., states.velocity] = …``.
    """

    matrix: str = "none"
    structure: bool = False
    others: tuple[str, ...] = ()

    position: ClassVar[slice] = POSITION
    velocity: ClassVar[slice] = VELOCITY
    attitude: ClassVar[slice] = ATTITUDE
    accel: ClassVar[slice] = ACCEL
    gyro: ClassVar[slice] = GYRO

    def __post_init__(self) -> None:
        if self.matrix not in MATRICES:
            raise ValueError(f"matrix {self.matrix!r} is none of {MATRICES}")
        if len(set(self.others)) < len(self.others) or set(self.others) & set(STRUCTURE):
            raise ValueError(f"names of states stand twice: {', '.join(self.others)}")

    def of(self, name: str) -> slice:
        """The state of the car or of a further sensor by its name; KeyError if the filter has none."""
        named = (*(STRUCTURE if self.structure else ()), *self.others)
        if name not in named:
            raise KeyError(f"this filter has no state {name!r}, but {', '.join(named) or 'none of a car or a sensor'}")
        first = self.navigation + named.index(name)
        return slice(first, first + 1)

    @property
    def base(self) -> ErrorStates:
        """Without those of further sensors."""
        return replace(self, others=())

    @property
    def elements(self) -> tuple[tuple[int, int], ...]:
        """(row, column) of the estimated elements of a sensor's M, in the order of their states."""
        diagonal = tuple((i, i) for i in range(3)) if self.matrix != "none" else ()
        others = tuple((i, j) for i in range(3) for j in range(3) if i != j) if self.matrix == "full" else ()
        return diagonal + others

    @property
    def navigation(self) -> int:
        """Number of states without those of the car and of further sensors."""
        return STATES + 2 * len(self.elements)

    @property
    def imu(self) -> int:
        """Number of states of the IMU error: biases and sensor matrices."""
        return self.navigation - PVA.stop

    @property
    def count(self) -> int:
        """Number of states."""
        return self.of_structure.stop + len(self.others)

    @property
    def of_matrix(self) -> slice:
        """The states of both sensor matrices."""
        return slice(STATES, self.navigation)

    @property
    def of_structure(self) -> slice:
        """The states of the car."""
        return slice(self.navigation, self.navigation + (len(STRUCTURE) if self.structure else 0))

    @property
    def of_others(self) -> slice:
        """The states of further sensors."""
        return slice(self.of_structure.stop, self.count)


class NavState(NamedTuple):
    """Position [m], velocity [m/s] and attitude of the body in the tangent frame n."""

    p_n: Tensor  # (*b, 3)
    v_n: Tensor  # (*b, 3)
    C_nb: Tensor  # (*b, 3, 3)

    def correct(self, dx: Float[Tensor, "*b 9"]) -> NavState:
        """State ⊞ dx: the closed-loop feedback, C ← exp([δh×]) C (paper.md 2)."""
        return NavState(
            self.p_n + dx[..., POSITION],
            self.v_n + dx[..., VELOCITY],
            rotation_from_vector(dx[..., ATTITUDE]) @ self.C_nb,
        )

    def error_to(self, truth: NavState) -> Float[Tensor, "*b 9"]:
        """truth ⊖ state: the 9-vector dx with ``state.correct(dx) == truth``."""
        return torch.cat(
            (truth.p_n - self.p_n, truth.v_n - self.v_n, vector_from_rotation(truth.C_nb @ self.C_nb.mT)), -1
        )

    def detach(self) -> NavState:
        """The same state, cut from the graph."""
        return NavState(self.p_n.detach(), self.v_n.detach(), self.C_nb.detach())
