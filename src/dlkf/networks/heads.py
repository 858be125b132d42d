"""Output layers (R048): a 9×6 Kalman gain and a six-axis IMU error, both in physical size.

Heads start near zero around a usable filter (paper.md 4.10 G0, 4.11 E0): position and velocity gain on the
diagonal, IMU error 0 or what is known of it. Unscaled random heads would end in the blow-up that the paper describes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.navigation.calibration import ImuError

STATE_SIZE = (1.0,) * 3 + (0.3,) * 3 + (0.02,) * 3  # m, m/s, rad
INNOVATION_SIZE = (1.0,) * 3 + (0.3,) * 3  # m, m/s
IMU_ERROR_SIZE = (0.1,) * 3 + (0.3 * torch.pi / 180,) * 3  # m/s², rad/s
MATRIX_SIZE = 0.01  # scale factors and misalignments
Form = Literal["constant", "affine"]
_SHRINK = 0.01


class GainHead(nn.Module):
    """K = S_x · reshape(W h + b) · S_z⁻¹ (G0, the paper's free gain)."""

    scale: Tensor

    def __init__(self, width: int, initial_gain: float) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 54)
        scale = torch.tensor(STATE_SIZE)[:, None] / torch.tensor(INNOVATION_SIZE)[None, :]
        self.register_buffer("scale", scale, persistent=False)
        with torch.no_grad():
            self.linear.weight.mul_(_SHRINK)
            self.linear.bias.copy_((initial_gain * torch.eye(9, 6)).flatten())

    def forward(self, h: Float[Tensor, "B D"]) -> Float[Tensor, "B 9 6"]:
        """Gain in the feature axes."""
        return self.linear(h).unflatten(-1, (9, 6)) * self.scale


class ImuErrorHead(nn.Module):
    """ê = σ ⊙ (W h + b): accelerometer [m/s²] and gyroscope [rad/s] error in body axes.

    ``constant`` gives six numbers, in force for the whole epoch (E0, the paper's). ``affine`` gives with them the
    matrices M of measured = (I + M) true + bias of both sensors (E4), so that one answer a second follows the motion
    at the rate of the samples. ``bound`` limits the bias to so many σ by bound · tanh(· / bound); 0 is no limit.
    """

    scale: Tensor

    def __init__(self, width: int, form: str, bound: float) -> None:
        super().__init__()
        self.form, self.bound = form, bound
        self.linear = nn.Linear(width, 6 if form == "constant" else 24)
        self.register_buffer("scale", torch.tensor(IMU_ERROR_SIZE), persistent=False)
        with torch.no_grad():
            self.linear.weight.mul_(_SHRINK)
            self.linear.bias.zero_()

    def start_at(self, error: Sequence[float]) -> None:
        """Start from a known mean error (m/s² x 3, rad/s x 3), such as that of the training drives."""
        x = torch.tensor(error, dtype=self.scale.dtype) / self.scale.cpu()
        if self.bound:
            x = self.bound * torch.atanh((x / self.bound).clamp(-0.95, 0.95))
        with torch.no_grad():
            self.linear.bias[:6].copy_(x)

    def forward(self, h: Float[Tensor, "B D"]) -> ImuError:
        """IMU error."""
        y = self.linear(h)
        bias = y[:, :6]
        if self.bound:
            bias = self.bound * torch.tanh(bias / self.bound)
        matrix = None if self.form == "constant" else MATRIX_SIZE * y[:, 6:].unflatten(-1, (2, 3, 3))
        return ImuError(bias * self.scale, matrix)
