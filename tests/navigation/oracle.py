"""Independent float64 mechanisation, sample by sample with substeps, written without the package's strapdown."""

import torch
from scipy.spatial.transform import Rotation

from dlkf.navigation.earth import EARTH_RATE, TangentFrame, tangent_frame
from dlkf.navigation.state import NavState


def matrix(vector: torch.Tensor) -> torch.Tensor:
    """exp([v×]) by scipy."""
    return torch.from_numpy(Rotation.from_rotvec(vector.reshape(-1, 3).numpy()).as_matrix()).reshape(
        *vector.shape[:-1], 3, 3
    )


def mechanise(start: NavState, imu: torch.Tensor, dt: float, frame: TangentFrame, substeps: int = 40):
    """States at the end of every sample by small Heun steps of the continuous equations (paper.md 2.1)."""
    p, v, C = start
    h = dt / substeps
    rate = frame.earth_rate_n
    rows = []
    for k in range(imu.shape[1]):
        f, w = imu[:, k, :3], imu[:, k, 3:]
        half, full = matrix(w * h / 2), matrix(w * h)
        earth_half, earth_full = matrix(-rate * h / 2), matrix(-rate * h)
        for _ in range(substeps):
            push = (earth_half @ C @ half @ f.unsqueeze(-1)).squeeze(-1)
            a0 = push + frame.gravity(p) - 2 * torch.linalg.cross(rate, v)
            a1 = push + frame.gravity(p + h / 2 * v) - 2 * torch.linalg.cross(rate, v + h / 2 * a0)
            p, v, C = p + h * v + h * h / 2 * a1, v + h * a1, earth_full @ C @ full
        rows.append((p, v, C))
    return NavState(*(torch.stack(x, 1) for x in zip(*rows)))


def frame_at(lat: float = 0.9, lon: float = 0.2, height: float = 80.0, batch: int = 1, dtype=torch.float64):
    """Tangent frames at one place."""
    one = torch.ones(batch, dtype=torch.float64)
    return tangent_frame(lat * one, lon * one, height * one, dtype)


def lively_imu(batch: int, samples: int, seed: int = 0) -> torch.Tensor:
    """Rough samples: 2 m/s², 0.5 rad/s and a steady turn."""
    g = torch.Generator().manual_seed(seed)
    force = 2 * torch.randn(batch, samples, 3, generator=g, dtype=torch.float64)
    rate = 0.5 * torch.randn(batch, samples, 3, generator=g, dtype=torch.float64)
    force[..., 2] -= 9.8
    rate[..., 2] += 0.5
    return torch.cat((force, rate), -1)


def still_imu(frame: TangentFrame, samples: int) -> torch.Tensor:
    """What an error-free IMU reads at rest, level and north-facing, at the origin of the frame."""
    zero = torch.zeros(len(frame.height), 3, dtype=torch.float64)
    one = torch.cat((-frame.gravity(zero), frame.earth_rate_n), -1)
    assert abs(float(frame.earth_rate_n[0].norm()) - EARTH_RATE) < 1e-18
    return one.unsqueeze(1).expand(-1, samples, 6).clone()
