"""Degraded GNSS (paper eqs 12, 13; R130): white noise on position and velocity of every fix."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from dlkf.base.settings import Ranged
from dlkf.data.draws import segment_generator
from dlkf.data.drive import Drive


@dataclass(frozen=True)
class GnssNoise(Ranged, where="gnss_noise", least=0):
    """1σ per axis of the added noise: ``s_p`` [m] and ``s_v`` [m/s]; the fixes' own stds grow with it."""

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
