"""The small recurrent network of ``plus``, and what it sees of a window's samples.

Nothing depends on the direction of driving: all vectors are in body axes. Nothing depends on the IMU's rate: the
samples enter by their means and by their variances in bands of frequency that every rate of 50 Hz or more has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from dlkf.errors import InputError

BANDS_HZ = (0.5, 1.5, 3.5, 5.5, 8.5, 12.5, 16.5, 20.5, 25.5)  # edges; below 0.5 Hz is the car's own motion
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
        return Heads(
            bounded(process.unflatten(-1, (4, 3)) + own, process.new_tensor(PROCESS_REACH)[:, None]),
            bounded(fix, FIX_REACH),
            bounded(across, ACROSS_REACH),
            OFFSET_REACH * torch.tanh(offset),
            residual.new_tensor(RESIDUAL_REACH) * torch.tanh(residual),
            UNTRUSTED * bounded(self.trust(h).squeeze(-1), TRUST_REACH),
        ), h


def bounded(x: Tensor, reach: Tensor | float) -> Tensor:
    """exp(c tanh(x / c)): a factor that is 1 at zero, has the slope of exp there, and stays within exp(±c)."""
    return torch.exp(reach * torch.tanh(x / reach))


def window_features(samples: Float[Tensor, "B M 6"], dt: float) -> Float[Tensor, "B K"]:
    """Means and logarithms of the variances in bands of frequency of a window's corrected samples, body axes."""
    M = samples.shape[1]
    mean = samples.mean(1)
    taper = torch.hann_window(M, periodic=False, dtype=samples.dtype, device=samples.device)
    swing = (samples - mean.unsqueeze(1)) * taper[:, None]
    waves = torch.arange(min(M // 2, math.ceil(BANDS_HZ[-1] * M * dt)) + 1, device=samples.device)
    turns = 2 * torch.pi / M * (waves[:, None] * torch.arange(M, device=samples.device) % M).to(samples.dtype)
    power = (torch.cos(turns) @ swing).square() + (torch.sin(turns) @ swing).square()  # Fourier, up to the last band
    power = power * (2 / (M * taper.square().sum()))  # sums over all frequencies to the variance
    frequency = waves / (M * dt)
    edges = torch.tensor(BANDS_HZ, device=samples.device)
    inside = ((frequency >= edges[:-1, None]) & (frequency < edges[1:, None])).to(samples.dtype)
    bands = (inside @ power).mT  # (B, 6, bands)
    least = samples.new_tensor(SMALLEST_POWER).repeat_interleave(3)[:, None]
    level = samples.new_tensor([-6.0] * 3 + [-13.0] * 3)[:, None]
    x = (mean - mean.new_tensor((0.0, 0.0, -9.8, 0.0, 0.0, 0.0))) / mean.new_tensor(MEAN_SIZE)
    return torch.cat((torch.asinh(x), ((torch.log(bands + least) - level) / 4).flatten(1)), -1)


def loudness(heard: Float[Tensor, "B K"]) -> Float[Tensor, "B 6"]:
    """How much each axis shakes faster than 3.5 Hz, of a window's features: mean logarithm of those bands."""
    return heard[:, 6:].unflatten(-1, (6, len(BANDS_HZ) - 1))[..., 2:].mean(-1)
