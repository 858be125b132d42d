"""Standstills: where a car is stationary, gyroscope bias and levelling there, attitude carried back from first motion.

A stationary car does not turn: its mean rate is the gyroscopes' error and the Earth's rate, its mean specific force is
−g, which gives roll and pitch (Groves 5.6.2), and its heading when it sets off is the heading of the whole standstill.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dlkf.data.alignment import SPREAD_STD
from dlkf.data.drive import Drive
from dlkf.data.masks import find_runs
from dlkf.navigation.attitude import prefix_rotations
from dlkf.navigation.earth import EARTH_RATE

REST_SPREAD = (0.4, 0.05)  # m/s², rad/s: the greatest spread of the samples of a stationary car, engine on
REST_RATE = 0.2  # rad/s, of the error of gyroscopes
REST_SPEED = 0.2  # m/s, on top of what the receiver may be wrong by
REST_POSITION_STD = 0.1  # m: fixes without velocity and with a larger 1σ are not used
SHORTEST_REST_S = 2.0
RATE_STD = 5e-3  # rad/s, of gyroscopes without samples at rest
RATE_DRIFT_STD = 5e-4  # rad/s, since they have
RATE_SCALE_STD = 5e-3  # of the angle turned


def stationary_epochs(drive: Drive) -> Bool[Tensor, " epochs"]:
    """Stationary epochs: little spread of the samples, between two fixes that do not move, for two seconds at least.

    Velocity where the receiver gives one, else the way between fixes two seconds apart. Nothing is at rest without
    GNSS.
    """
    spread = drive.imu.double().unflatten(-1, (2, 3)).var(1, correction=0).sum(-1).sqrt()
    quiet = (spread <= spread.new_tensor(REST_SPREAD)).all(-1)
    quiet &= drive.imu[..., 3:].double().mean(1).norm(dim=-1) <= REST_RATE
    known = drive.gnss_valid[:, 3:5].all(-1)
    speed, std = drive.gnss_v_e.norm(dim=-1), drive.gnss_std[:, 3:].amax(-1)
    slow = known & (speed <= REST_SPEED + 2 * std)
    fixed = drive.gnss_valid[:, :3].all(-1)
    std = drive.gnss_std[:, :3].amax(-1)
    count = max(1, min(round(SHORTEST_REST_S / drive.epoch_s), drive.epochs))
    way = (drive.gnss_r_e[count:] - drive.gnss_r_e[:-count]).norm(dim=-1)
    ends = fixed & (std <= REST_POSITION_STD)
    near = way <= REST_SPEED * count * drive.epoch_s + 2 * (std[count:] + std[:-count])
    near &= ends[count:] & ends[:-count]
    near = torch.nn.functional.pad(near, (count - 1, count - 1)).unfold(0, count, 1).any(-1)  # of a stretch around
    still = torch.where(known[1:] & known[:-1], slow[1:] & slow[:-1], near & fixed[1:] & fixed[:-1])
    rest = quiet & still
    shortest = max(1, round(SHORTEST_REST_S / drive.epoch_s))
    for first, last in find_runs(rest):
        if last - first < shortest:
            rest[first:last] = False
    return rest


def rest_around(rest: Bool[Tensor, " epochs"], row: int) -> slice:
    """The epochs at rest that boundary ``row`` is part of."""
    return next(slice(first, last) for first, last in find_runs(rest) if first <= row <= last)


@dataclass(frozen=True)
class Gyros:
    """What gyroscopes show [rad/s, in b] of a car that does not turn, how much of it is their error, and its 1σ."""

    shown: Float[Tensor, " 3"]
    error: Float[Tensor, " 3"]
    std: float
    known: bool = True  # not just assumed


def stationary_gyros(drive: Drive, rest: Bool[Tensor, " epochs"], C_eb: Float[Tensor, "3 3"]) -> Gyros:
    """From the mean over the epochs at rest; without any, the Earth's rate at attitude ``C_eb`` and no error."""
    earth = C_eb[2] * EARTH_RATE
    if not bool(rest.any()):
        return Gyros(earth, torch.zeros_like(earth), RATE_STD, known=False)
    samples = drive.imu[rest][..., 3:].double().flatten(0, 1)
    noise = float(samples.std(0).max()) / math.sqrt(len(samples))
    shown = samples.mean(0)
    return Gyros(shown, shown - earth, math.hypot(RATE_DRIFT_STD, noise))


def carry_attitude_back(
    drive: Drive, C: Float[Tensor, "3 3"], last: int, first: int, gyros: Gyros, rest: Bool[Tensor, " epochs"]
) -> Float[Tensor, "3 3"]:
    """Attitude relative to the Earth at boundary ``first`` ≤ ``last`` from that at ``last``: C Πᵀ of the turns between.

    Epochs at rest turn nothing.
    """
    moving = torch.arange(first, last)[~rest[first:last]]
    if not len(moving):
        return C
    phi = (drive.imu[moving][..., 3:].double() - gyros.shown) / drive.rate_hz
    turns = prefix_rotations(phi.permute(2, 0, 1).contiguous())[..., -1].permute(2, 0, 1)
    for turn in turns.flip(0):
        C = C @ turn.mT
    return C


def carry_level(
    drive: Drive, rest: Bool[Tensor, " epochs"], row: int, gyros: Gyros
) -> tuple[Float[Tensor, " 3"], float] | None:
    """Mean specific force [m/s²] of the last standstill before boundary ``row`` in the axes there, and 1σ [rad] of its
    direction; None where there is none."""
    stops = find_runs(rest[:row])
    if not stops:
        return None
    first, last = stops[-1]
    force = drive.imu[first:last, :, :3].double().mean((0, 1))
    C = carry_attitude_back(drive, torch.eye(3, dtype=torch.float64), row, last, gyros, rest)  # C_b(row)b(last)
    std = float(carry_std(drive, torch.arange(last, row), gyros, rest)[-1])
    return C @ force, math.hypot(SPREAD_STD, std)


def carry_std(
    drive: Drive, epochs: Int[Tensor, " n"], gyros: Gyros, rest: Bool[Tensor, " epochs"]
) -> Float[Tensor, " n+1"]:
    """1σ [rad] that carrying an attitude over the first 0, 1, … n of these epochs adds.

    Gyroscope error times time in motion, and scale factor times angle turned.
    """
    moving = (~rest[epochs]).double()
    phi = (drive.imu[epochs][..., 3:].double().mean(1) - gyros.shown) * (drive.epoch_s * moving)[:, None]
    spread = torch.hypot(gyros.std * drive.epoch_s * moving.cumsum(0), RATE_SCALE_STD * phi.cumsum(0).norm(dim=-1))
    return torch.nn.functional.pad(spread, (1, 0))
