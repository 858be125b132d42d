"""Output layers (R048): a 9×6 Kalman gain and a six-axis IMU error, both in physical size.

Heads start near zero around a usable filter (paper.md 4.10 G0, 4.11 E0): position and velocity gain ½ I,
IMU error 0. Unscaled random heads would end in the blow-up that the paper describes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

STATE_SIZE = (1.0,) * 3 + (0.3,) * 3 + (0.02,) * 3  # m, m/s, rad
INNOVATION_SIZE = (1.0,) * 3 + (0.3,) * 3  # m, m/s
IMU_ERROR_SIZE = (0.1,) * 3 + (0.3 * torch.pi / 180,) * 3  # m/s², rad/s
_SHRINK = 0.01


class GainHead(nn.Module):
    """K = S_x · reshape(W h + b) · S_z⁻¹ (G0, the paper's free gain)."""

    def __init__(self, width: int, initial_gain: float = 0.5) -> None:
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
    """ê = σ ⊙ (W h + b) (E0): accelerometer [m/s²] and gyroscope [rad/s] error in body axes."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 6)
        self.register_buffer("scale", torch.tensor(IMU_ERROR_SIZE), persistent=False)
        with torch.no_grad():
            self.linear.weight.mul_(_SHRINK)
            self.linear.bias.zero_()

    def forward(self, h: Float[Tensor, "B D"]) -> Float[Tensor, "B 6"]:
        """IMU error."""
        return self.linear(h) * self.scale
