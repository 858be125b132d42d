"""The navigation state and its error state: names, slices, ⊞ and ⊖."""

from __future__ import annotations

from typing import NamedTuple

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


class NavState(NamedTuple):
    """Position [m], velocity [m/s] and attitude of the body in the tangent frame n."""

    p_n: Tensor  # (*b, 3)
    v_n: Tensor  # (*b, 3)
    C_nb: Tensor  # (*b, 3, 3)

    def corrected(self, dx: Float[Tensor, "*b 9"]) -> NavState:
        """State ⊞ dx: the closed-loop feedback, C ← exp([δh×]) C (checklist 2, closed loop)."""
        return NavState(
            self.p_n + dx[..., POSITION],
            self.v_n + dx[..., VELOCITY],
            rotation_from_vector(dx[..., ATTITUDE]) @ self.C_nb,
        )

    def error_to(self, truth: NavState) -> Float[Tensor, "*b 9"]:
        """truth ⊖ state: the 9-vector dx with ``state.corrected(dx) == truth``."""
        return torch.cat(
            (
                truth.p_n - self.p_n,
                truth.v_n - self.v_n,
                vector_from_rotation(truth.C_nb @ self.C_nb.mT),
            ),
            -1,
        )

    def detach(self) -> NavState:
        """The same state, cut from the graph."""
        return NavState(self.p_n.detach(), self.v_n.detach(), self.C_nb.detach())
