"""What an IMU on the vehicle measures: exact sample means from the truth, then the errors of a sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dlkf.data.increments import second_order
from dlkf.navigation.attitude import rotation_from_rpy, rotation_from_vector, skew, vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE, ecef_from_geodetic, ned_axes, normal_gravity
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.simulation.motion.vehicle import Truth

Array = NDArray[np.floating]
CHUNK = 65536  # samples at a time: memory independent of the length of a drive


def inverse_mechanisation(truth: Truth) -> Array:
    """Mean specific force [m/s²] and rate [rad/s] of the N−1 samples between N truth rows, (N−1, 6).

    Constant rate ω and force f within a sample reproduce attitude and velocity at its end exactly:

        φ = ω dt = log(C_ib(t₋)ᵀ C_ib(t₊)),   f = (J(φ) dt)⁻¹ C_ib(t₋)ᵀ (Δv_i − ∫γ dt)

    in the inertial frame that coincides with ECEF at t₋, so Earth rotation is included (R089); J(φ) is the
    mean of exp([sφ×]) over 0 ≤ s ≤ 1 and γ gravitation, normal gravity plus centrifugal part, by the
    trapezoid rule (Groves 5.4 inverted). Position follows to f' dt³/12 per sample.
    """
    chunks = []
    for first in range(0, len(truth.t) - 1, CHUNK):
        rows = slice(first, first + CHUNK + 1)
        dt = np.diff(truth.t[rows])
        parts = (truth.lat[rows], truth.lon[rows], truth.height[rows], truth.v_n[rows], truth.rpy[rows], dt)
        chunks.append(_sample_means(*map(torch.from_numpy, parts)))
    return torch.cat(chunks).numpy()


def interval_means(truth: Truth, parts: int) -> Array:
    """Mean specific force and rate over samples of ``parts`` intervals of the truth each, (N, 6): the data contract's.

    What turns and pushes as the truth does (:func:`inverse_mechanisation`) less its coning and sculling inside every
    interval, which loading adds again from the samples (:mod:`dlkf.data.increments`): with α and ν the
    increments and motion smooth through three intervals, α_k = φ_k − (φ_{k−1} × φ_k + φ_k × φ_{k+1})/24, ν likewise.
    One part is a sensor that integrates its own coning; several leave in what vibrates too fast for the samples.
    """
    step = float(truth.t[1] - truth.t[0])
    x = inverse_mechanisation(truth).T * step
    inside = second_order(x[:, :-1], x[:, 1:]) / 24
    x[:, 1:] -= inside
    x[:, :-1] -= inside
    return x.reshape(6, -1, parts).sum(-1).T / (step * parts)


def _sample_means(
    lat: Float[Tensor, " n"],
    lon: Float[Tensor, " n"],
    height: Float[Tensor, " n"],
    v_n: Float[Tensor, "n 3"],
    rpy: Float[Tensor, "n 3"],
    dt: Float[Tensor, " m"],
) -> Float[Tensor, "m 6"]:
    C_en = ned_axes(lat, lon)
    C_eb = C_en @ rotation_from_rpy(rpy)
    earth_rate = torch.tensor((0.0, 0.0, EARTH_RATE), dtype=torch.float64)
    spin = skew(earth_rate)
    r_e = ecef_from_geodetic(lat, lon, height)
    inertial_velocity = (C_en @ v_n.unsqueeze(-1)).squeeze(-1) + r_e @ spin.mT
    gravity = normal_gravity(torch.sin(lat), height).unsqueeze(-1) * C_en[..., 2]
    gravitation = gravity + r_e @ (spin @ spin).mT
    turn = rotation_from_vector(earth_rate * dt.unsqueeze(-1))  # ECEF axes at t₊ in those at t₋
    C_ib = C_eb[:-1].mT
    phi = vector_from_rotation(C_ib @ turn @ C_eb[1:])
    end = (turn @ torch.stack((inertial_velocity[1:], gravitation[1:]), -1)).unbind(-1)
    step = dt.unsqueeze(-1)
    gained = end[0] - inertial_velocity[:-1] - 0.5 * step * (end[1] + gravitation[:-1])
    mean_force = (C_ib @ gained.unsqueeze(-1)).squeeze(-1) / step
    return torch.cat((_inverse_mean_rotation(phi, mean_force), phi / step), -1)


def _inverse_mean_rotation(phi: Float[Tensor, "m 3"], u: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """J(φ)⁻¹ u = u − φ×u/2 + (1/θ² − cot(θ/2)/(2θ)) φ×(φ×u), θ = |φ| below about 3 rad."""
    squared = (phi * phi).sum(-1, keepdim=True)
    small = squared < 1e-4
    theta = torch.sqrt(torch.where(small, torch.ones_like(squared), squared))
    series = 1 / 12 + squared / 720 + squared**2 / 30240
    factor = torch.where(small, series, 1 / theta**2 - 1 / (2 * theta * torch.tan(theta / 2)))
    turned = torch.linalg.cross(phi, u)
    return u - 0.5 * turned + factor * torch.linalg.cross(phi, turned)


@dataclass(frozen=True)
class ImuUnit:
    """One drawn IMU: turn-on bias (6,), the matrices M of scale factor and misalignment (2, 3, 3), the final
    warm-up drift (6,), the gyroscope's g-sensitivity G (3, 3) [rad/s per m/s²], and the factors (6,) of the axes'
    white noise.

    Accelerometer first, then gyroscope, in m/s² and rad/s.
    """

    bias: Array
    matrix: Array
    warm_up: Array = field(default_factory=lambda: np.zeros(6))
    g_sensitivity: Array = field(default_factory=lambda: np.zeros((3, 3)))
    noise_factors: Array = field(default_factory=lambda: np.ones(6))


def draw_unit(rng: np.random.Generator, spec: ImuSpec) -> ImuUnit:
    """A unit of the preset's kind: every error an independent normal draw with the preset's 1σ, noise log-normal."""
    bias, matrices = [], []
    for sensor in (spec.accel, spec.gyro):
        bias.append(sensor.turn_on_bias * rng.standard_normal(3))
        sigma = np.where(np.eye(3, dtype=bool), sensor.scale_factor, sensor.misalignment)
        matrices.append(sigma * rng.standard_normal((3, 3)))
    warm_up = np.repeat((spec.accel.warm_up, spec.gyro.warm_up), 3) * rng.standard_normal(6)
    g_sensitivity = spec.gyro.g_sensitivity * rng.standard_normal((3, 3))
    unevenness = np.repeat((spec.accel.unevenness, spec.gyro.unevenness), 3)
    factors = np.exp(unevenness * rng.standard_normal(6)) if unevenness.any() else np.ones(6)
    return ImuUnit(np.concatenate(bias), np.stack(matrices), warm_up, g_sensitivity, factors)


def corrupt(
    rng: np.random.Generator, true_imu: Array, spec: ImuSpec, unit: ImuUnit, rate_hz: float
) -> tuple[Array, Array]:
    """Measured samples and their complete error without white noise, both (N, 6) (paper.md 2.7, R090).

        error = M true + G f + b(t),   measured = quantise(true + error + w),   std(w) = √S · √rate (R094)

    G f, with f the specific force, is in the rates alone. b(t) is the unit's turn-on bias and warm-up drift plus
    the in-run bias, the wander and the random walk of this drive. The output is limited to the full scale and
    rounded to whole steps of the quantisation; neither is part of the error.
    """
    scaled = np.concatenate((true_imu[:, :3] @ unit.matrix[0].T, true_imu[:, 3:] @ unit.matrix[1].T), -1)
    sensors = (spec.accel, spec.gyro)
    shape = (len(true_imu), 3)
    drift = [gauss_markov(rng, shape, 1 / (rate_hz * s.correlation_time), s.instability) for s in sensors]
    error = scaled + unit.bias + np.concatenate(drift, -1)
    density = np.repeat([sensor.noise_density for sensor in sensors], 3) * unit.noise_factors
    noise = density * math.sqrt(rate_hz) * rng.standard_normal(true_imu.shape)
    if unit.g_sensitivity.any():
        error[:, 3:] += true_imu[:, :3] @ unit.g_sensitivity.T
    for part, sensor in zip((slice(0, 3), slice(3, 6)), sensors):
        if sensor.random_walk > 0:
            steps = sensor.random_walk / math.sqrt(rate_hz) * rng.standard_normal(shape)
            error[:, part] += np.cumsum(steps, axis=0)
        if sensor.warm_up > 0:
            t = np.arange(1, len(true_imu) + 1) / rate_hz
            error[:, part] -= np.expm1(-t / sensor.warm_up_time)[:, None] * unit.warm_up[part]
        if sensor.wander > 0:
            error[:, part] += gauss_markov(rng, shape, 1 / (rate_hz * sensor.wander_time), sensor.wander)
    measured = true_imu + error + noise
    for part, sensor in zip((slice(0, 3), slice(3, 6)), sensors):
        measured[:, part] = quantise(measured[:, part], sensor)
    return measured, error


def quantise(x: Array, sensor: SensorErrors) -> Array:
    """What a sensor's output register holds of x: within ± its full scale, in whole steps."""
    if sensor.full_scale > 0:
        x = np.clip(x, -sensor.full_scale, sensor.full_scale)
    if sensor.quantisation > 0:
        x = sensor.quantisation * np.round(x / sensor.quantisation)
    return x


def gauss_markov(rng: np.random.Generator, shape: tuple[int, int], step: float, sigma: float = 1.0) -> Array:
    """Stationary first-order Gauss-Markov processes of 1σ ``sigma``, one per column (N, k), discretised exactly.

    b₀ ~ N(0, σ²), b_k = a b_{k−1} + σ √(1 − a²) n_k with a = exp(−step), ``step`` = dt/τ.
    """
    n = sigma * rng.standard_normal(shape)
    n[1:] *= math.sqrt(-math.expm1(-2 * step))
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -math.exp(-step)], n, axis=0))
