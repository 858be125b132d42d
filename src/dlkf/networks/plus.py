"""The small recurrent network of ``plus``, and its features of a window's samples.

Nothing depends on the direction of driving: all vectors are in body axes. Nothing depends on the IMU's rate: the
samples enter by their means and by their variances in bands of frequency that every rate of 50 Hz or more has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dlkf.base.errors import InputError
from dlkf.networks.products import GRUCell

BANDS_HZ = (0.5, 1.5, 3.5, 5.5, 8.5, 12.5, 16.5, 20.5, 25.5)  # edges; below 0.5 Hz is the car's own motion
LEAST_RATE_HZ = 50.0  # of samples that have all bands
SMALLEST_POWER = (1e-7, 1e-11)  # (m/s²)², (rad/s)²: added to the variance of a band
MEAN_SIZE = (2.0, 2.0, 2.0, 0.1, 0.1, 0.2)  # m/s², rad/s
WINDOW_FEATURES = 6 + 6 * (len(BANDS_HZ) - 1)

REACH = 2.72  # how far a factor may go from 1, as its logarithm: 15 times
AXIS_HIDDEN = 24


@dataclass(frozen=True)
class PlusNetworkConfig:
    """Width of the recurrent layer and what goes into it."""

    hidden: int = 96
    features: int = 0  # set by the filter, as the next
    of_axis: int = 0

    def __post_init__(self) -> None:
        if not 8 <= self.hidden <= 256:
            raise InputError(f"model.network.hidden is {self.hidden}, must be between 8 and 256")


class PlusNetwork(nn.Module):
    """Linear, GRU, linear output; that begins at zero.

    The features of one axis' samples and corrections also go through a small network that is the same for all three.
    """

    def __init__(self, config: PlusNetworkConfig, now: int) -> None:
        super().__init__()
        self.config = config
        self.inward = nn.Linear(config.features, config.hidden)
        self.memory = GRUCell(config.hidden, config.hidden)
        self.noise = nn.Linear(config.hidden + now, 3)
        self.context = nn.Linear(config.hidden, AXIS_HIDDEN)
        self.of_axis = nn.Linear(config.of_axis, AXIS_HIDDEN)
        self.axis_noise = nn.Linear(AXIS_HIDDEN, 1)
        for gate in self.memory.weight_hh.data.chunk(3):
            nn.init.orthogonal_(gate)
        self.memory.bias_hh.data.zero_()
        # a slow memory: the update gate begins nearly shut
        self.memory.bias_ih.data.zero_()
        self.memory.bias_ih.data[config.hidden : 2 * config.hidden] = 1.0
        for head in (self.noise, self.axis_noise):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def start(self, batch_size: int) -> Float[Tensor, "B h"]:
        """Empty memory."""
        return self.inward.weight.new_zeros(batch_size, self.config.hidden)

    def forward(
        self, features: Float[Tensor, "B F"], now: Float[Tensor, "B N"], axes: Float[Tensor, "B 3 A"],
        memory: Float[Tensor, "B h"],
    ) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B h"]]:  # fmt: skip
        """Factors on the gyroscopes' noise in one epoch (forward, right, down), and the memory after it; ``now`` goes
        past the memory to the output, ``axes`` to that of each axis."""
        h = self.memory(nn.functional.silu(self.inward(features)), memory)
        own = self.axis_noise(nn.functional.silu(self.of_axis(axes) + self.context(h).unsqueeze(1))).squeeze(-1)
        return bound_factor(self.noise(torch.cat((h, now), -1)) + own, REACH), h


def bound_factor(x: Tensor, reach: Tensor | float) -> Tensor:
    """exp(c tanh(x / c)): a factor that is 1 at zero, has the slope of exp there, and stays within exp(±c)."""
    return torch.exp(reach * torch.tanh(x / reach))


def window_features(samples: Float[Tensor, "B M 6"], dt: float) -> Float[Tensor, "B K"]:
    """Means and logarithms of the variances in bands of frequency of a window's corrected samples, body axes."""
    even, odd, inside, late = _fourier(samples.shape[1], dt, samples.dtype, samples.device)
    still, size, least, level = _sizes(samples.dtype, samples.device)
    mean = samples.mean(1)
    swing = (samples - mean.unsqueeze(1)).mT
    half = len(late)
    first, middle, last = swing[..., :half], swing[..., half : len(even)], swing[..., late]  # from the middle alike
    cosines, sines = torch.cat((first + last, middle), -1) @ even, (first - last) @ odd
    bands = (cosines.square() + sines.square()) @ inside
    return torch.cat((torch.asinh((mean - still) / size), ((torch.log(bands + least) - level) / 4).flatten(1)), -1)


@lru_cache
@torch.inference_mode(False)
def _fourier(M: int, dt: float, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cosines (M − h, w) and sines (h, w) from the middle of M = 2 h (+ 1) samples under a Hann window, up to the last
    band; (w, bands): which belong to a band, scaled so that over all frequencies their squares sum to the variance;
    the second half from the end backwards (h,)."""
    taper = torch.hann_window(M, periodic=False, dtype=dtype, device=device)
    waves = torch.arange(min(M // 2, math.ceil(BANDS_HZ[-1] * M * dt)) + 1, device=device)
    turns = torch.pi / M * ((2 * torch.arange(M, device=device)[:, None] - (M - 1)) * waves % (2 * M)).to(dtype)
    frequency = (waves / (M * dt))[:, None]
    edges = torch.tensor(BANDS_HZ, device=device)
    inside = ((frequency >= edges[:-1]) & (frequency < edges[1:])).to(dtype) * (2 / (M * taper.square().sum()))
    cosines, sines = (f(turns) * taper[:, None] for f in (torch.cos, torch.sin))
    return cosines[: M - M // 2], sines[: M // 2], inside, torch.arange(M - 1, M - 1 - M // 2, -1, device=device)


@lru_cache
@torch.inference_mode(False)
def _sizes(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean samples of a car at rest and their sizes (6,); least power and usual level of a band (6, 1)."""
    like = {"dtype": dtype, "device": device}
    still, size = torch.tensor((0.0, 0.0, -9.8, 0.0, 0.0, 0.0), **like), torch.tensor(MEAN_SIZE, **like)
    least, level = (torch.tensor(x, **like).repeat_interleave(3)[:, None] for x in (SMALLEST_POWER, (-6.0, -13.0)))
    return still, size, least, level


def band_level(bands: Float[Tensor, "B K"]) -> Float[Tensor, "B 6"]:
    """How much each axis shakes faster than 3.5 Hz, of a window's features: mean logarithm of those bands."""
    return bands[:, 6:].unflatten(-1, (6, len(BANDS_HZ) - 1))[..., 2:].mean(-1)
