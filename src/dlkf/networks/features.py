"""Features of the network: the window for the CNN and the four components for the LSTM (R037–R044).

Everything is brought to a size of about one, by fixed physical sizes or by those that training segments have
(:class:`Scaling`); the components then pass asinh, which keeps sign and small signals and tames the innovations after
an outage (paper.md 4.9). ``frame`` chooses the axes of every horizontal pair: ``ned`` is the paper's reading,
``heading`` turns them by the estimated yaw, which makes the network blind to the direction of driving.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.navigation.attitude import rpy_from_rotation

Frame = Literal["ned", "heading"]
CNN_CHANNELS = 15
COMPONENTS = 30

# sizes of P [m], V [m/s], roll-pitch-yaw [rad], specific force [m/s²], angular rate [rad/s]
WINDOW_SCALE = (300.0,) * 3 + (10.0,) * 3 + (0.1, 0.1, 2.0) + (2.0, 2.0, 10.0) + (0.2,) * 3
# successive posterior difference per second (9), last correction (9), GNSS difference per second (6), z (6)
COMPONENT_SCALE = (
    (10.0,) * 3 + (1.0,) * 3 + (0.1,) * 3
    + (1.0,) * 3 + (0.3,) * 3 + (0.02,) * 3
    + (10.0,) * 3 + (1.0,) * 3
    + (1.0,) * 3 + (0.3,) * 3
)  # fmt: skip


def level_rotation(C_nb: Float[Tensor, "B 3 3"], frame: str) -> Float[Tensor, "B 3 3"]:
    """C_hn: n vectors to the feature axes; identity for ``ned``, minus the estimated yaw for ``heading``."""
    if frame == "ned":
        return torch.eye(3, dtype=C_nb.dtype, device=C_nb.device).expand(len(C_nb), 3, 3)
    yaw = torch.atan2(C_nb[:, 1, 0], C_nb[:, 0, 0])
    c, s, o, one = torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw), torch.ones_like(yaw)
    return torch.stack((c, s, o, -s, c, o, o, o, one), -1).unflatten(-1, (3, 3))


class Scaling(nn.Module):
    """Centre and size of every input; buffers, so that they are stored with the weights.

    They start as the fixed sizes above and are set once to those of training segments by :meth:`fit` (R067 asks for
    normalised losses only; inputs of like size are paper.md 4.9).
    """

    window_centre: Tensor
    window_size: Tensor
    component_size: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("window_centre", torch.zeros(CNN_CHANNELS))
        self.register_buffer("window_size", torch.tensor(WINDOW_SCALE))
        self.register_buffer("component_size", torch.tensor(COMPONENT_SCALE))

    def forward(
        self, window: Float[Tensor, "B M 15"], components: Float[Tensor, "B 30"]
    ) -> tuple[Float[Tensor, "B 15 M"], Float[Tensor, "B 30"]]:
        """Both in units of their size, channels first, components through asinh."""
        x = (window - self.window_centre.to(window)) / self.window_size.to(window)
        return x.mT, torch.asinh(components / self.component_size.to(components))

    def fit(self, windows: Float[Tensor, "N M 15"], components: Float[Tensor, "N 30"]) -> None:
        """Centre and spread of what a filter saw over training segments, robust against the hours after a start.

        A channel that hardly moves keeps a thousandth of its fixed size at least.
        """
        flat = windows.flatten(0, 1)
        centre = flat.median(0).values
        for size, x, fixed in (
            (self.window_size, flat - centre, WINDOW_SCALE),
            (self.component_size, components, COMPONENT_SCALE),
        ):
            spread = torch.maximum(1.4826 * x.abs().median(0).values, x.abs().quantile(0.9, 0) / 1.645)
            size.copy_(torch.maximum(spread, 1e-3 * torch.tensor(fixed, dtype=x.dtype)))
        self.window_centre.copy_(centre)


def window_features(
    p: Float[Tensor, "B M 3"],
    v: Float[Tensor, "B M 3"],
    C: Float[Tensor, "B M 3 3"],
    imu: Float[Tensor, "B M 6"],
    C_hn: Float[Tensor, "B 3 3"],
    frame: str,
) -> Float[Tensor, "B M 15"]:
    """Channels over time: position, velocity, attitude of the INS and the raw IMU (R037).

    ``p`` counts from where the filter started; in the ``heading`` frame from the window's first sample, and yaw from
    its last.
    """
    rpy = rpy_from_rotation(C)
    if frame == "heading":
        p, v = (p - p[:, :1]) @ C_hn.mT, v @ C_hn.mT
        yaw = rpy[..., 2] - rpy[:, -1:, 2]
        rpy = torch.cat((rpy[..., :2], torch.atan2(torch.sin(yaw), torch.cos(yaw)).unsqueeze(-1)), -1)
    return torch.cat((p, v, rpy, imu), -1)


def component_features(
    posterior_rate: Float[Tensor, "B 9"],
    last_correction: Float[Tensor, "B 9"],
    gnss_rate: Float[Tensor, "B 6"],
    innovation: Float[Tensor, "B 6"],
    C_hn: Float[Tensor, "B 3 3"],
) -> Float[Tensor, "B 30"]:
    """The four components a–d of the paper (R040–R043); the two differences come per second (paper.md 4.2)."""
    x = torch.cat((posterior_rate, last_correction, gnss_rate, innovation), -1)
    return (x.unflatten(-1, (10, 3)) @ C_hn.mT).flatten(1)
