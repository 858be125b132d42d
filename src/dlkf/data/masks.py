"""Changes of a filter's input: withheld fixes and added IMU biases of a batch, noise on the fixes of a drive; runs of
flags."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.base.settings import Ranged
from dlkf.data.draws import segment_generator
from dlkf.data.drive import Batch, Drive


@dataclass(frozen=True)
class BiasLaw(Ranged, where="injected_bias", least=0):
    """1σ of a constant that is added to the IMU of every segment, per axis [m/s², °/s]."""

    accel_mps2: float = 0.05
    gyro_dps: float = 0.15

    @property
    def std(self) -> Float[Tensor, " 6"]:
        """[m/s²] of three accelerometers, [rad/s] of three gyroscopes; float64."""
        return torch.tensor([self.accel_mps2] * 3 + [math.radians(self.gyro_dps)] * 3, dtype=torch.float64)


@dataclass(frozen=True)
class Outage(Ranged, where="outage", least=0):
    """One stretch without GNSS in every segment, seconds from its start."""

    first_s: float
    duration_s: float


@dataclass(frozen=True)
class GnssNoise(Ranged, where="gnss_noise", least=0):
    """1σ per axis of noise added to every fix (paper eqs 12, 13; R130): ``s_p`` [m], ``s_v`` [m/s]; the fixes' own stds
    grow with it."""

    s_p: float = 0.0
    s_v: float = 0.0

    def add_noise(self, drive: Drive, seed: int = 0) -> Drive:
        """The drive with noise of its own on every fix: p̃ = p + s_p n, ṽ = v + s_v n, n ~ N(0, I) (isotropic, so the
        axes do not matter); std ← √(std² + s²), which a Kalman filter takes for R (R018)."""
        generator = segment_generator(seed, "gnss_noise", drive.name, drive.t0)
        n = torch.randn(len(drive.gnss_std), 6, generator=generator, dtype=torch.float64)
        s = torch.tensor([self.s_p] * 3 + [self.s_v] * 3, dtype=torch.float64)
        return replace(
            drive,
            gnss_r_e=drive.gnss_r_e + s[:3] * n[:, :3],
            gnss_v_e=drive.gnss_v_e + s[3:] * n[:, 3:],
            gnss_std=torch.hypot(drive.gnss_std.double(), s).to(drive.gnss_std),
        )


def withhold_fixes(batch: Batch, hidden: Bool[Tensor, "b t"]) -> Batch:
    """The batch without the fixes of the mask."""
    return replace(batch, available=batch.available & ~hidden.to(batch.available.device))


def mask_outage(batch: Batch, start_s: float | Tensor, duration_s: float | Tensor) -> Bool[Tensor, "b t"]:
    """True where an epoch's end has start < t ≤ start + duration, seconds from the start of a segment; each (B,)."""
    B, T, _ = batch.size
    t = torch.arange(1, T + 1, dtype=torch.float64) * batch.epoch_s
    start, length = (torch.as_tensor(x, dtype=torch.float64).expand(B)[:, None] for x in (start_s, duration_s))
    slack = 1e-6 * batch.epoch_s
    return (t > start + slack) & (t <= start + length + slack)


def add_bias(batch: Batch, bias: Float[Tensor, "b 6"]) -> Batch:
    """The batch with a constant added to its raw IMU and to its true IMU error, which stays NaN where unknown."""
    bias = bias.to(batch.imu)
    imu = torch.where(batch.present[..., None, None], batch.imu + bias[:, None, None], batch.imu)
    return replace(batch, imu=imu, true_imu_error=batch.true_imu_error + bias[:, None])


def find_runs(flags: Bool[np.ndarray | Tensor, " n"]) -> list[tuple[int, int]]:
    """Half-open ranges in which flags are set."""
    edges = np.flatnonzero(np.diff(np.asarray(flags), prepend=False, append=False))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]
