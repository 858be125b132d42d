"""Batches of turning, accelerating cars with known IMU errors, made by the error-free strapdown itself."""

import math
from dataclasses import fields, replace
from typing import Any

import torch

from dlkf.data.drive import Batch
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.earth import TangentFrame, tangent_frame
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown

RATE, M = 50.0, 50
START_STD = torch.tensor([1.0] * 3 + [0.1] * 3 + [math.radians(1)] * 2 + [math.radians(5)], dtype=torch.float64)
IMU = ImuSpec(
    "scene",
    accel=SensorErrors(noise_density=1e-3, turn_on_bias=0.1, instability=1e-3, correlation_time=100.0),
    gyro=SensorErrors(noise_density=7e-5, turn_on_bias=5e-3, instability=5e-5, correlation_time=100.0),
)


def beside(*batches: Batch) -> Batch:
    """The cars of several batches in one, which takes a filter no longer than one of them."""

    def joined(parts: tuple[Any, ...]) -> Any:
        first = parts[0]
        if isinstance(first, NavState):
            return NavState(*map(joined, zip(*parts)))
        if isinstance(first, TangentFrame):
            return replace(first, **{f.name: joined(tuple(getattr(x, f.name) for x in parts)) for f in fields(first)})
        if isinstance(first, torch.Tensor):
            return torch.cat(parts)
        return sum(parts, ()) if isinstance(first, tuple) else first

    return replace(batches[0], **{f.name: joined(tuple(getattr(x, f.name) for x in batches)) for f in fields(Batch)})


def scene(
    batch: int,
    epochs: int,
    seed: int = 0,
    imu: ImuSpec = IMU,
    lever_arm=(0.0, 0.0, 0.0),
    noise: bool = True,
    position_std: float = 0.05,
    velocity_std: float = 0.05,
    bias: torch.Tensor | None = None,
) -> Batch:
    """B cars for T seconds; ``bias`` (B, 6) overrides the drawn turn-on biases; ``noise=False`` is a clean world."""
    g = torch.Generator().manual_seed(seed)
    D = torch.float64

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=D)

    one = torch.ones(batch, dtype=D)
    frame = tangent_frame(0.9 * one, 0.2 * one, 80 * one)
    zero = torch.zeros(batch, 3, dtype=D)
    yaw = 2 * math.pi * torch.rand(batch, generator=g, dtype=D)
    C = rotation_from_rpy(torch.stack((0.02 * draw(batch), 0.02 * draw(batch), yaw), -1))
    speed = 12.0
    state = start = NavState(zero, speed * C[:, :, 0], C)
    t = torch.arange(epochs * M, dtype=D) / RATE
    phase = 2 * math.pi * torch.rand(batch, 3, 1, generator=g, dtype=D)
    turn = 0.35 * torch.sin(2 * math.pi * t / 23 + phase[:, 0])
    push = 1.5 * torch.sin(2 * math.pi * t / 17 + phase[:, 1])
    tilt = 0.01 * torch.cos(2 * math.pi * t / 11 + phase[:, 2])
    gravity = 9.8124
    force = torch.stack((push, speed * turn, -gravity * torch.ones_like(turn)), -1)
    rate = torch.stack((tilt, tilt.flip(0), turn), -1)
    clean = torch.cat((force, rate), -1).reshape(batch, epochs, M, 6)
    rows, swing = [], []
    arm = torch.tensor(lever_arm, dtype=D).expand(batch, 3)
    for k in range(epochs):
        window = strapdown(state, clean[:, k], 1 / RATE, frame)
        state = window.end
        rows.append(state)
        w_b = clean[:, k, -1, 3:]
        swing.append(torch.linalg.cross(w_b, arm))
    truth = NavState(*(torch.stack(x, 1) for x in zip(*rows)))
    arm_n = (truth.C_nb @ arm[:, None, :, None]).squeeze(-1)
    v_arm = (truth.C_nb @ torch.stack(swing, 1).unsqueeze(-1)).squeeze(-1)
    v_arm = v_arm - torch.linalg.cross(frame.earth_rate_n[:, None].expand_as(arm_n), arm_n)
    std = torch.tensor([position_std] * 3 + [velocity_std] * 3, dtype=D).expand(batch, epochs, 6)
    gnss = torch.cat((truth.p_n + arm_n, truth.v_n + v_arm), -1)
    sizes = (imu.accel, imu.gyro)
    turn_on = torch.cat([s.turn_on_bias * draw(batch, 3) for s in sizes], -1) if bias is None else bias
    walk = torch.cat([math.sqrt(s.walk_psd) * draw(batch, epochs, 3) for s in sizes], -1).cumsum(1)
    white = torch.cat([s.noise_density * math.sqrt(RATE) * draw(batch, epochs, M, 3) for s in sizes], -1)
    on = float(noise)
    error = turn_on[:, None] + on * walk
    ones = torch.ones(batch, epochs, dtype=torch.bool)
    start_error = START_STD * draw(batch, 9) * on
    return Batch(
        imu=clean + error[:, :, None] + on * white,
        dt=1 / RATE,
        frame=frame,
        gnss=gnss + on * std * draw(batch, epochs, 6),
        gnss_std=std.clone(),
        gnss_valid=ones[..., None].expand(-1, -1, 6).clone(),
        gnss_lag=torch.zeros(batch, epochs, dtype=D),
        available=ones.clone(),
        lever_arm_b=arm.clone(),
        start=start.correct(start_error),
        start_std=START_STD.expand(batch, 9).clone(),
        truth=truth,
        truth_valid=ones,
        attitude_valid=ones,
        true_imu_error=error,
        present=ones,
        drive=tuple(f"car-{i}" for i in range(batch)),
        t_start=torch.zeros(batch, dtype=D),
    )
