"""The small recurrent network of ``plus``, and what it sees of a window's samples.

Nothing depends on the direction of driving: all vectors are in body axes. Nothing depends on the IMU's rate: the
samples enter by their means and by their variances in bands of frequency that every rate of 50 Hz or more has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dlkf.errors import InputError

BANDS_HZ = (0.5, 1.5, 3.5, 5.5, 8.5, 12.5, 16.5, 20.5, 25.5)  # edges; below 0.5 Hz is the car's own motion
LEAST_RATE_HZ = 50.0  # of samples that have all bands
SMALLEST_POWER = (1e-7, 1e-11)  # (m/s²)², (rad/s)²: added to the variance of a band
MEAN_SIZE = (2.0, 2.0, 2.0, 0.1, 0.1, 0.2)  # m/s², rad/s
WINDOW_FEATURES = 6 + 6 * (len(BANDS_HZ) - 1)

# heads: how far a factor may go from 1, as its logarithm
PROCESS_REACH = (math.log(30.0), math.log(30.0), math.log(100.0), math.log(100.0))
FIX_REACH, ACROSS_REACH = math.log(30.0), math.log(30.0)
OFFSET_REACH = 0.5  # m/s
RESIDUAL_REACH = (0.02,) * 3 + (math.radians(0.02),) * 3  # m/s², rad/s
UNTRUSTED = 100.0  # factor on the 1σ of a speed whose network says nothing: no speed is then used
TRUST_REACH = math.log(UNTRUSTED)  # from 1 to the square of that
TRUST_START = -TRUST_REACH  # where training begins: a factor of 3, for errors of a speed last
AXIS_HIDDEN = 24
NOISE_SIZES = {"process": 12, "fix": 4, "across": 2, "offset": 2, "residual": 6}


@dataclass(frozen=True)
class PlusNetworkConfig:
    """Width of the recurrent layer and what goes into it."""

    hidden: int = 96
    features: int = 0  # set by the filter, as the next
    of_axis: int = 0

    def __post_init__(self) -> None:
        if not 8 <= self.hidden <= 256:
            raise InputError(f"model.network.hidden is {self.hidden}, must be between 8 and 256")


class Heads(NamedTuple):
    """What the network says of an epoch, in physical size; of size zero where its weights are."""

    process: Tensor  # (B, 4, 3) factors
    fix: Tensor  # (B, 4) factors
    across: Tensor  # (B, 2) factors
    offset: Tensor  # (B, 2) m/s
    residual: Tensor  # (B, 6) m/s², rad/s
    doubt: Tensor  # (B,) factor on the 1σ of the forward speed

    def where(self, told: Bool[Tensor, " B"]) -> Heads:
        """Where ``told`` is false factors of 1 and offsets of 0 instead; the doubt stays."""
        neutral = (1.0, 1.0, 1.0, 0.0, 0.0)
        of = ((told[(..., *(None,) * (x.ndim - 1))], x, y) for x, y in zip(self[:5], neutral, strict=True))
        return Heads._make((*(torch.where(*x) for x in of), self.doubt))


class PlusNetwork(nn.Module):
    """Linear, GRU, linear heads; those of the noise begin at zero.

    What one axis' samples and corrections say goes also through a small network that is the same for all three.
    """

    def __init__(self, config: PlusNetworkConfig, now: int) -> None:
        super().__init__()
        self.config = config
        self.inward = nn.Linear(config.features, config.hidden)
        self.memory = nn.GRUCell(config.hidden, config.hidden)
        self.noise = nn.Linear(config.hidden + now, sum(NOISE_SIZES.values()))
        self.trust = nn.Linear(config.hidden, 1)
        self.context = nn.Linear(config.hidden, AXIS_HIDDEN)
        self.of_axis = nn.Linear(config.of_axis, AXIS_HIDDEN)
        self.axis_noise = nn.Linear(AXIS_HIDDEN, len(PROCESS_REACH))
        for gate in self.memory.weight_hh.data.chunk(3):
            nn.init.orthogonal_(gate)
        self.memory.bias_hh.data.zero_()
        # a slow memory: the update gate begins nearly shut
        self.memory.bias_ih.data.zero_()
        self.memory.bias_ih.data[config.hidden : 2 * config.hidden] = 1.0
        for head in (self.noise, self.trust, self.axis_noise):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)
        nn.init.constant_(self.trust.bias, TRUST_START)

    def start(self, batch_size: int) -> Float[Tensor, "B h"]:
        """Empty memory."""
        return self.inward.weight.new_zeros(batch_size, self.config.hidden)

    def forward(
        self, features: Float[Tensor, "B F"], now: Float[Tensor, "B N"], axes: Float[Tensor, "B 3 A"],
        memory: Float[Tensor, "B h"],
    ) -> tuple[Heads, Float[Tensor, "B h"]]:  # fmt: skip
        """One epoch; ``now`` goes past the memory to the heads of the noise, ``axes`` to that of each axis' own."""
        h = self.memory(nn.functional.silu(self.inward(features)), memory)
        process, fix, across, offset, residual = self.noise(torch.cat((h, now), -1)).split(
            list(NOISE_SIZES.values()), -1
        )
        own = self.axis_noise(nn.functional.silu(self.of_axis(axes) + self.context(h).unsqueeze(1))).mT
        of_factors, of_residual = _reaches(h.dtype, h.device)
        factors = bounded(torch.cat((process + own.flatten(1), fix, across, self.trust(h)), -1), of_factors)
        process, fix, across, doubt = factors.split((12, 4, 2, 1), -1)
        return Heads(
            process.unflatten(-1, (4, 3)),
            fix,
            across,
            OFFSET_REACH * torch.tanh(offset),
            of_residual * torch.tanh(residual),
            UNTRUSTED * doubt.squeeze(-1),
        ), h


@lru_cache
@torch.inference_mode(False)
def _reaches(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Of the logarithms of process (12), fix (4), across (2) and doubt; of the residual (6)."""
    process = [reach for reach in PROCESS_REACH for _axis in range(3)]
    factors = [*process, *[FIX_REACH] * 4, *[ACROSS_REACH] * 2, TRUST_REACH]
    return torch.tensor(factors, dtype=dtype, device=device), torch.tensor(RESIDUAL_REACH, dtype=dtype, device=device)


def bounded(x: Tensor, reach: Tensor | float) -> Tensor:
    """exp(c tanh(x / c)): a factor that is 1 at zero, has the slope of exp there, and stays within exp(±c)."""
    return torch.exp(reach * torch.tanh(x / reach))


def window_features(samples: Float[Tensor, "B M 6"], dt: float) -> Float[Tensor, "B K"]:
    """Means and logarithms of the variances in bands of frequency of a window's corrected samples, body axes."""
    waves, inside = _fourier(samples.shape[1], dt, samples.dtype, samples.device)
    still, size, least, level = _sizes(samples.dtype, samples.device)
    mean = samples.mean(1)
    swing = torch.matmul((samples - mean.unsqueeze(1)).mT, waves).square()  # (B, 6, cosines and sines)
    bands = torch.matmul(swing, inside)
    return torch.cat((torch.asinh((mean - still) / size), ((torch.log(bands + least) - level) / 4).flatten(1)), -1)


@lru_cache
@torch.inference_mode(False)
def _fourier(M: int, dt: float, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(M, 2 w): cosines, then sines, under a Hann window, up to the last band; (2 w, bands): which belong to a band,
    scaled so that over all frequencies their squares sum to the variance."""
    taper = torch.hann_window(M, periodic=False, dtype=dtype, device=device)
    waves = torch.arange(min(M // 2, math.ceil(BANDS_HZ[-1] * M * dt)) + 1, device=device)
    turns = 2 * torch.pi / M * (torch.arange(M, device=device)[:, None] * waves % M).to(dtype)
    frequency = (waves / (M * dt))[:, None]
    edges = torch.tensor(BANDS_HZ, device=device)
    inside = ((frequency >= edges[:-1]) & (frequency < edges[1:])).to(dtype) * (2 / (M * taper.square().sum()))
    return torch.cat((torch.cos(turns), torch.sin(turns)), 1) * taper[:, None], inside.repeat(2, 1)


@lru_cache
@torch.inference_mode(False)
def _sizes(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean samples of a car at rest and their sizes (6,); least power and usual level of a band (6, 1)."""
    like = {"dtype": dtype, "device": device}
    still, size = torch.tensor((0.0, 0.0, -9.8, 0.0, 0.0, 0.0), **like), torch.tensor(MEAN_SIZE, **like)
    least, level = (torch.tensor(x, **like).repeat_interleave(3)[:, None] for x in (SMALLEST_POWER, (-6.0, -13.0)))
    return still, size, least, level


def loudness(heard: Float[Tensor, "B K"]) -> Float[Tensor, "B 6"]:
    """How much each axis shakes faster than 3.5 Hz, of a window's features: mean logarithm of those bands."""
    return heard[:, 6:].unflatten(-1, (6, len(BANDS_HZ) - 1))[..., 2:].mean(-1)
