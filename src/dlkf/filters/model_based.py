"""Model-based estimators: pure inertial, and the 15-state error-state Kalman filter (MBKF; R007–R020)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import Correction, Epoch
from dlkf.navigation.error_model import masked, noise_weights, window_noise, window_transition
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.state import IMU, PVA, STATES

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True)
class Tuning:
    """Over-bounding factors on standard deviations, ≥ 1 as a rule, fitted on training drives only (R016, R018).

    ``accel_noise``, ``gyro_noise`` scale √S of the white noise; ``accel_walk``, ``gyro_walk`` that of the bias
    random walk; ``position_std``, ``velocity_std`` the GNSS stds. ``walk_floor_accel`` [m/s²/√s] and
    ``walk_floor_gyro`` [rad/s/√s] keep the bias states awake when the preset has no in-run instability, and
    ``position_floor`` [m], ``velocity_floor`` [m/s] keep R positive.
    """

    accel_noise: float = 1.0
    gyro_noise: float = 1.0
    accel_walk: float = 1.0
    gyro_walk: float = 1.0
    position_std: float = 1.0
    velocity_std: float = 1.0
    walk_floor_accel: float = 1e-5
    walk_floor_gyro: float = 1e-7
    position_floor: float = 0.01
    velocity_floor: float = 0.01


class Ins:
    """Pure inertial navigation: no update, no IMU error (R012)."""

    def begin(self, batch: Batch) -> tuple[None, Tensor]:
        """No memory; the raw IMU is believed."""
        return None, batch.imu.new_zeros(batch.size[0], 6)

    def step(self, memory: None, epoch: Epoch) -> tuple[None, Correction]:
        """No correction."""
        return None, Correction(epoch.z.new_zeros(len(epoch.z), 9), epoch.imu_error)


class Memory(NamedTuple):
    """Covariance and noise weights of a Kalman filter between epochs."""

    P: Tensor  # (B, 15, 15)
    weights: dict[str, Tensor]


def bias_sigma(imu: ImuSpec) -> Float[Tensor, " 6"]:
    """1σ of the error that a constant-bias state has to carry at the start [m/s², rad/s].

    Turn-on bias and in-run part, plus what scale factor (down axis) and misalignment (level axes) make of
    gravity: to a filter without those states they are biases.
    """
    accel = math.hypot(imu.accel.turn_on_bias, imu.accel.instability)
    level = math.hypot(accel, STANDARD_GRAVITY * imu.accel.misalignment)
    down = math.hypot(accel, STANDARD_GRAVITY * imu.accel.scale_factor)
    gyro = math.hypot(imu.gyro.turn_on_bias, imu.gyro.instability)
    return torch.tensor([level, level, down, gyro, gyro, gyro], dtype=torch.float64)


@dataclass(frozen=True)
class Mbkf15:
    """Error-state Kalman filter with position, velocity, attitude and both biases (paper eqs 1–6).

    ``prior_mean`` and ``prior_std`` [m/s², rad/s] replace zero and the preset's spread as the bias's initial
    knowledge: with a training set's mean error this is ``mbkf15_prior`` (checklist 4.6).
    """

    imu: ImuSpec
    tuning: Tuning = field(default_factory=Tuning)
    prior_mean: tuple[float, ...] = (0.0,) * 6
    prior_std: tuple[float, ...] | None = None

    def begin(self, batch: Batch) -> tuple[Memory, Tensor]:
        """P₀ from the start's law and the preset; biases at their prior mean."""
        like = {"dtype": batch.imu.dtype, "device": batch.imu.device}
        B = batch.size[0]
        spread = bias_sigma(self.imu) if self.prior_std is None else torch.tensor(self.prior_std)
        sigma = torch.cat((batch.start_std, spread.to(**like).expand(B, 6)), -1)
        mean = torch.tensor(self.prior_mean, **like).repeat(B, 1)
        weights = noise_weights(batch.epoch_s, batch.imu.dtype, batch.imu.device)
        return Memory(torch.diag_embed(sigma**2), weights), mean

    def psd(self) -> dict[str, float]:
        """Over-bounded power spectral densities of the noise sources (R016)."""
        t, a, g = self.tuning, self.imu.accel, self.imu.gyro
        return {
            "accel_noise": t.accel_noise**2 * a.noise_psd,
            "gyro_noise": t.gyro_noise**2 * g.noise_psd,
            "accel_walk": t.accel_walk**2 * max(a.walk_psd, t.walk_floor_accel**2),
            "gyro_walk": t.gyro_walk**2 * max(g.walk_psd, t.walk_floor_gyro**2),
        }

    def step(self, memory: Memory, epoch: Epoch) -> tuple[Memory, Correction]:
        """Propagate P over the window, update where a fix may be used (paper eqs 2–6, Joseph form)."""
        P = memory.P
        Phi = window_transition(epoch.start, epoch.window, epoch.dt, epoch.frame)
        P = Phi @ P @ Phi.mT + window_noise(Phi, self.psd(), memory.weights)
        dx = P.new_zeros(len(P), STATES)
        K = P.new_zeros(len(P), STATES, 6)
        if bool(epoch.used.any()):
            H, R = masked(epoch.H, self._variance(epoch), epoch.used)
            K, P = kalman_update(P, H, R)
            dx = (K @ epoch.z.unsqueeze(-1)).squeeze(-1)
        P = 0.5 * (P + P.mT)
        std = P.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
        return Memory(P, memory.weights), Correction(
            dx[:, PVA], epoch.imu_error + dx[:, IMU], std=std, gain=K[:, PVA]
        )

    def _variance(self, epoch: Epoch) -> Tensor:
        t = self.tuning
        scale = epoch.fix_std.new_tensor([t.position_std] * 3 + [t.velocity_std] * 3)
        floor = epoch.fix_std.new_tensor([t.position_floor] * 3 + [t.velocity_floor] * 3)
        return (scale * epoch.fix_std).clamp_min(floor) ** 2


def kalman_update(
    P: Float[Tensor, "B n n"], H: Float[Tensor, "B m n"], R: Float[Tensor, "B m"]
) -> tuple[Float[Tensor, "B n m"], Float[Tensor, "B n n"]]:
    """Gain K = P Hᵀ (H P Hᵀ + R)⁻¹ and Joseph-form covariance for diagonal R (paper eqs 4, 6)."""
    PHt = P @ H.mT
    S = H @ PHt + torch.diag_embed(R)
    K = torch.cholesky_solve(PHt.mT, torch.linalg.cholesky(S)).mT
    A = torch.eye(P.shape[-1], dtype=P.dtype, device=P.device) - K @ H
    return K, A @ P @ A.mT + (K * R.unsqueeze(-2)) @ K.mT
