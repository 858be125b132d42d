"""Errors of receivers and IMUs that are added to drives: each kind a function of a drive and a generator."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from dlkf.data.drive import Drive

LASTS_S, EVERY_S = 10, (20, 60)  # of a step in positions, and the time between two
BIASES_LAST_S = (60, 180)  # between two steps of biases
LONGEST_S = 3600
Change = Callable[[Drive, torch.Generator], Drive]


def positions(share: float, size: float) -> Change:
    """Errors of 1σ ``size`` per axis [m] in a share of the seconds."""
    return lambda drive, g: replace(drive, gnss_r_e=drive.gnss_r_e + _single(share, size, len(drive.gnss_r_e), g))


def velocities(share: float, size: float) -> Change:
    """Errors of 1σ ``size`` per axis [m/s] in a share of the seconds."""
    return lambda drive, g: replace(drive, gnss_v_e=drive.gnss_v_e + _single(share, size, len(drive.gnss_v_e), g))


def _single(share: float, size: float, count: int, g: torch.Generator) -> Tensor:
    hit = torch.rand(LONGEST_S, 1, generator=g, dtype=torch.float64) < share
    return (hit * size * torch.randn(LONGEST_S, 3, generator=g, dtype=torch.float64))[:count]


def steps(size: float, stated: float | None = None) -> Change:
    """One error [m] of 1σ ``size`` per axis for ``LASTS_S`` seconds, again and again, ``stated`` as so much [m]."""

    def change(drive: Drive, g: torch.Generator) -> Drive:
        r_e, std, k = drive.gnss_r_e.clone(), drive.gnss_std.clone(), 0
        while k < len(r_e):
            k += int(torch.randint(*EVERY_S, (1,), generator=g))
            r_e[k : k + LASTS_S] += size * torch.randn(3, generator=g, dtype=torch.float64)
            if stated is not None:
                std[k : k + LASTS_S, :3] = stated
            k += LASTS_S
        return replace(drive, gnss_r_e=r_e, gnss_std=std)

    return change


def wandering(size: float, seconds: float) -> Change:
    """A Gauss-Markov process of 1σ ``size`` per axis [m] and that correlation time in the positions."""

    def change(drive: Drive, g: torch.Generator) -> Drive:
        kept = math.exp(-drive.epoch_s / seconds)
        error = size * torch.randn(len(drive.gnss_r_e), 3, generator=g, dtype=torch.float64)
        for k in range(1, len(error)):
            error[k] = kept * error[k - 1] + math.sqrt(1 - kept * kept) * error[k]
        return replace(drive, gnss_r_e=drive.gnss_r_e + error)

    return change


def late(drive: Drive, g: torch.Generator) -> Drive:
    """Velocities of the second before."""
    v_e, valid = drive.gnss_v_e.clone(), drive.gnss_valid.clone()
    v_e[1:] = drive.gnss_v_e[:-1]
    valid[1:, 3:] &= drive.gnss_valid[:-1, 3:]
    return replace(drive, gnss_v_e=v_e, gnss_valid=valid)


def averaged(drive: Drive, g: torch.Generator) -> Drive:
    """Positions that are the mean of this fix and the one before."""
    r_e, fixed = drive.gnss_r_e.clone(), drive.gnss_valid[:, :3].all(-1)
    both = (fixed[1:] & fixed[:-1]).unsqueeze(-1)
    r_e[1:] = torch.where(both, 0.5 * (r_e[1:] + drive.gnss_r_e[:-1]), r_e[1:])
    return replace(drive, gnss_r_e=r_e)


def extrapolated(seconds: int, noise: float = 0.0) -> Change:
    """Again and again fixes that continue the one before for so long, with its velocity or the one that led to it, and
    noise of the velocities [m/s]."""

    def change(drive: Drive, g: torch.Generator) -> Drive:
        r_e, v_e, k = drive.gnss_r_e.clone(), drive.gnss_v_e.clone(), 0
        while (k := k + int(torch.randint(*EVERY_S, (1,), generator=g))) < len(r_e):
            age = drive.epoch_s * torch.arange(1, 1 + min(seconds, len(r_e) - k), dtype=r_e.dtype).unsqueeze(-1)
            moves = drive.gnss_valid[k - 1, 3:].all()
            velocity = v_e[k - 1] if moves else (r_e[k - 1] - r_e[max(k - 2, 0)]) / drive.epoch_s
            r_e[k : k + seconds], v_e[k : k + seconds] = r_e[k - 1] + age * velocity, velocity
            if noise:
                v_e[k : k + seconds] += noise * torch.randn(len(age), 3, generator=g, dtype=torch.float64)
            k += seconds
        return replace(drive, gnss_r_e=r_e, gnss_v_e=v_e)

    return change


def biases(accel: float, gyro_dps: float) -> Change:
    """Accelerometers and gyroscopes off by so much RMS over their axes [m/s², °/s]."""

    def change(drive: Drive, g: torch.Generator) -> Drive:
        u = torch.nn.functional.normalize(torch.randn(2, 3, generator=g, dtype=torch.float64), dim=-1) * 3**0.5
        return replace(drive, imu=drive.imu + torch.cat((accel * u[0], np.radians(gyro_dps) * u[1])))

    return change


def gyro_scale(off: float) -> Change:
    """Gyroscopes that say so much more than is."""
    factor = torch.tensor([1.0] * 3 + [1 + off] * 3, dtype=torch.float64)
    return lambda drive, g: replace(drive, imu=drive.imu * factor)


def bias_steps(accel: float, gyro_dps: float) -> Change:
    """Biases that change by 1σ of so much per axis [m/s², °/s], again and again."""
    size = torch.tensor([accel] * 3 + [math.radians(gyro_dps)] * 3, dtype=torch.float64)

    def change(drive: Drive, g: torch.Generator) -> Drive:
        imu, k = drive.imu.clone(), 0
        while (k := k + int(torch.randint(*BIASES_LAST_S, (1,), generator=g) / drive.epoch_s)) < len(imu):
            imu[k:] += size * torch.randn(6, generator=g, dtype=torch.float64)
        return replace(drive, imu=imu)

    return change


ERRORS: Mapping[str, Change] = {
    "none": lambda drive, g: drive,
    "positions: 3 m in one of ten": positions(0.1, 3.0),
    "1 m in one of five": positions(0.2, 1.0),
    "30 m in one of twenty": positions(0.05, 30.0),
    "3 m for 10 s": steps(3.0),
    "0.3 m in all": positions(1.0, 0.3),
    "1 m in all": positions(1.0, 1.0),
    "3 m in all": positions(1.0, 3.0),
    "1 m that wanders over 30 s": wandering(1.0, 30.0),
    "velocities: 5 m/s in one of ten": velocities(0.1, 5.0),
    "0.5 m/s in all": velocities(1.0, 0.5),
    "those of a second before": late,
    "biases: 0.3 m/s², 1 °/s": biases(0.3, 1.0),
    "0.3 m/s², 2 °/s": biases(0.3, 2.0),
    "0.5 m/s², 3 °/s": biases(0.5, 3.0),
    "0.5 m/s², 5 °/s": biases(0.5, 5.0),
    "scale factors of the gyroscopes 1 % off": gyro_scale(0.01),
    "3 % off": gyro_scale(0.03),
    "biases that step by 0.1 m/s², 0.15 °/s": bias_steps(0.1, 0.15),
    "fixes extrapolated for 5 s": extrapolated(5),
    "the same, velocities with 3 cm/s of noise": extrapolated(5, 0.03),
    "2 m for 10 s, stated as 2.5 m": steps(2.0, 2.5),
    "positions that are means of two fixes": averaged,
}
OF_VELOCITIES = (  # of receivers that give them
    "velocities: 5 m/s in one of ten", "0.5 m/s in all", "those of a second before",
    "positions that are means of two fixes",
)  # fmt: skip
OF_IMU = ("biases: 0.3 m/s², 1 °/s", "0.3 m/s², 2 °/s", "0.5 m/s², 3 °/s", "0.5 m/s², 5 °/s")  # of real drives


def with_errors(drive: Drive, kind: str, draw: int = 0) -> Drive:
    """A drive with errors of that kind, always the same for a draw."""
    return ERRORS[kind](drive, torch.Generator().manual_seed(zlib.crc32(drive.name.encode()) + draw))
