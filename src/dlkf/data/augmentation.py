"""Augmentation of training segments: sensors and receivers made worse."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dlkf.data.drive import Batch


@dataclass(frozen=True)
class SensorDegradation:
    """IMUs and receivers worse than any preset, drawn for every segment; each pair is a log-uniform range.

    ``share`` of the sensors get white noise [m/s²/√Hz, rad/s/√Hz], uneven over the axes by ``uneven`` (1σ of the
    logarithm), and an error that wanders with a correlation time of 1 to 20 s [m/s², rad/s]. ``shaken`` of the
    segments have what is faster than some 3 Hz made weaker or stronger, from nothing to twice; ``rectified`` of them
    have sensors that turn vibration into an error that wanders, axis by axis in proportion to its vibration;
    ``gnss`` of them have further errors of position [m] and velocity [m/s], half white and half lasting, which their
    stds are good only within a factor of two.
    """

    share: float = 0.4
    accel_noise: tuple[float, ...] = (1e-3, 3e-2)
    gyro_noise: tuple[float, ...] = (1e-4, 5e-3)
    accel_wander: tuple[float, ...] = (1e-3, 0.05)
    gyro_wander: tuple[float, ...] = (1e-4, 5e-3)
    wander_s: tuple[float, ...] = (1.0, 20.0)
    uneven: float = 1.0
    shaken: float = 0.4
    rectified: float = 0.4
    accel_rectified: tuple[float, ...] = (3e-4, 1e-2)  # of the RMS of the vibration in a window
    gyro_rectified: tuple[float, ...] = (1e-3, 5e-2)
    gnss: float = 0.5
    position: tuple[float, ...] = (0.01, 3.0)
    velocity: tuple[float, ...] = (0.01, 0.3)


def degrade_sensors(batch: Batch, rough: SensorDegradation, generator: torch.Generator) -> Batch:
    """The batch with the IMU and the receiver of each segment degraded by random draws from ``rough``."""
    B, T, M = batch.size

    def chance(share: float) -> Tensor:
        return torch.rand(B, generator=generator) < share

    def draw(bounds: tuple[float, ...], *shape: int) -> Tensor:
        low, high = (math.log(x) for x in bounds)
        return torch.exp(low + (high - low) * torch.rand(*shape, generator=generator))

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    imu = batch.imu
    shaken = torch.where(chance(rough.shaken), 2 * torch.rand(B, generator=generator), 1.0).to(imu)
    flat = imu.flatten(1, 2)
    reach = max(1, round(0.08 / batch.dt))
    slow = torch.nn.functional.avg_pool1d(
        torch.nn.functional.pad(flat.mT, (reach, reach), mode="replicate"), 2 * reach + 1, 1
    ).mT
    flat = torch.where((shaken != 1)[:, None, None], slow + shaken[:, None, None] * (flat - slow), flat)
    hit = torch.stack([chance(rough.share) for _ in range(2)], -1).repeat_interleave(3, -1)  # each sensor by itself
    axes = torch.exp(rough.uneven * normal(B, 6))
    white = torch.cat([draw(b, B, 1).expand(B, 3) for b in (rough.accel_noise, rough.gyro_noise)], -1) * axes
    slowly = torch.cat([draw(b, B, 1).expand(B, 3) for b in (rough.accel_wander, rough.gyro_wander)], -1)
    slowly = slowly * torch.exp(rough.uneven * normal(B, 6))
    keep = torch.exp(-batch.epoch_s / draw(rough.wander_s, B, 1))
    of_loud = torch.cat([draw(b, B, 1).expand(B, 3) for b in (rough.accel_rectified, rough.gyro_rectified)], -1)
    of_loud = of_loud * torch.exp(normal(B, 6)) * chance(rough.rectified)[:, None]
    loud = (flat - slow).unflatten(1, (T, M)).square().mean(2).sqrt().to(of_loud)
    size = (slowly * hit)[:, None] + loud * of_loud[:, None]
    wander = (draw_correlated_noise(normal(B, T, 6), keep) * size).repeat_interleave(M, 1)
    noise = (white / batch.dt**0.5 * hit)[:, None] * normal(B, T * M, 6)
    flat = flat + (noise + wander).to(imu)
    worse = chance(rough.gnss)[:, None, None]
    size = torch.cat([draw(b, B, 1).expand(B, 3) for b in (rough.position, rough.velocity)], -1)[:, None]
    lasting = draw_correlated_noise(normal(B, T, 6), torch.exp(-batch.epoch_s / draw((5.0, 60.0), B, 1)))
    error = size * (0.5**0.5) * (normal(B, T, 6) + lasting * torch.tensor([1.0] * 3 + [0.3] * 3))
    detail = size * torch.exp(0.7 * normal(B, 1, 1))
    gnss = torch.where(worse & batch.gnss_valid, batch.gnss + error.to(batch.gnss), batch.gnss)
    std = torch.where(worse, (batch.gnss_std.square() + detail.square().to(imu)).sqrt(), batch.gnss_std)
    return replace(batch, imu=flat.unflatten(1, (T, M)), gnss=gnss, gnss_std=std)


def draw_correlated_noise(white: Tensor, keep: Tensor) -> Tensor:
    """First-order Gauss-Markov of unit variance along the second axis of white noise (B, T, k); ``keep`` (B, 1)."""
    state, rows, fresh = white[:, 0], [], (1 - keep.square()).sqrt()
    for now in white.unbind(1):
        rows.append(state)
        state = keep * state + fresh * now
    return torch.stack(rows, 1)
