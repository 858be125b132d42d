"""What the network sees: the window for the CNN and the four components for the LSTM (R037–R044).

Everything is divided by a fixed physical size; the components then pass asinh, which keeps sign and small
signals and tames the innovations after an outage (paper.md 4.9). ``frame`` chooses the axes of every
horizontal pair: ``ned`` is the paper's reading, ``heading`` turns them by the estimated yaw, which makes the
network blind to the direction of driving.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.attitude import rpy_from_rotation

FRAMES = ("ned", "heading")
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


def window_features(
    p: Float[Tensor, "B M 3"],
    v: Float[Tensor, "B M 3"],
    C: Float[Tensor, "B M 3 3"],
    imu: Float[Tensor, "B M 6"],
    C_hn: Float[Tensor, "B 3 3"],
    frame: str,
) -> Float[Tensor, "B 15 M"]:
    """Channels over time: position, velocity, attitude of the INS and the raw IMU (R037).

    In the ``heading`` frame the position counts from the window's first sample and yaw from its last.
    """
    rpy = rpy_from_rotation(C)
    if frame == "heading":
        p, v = (p - p[:, :1]) @ C_hn.mT, v @ C_hn.mT
        yaw = rpy[..., 2] - rpy[:, -1:, 2]
        rpy = torch.cat((rpy[..., :2], torch.atan2(torch.sin(yaw), torch.cos(yaw)).unsqueeze(-1)), -1)
    x = torch.cat((p, v, rpy, imu), -1)
    return (x / x.new_tensor(WINDOW_SCALE)).mT


def component_features(
    posterior_rate: Float[Tensor, "B 9"],
    last_correction: Float[Tensor, "B 9"],
    gnss_rate: Float[Tensor, "B 6"],
    innovation: Float[Tensor, "B 6"],
    C_hn: Float[Tensor, "B 3 3"],
) -> Float[Tensor, "B 30"]:
    """The four components a–d of the paper (R040–R043); the two differences come per second (paper.md 4.2)."""
    x = torch.cat((posterior_rate, last_correction, gnss_rate, innovation), -1)
    x = (x.unflatten(-1, (10, 3)) @ C_hn.mT).flatten(1)
    return torch.asinh(x / x.new_tensor(COMPONENT_SCALE))
