"""Which speed a car's vibrations tell: a regression on what a network hears, learned on each drive while GNSS is there.

The network makes K numbers φ out of a window's samples and never sees a speed; the forward speed is v = wᵀφ + e. What w
is on this car with this IMU is learned from the filter's own speed at every fix, by Bayesian linear regression with a
normal-inverse-gamma prior (Bishop 2006, 3.3; a network's last layer so adapted: Harrison, Sharma and Pavone 2018,
"Meta-learning priors for efficient online Bayesian regression"). So its 1σ says how well this car tells its speed: a
car that tells nothing has one as large as its speeds differ, and an unheard sound has a larger one.

    σ² = (b / a)(1 + φᵀPφ),  e = v − wᵀφ                   foretold, and how wrong
    k = Pφ / (ν + φᵀPφ),  w ← w + k e,  P ← P − k φᵀP      errors last: one epoch counts as 1 / ν
    a ← a + 1,  b ← b + e² / (1 + φᵀPφ)                    all fade to the prior over MEMORY fixes
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

TYPICAL_SPEED, PRIOR_COUNT, PRIOR_REPEATS = 10.0, 3.0, 2.5  # m/s, a, ν before anything was learned
PRIOR_STD = 3.0  # m/s
MEMORY = 600.0  # fixes
LEAST_STD = 0.3  # m/s
HIDDEN = 96


class Calibration(NamedTuple):
    """What a drive has told of its car so far."""

    mean: Tensor  # (B, K+1) w
    spread: Tensor  # (B, K+1, K+1) P
    count: Tensor  # (B,) a
    squares: Tensor  # (B,) b, m²/s²


class Foretold(NamedTuple):
    """A forward speed before anything of it was measured."""

    heard: Tensor  # (B, K+1) φ
    speed: Tensor  # (B,) m/s
    std: Tensor  # (B,) m/s
    novelty: Tensor  # (B,) φᵀPφ


class CarSpeed(nn.Module):
    """The network that listens, and the prior of its regression."""

    def __init__(self, features: int, numbers: int = 8) -> None:
        super().__init__()
        self.listen = nn.Sequential(
            nn.Linear(features, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, numbers)
        )
        self.prior = nn.Parameter(torch.zeros(numbers + 1))
        self.log_spread = nn.Parameter(torch.zeros(numbers + 1))
        self.log_sizes = nn.Parameter(torch.zeros(3))  # of σ, a and ν against their typical values

    def begin(self, batch_size: int) -> Calibration:
        """The prior."""
        mean, count, squares, _ = self._known()
        one = (mean, torch.diag_embed(torch.exp(2 * self.log_spread)), count, squares)
        return Calibration(*(x.expand(batch_size, *x.shape) for x in one))

    def forward(self, features: Float[Tensor, "B F"], known: Calibration) -> Foretold:
        """The speed of an epoch, of its samples alone."""
        heard = 3 * torch.tanh(self.listen(features) / 3)
        heard = torch.cat((heard, torch.ones_like(heard[:, :1])), -1)
        novelty = (heard * _times(known.spread, heard)).sum(-1).clamp_min(0.0)
        variance = known.squares / known.count * (1 + novelty)
        return Foretold(heard, (heard * known.mean).sum(-1), (variance + LEAST_STD**2).sqrt(), novelty)

    def learned(
        self, known: Calibration, foretold: Foretold, speed: Float[Tensor, " B"], fixed: Bool[Tensor, " B"]
    ) -> Calibration:
        """After the speed of an epoch with a fix; unchanged where there was none."""
        told = fixed.to(speed.dtype)
        prior_mean, prior_count, prior_squares, repeats = self._known()
        error = (speed - foretold.speed) * told
        along = _times(known.spread, foretold.heard)
        gain = along * (told / (repeats + foretold.novelty)).unsqueeze(-1)
        mean = known.mean + gain * error.unsqueeze(-1)
        spread = known.spread - gain.unsqueeze(-1) * along.unsqueeze(-2)
        fade = told / MEMORY
        information = torch.exp(-2 * self.log_spread)  # Λ₀; the information fades to it, to first order in fade
        return Calibration(
            mean + fade.unsqueeze(-1) * _times(spread, information * (prior_mean - mean)),
            spread + fade[:, None, None] * (spread - torch.bmm(spread, information.unsqueeze(-1) * spread)),
            torch.lerp(known.count + told, prior_count, fade),
            torch.lerp(known.squares + error * error / (1 + foretold.novelty), prior_squares, fade),
        )

    def _known(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """w, a, b and ν before anything was learned."""
        typical = self.log_sizes.new_tensor([math.log(x) for x in (PRIOR_STD, PRIOR_COUNT, PRIOR_REPEATS)])
        std, count, repeats = torch.exp(self.log_sizes + typical).unbind()
        typical_speed = nn.functional.pad(self.prior.new_full((1,), TYPICAL_SPEED), (len(self.prior) - 1, 0))
        return self.prior + typical_speed, count, count * std * std, repeats


def _times(P: Float[Tensor, "B k k"], x: Float[Tensor, "B k"]) -> Float[Tensor, "B k"]:
    return torch.bmm(P, x.unsqueeze(-1)).squeeze(-1)
