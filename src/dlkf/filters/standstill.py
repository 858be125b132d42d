"""Whether a car stands, from the samples of a window and from how this car sounds when it stands and when it moves.

Engines idle differently and IMUs are noisy differently, so no fixed limit on the samples' spread fits two cars: what
tells standing from moving is learned while GNSS tells which it is. A standstill is then a window that is nearer to
the quietest second of standing than to the quietest second of motion, without acceleration or turn (the hypothesis
of Skog et al. 2010, within what the filter is sure of), and not against the speed that the filter believes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.integration import Epoch
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, VELOCITY

GRAVITY = 9.81  # m/s²
SURE_STD = 0.3  # m/s: speeds with a larger 1σ teach nothing
STANDING_SPEED, MOVING_SPEED = 0.3, 1.5  # m/s: from which side on a second counts as the one or the other
APART = 10.0  # a moving car is so much livelier than a standing one, until the drive tells
TELLING = 2.0  # below this ratio the samples do not tell standing from moving
MEMORY_S = 100.0  # s of standing or moving in which what was heard of it grows by e: a wrong second is forgotten
STILL_ACCEL, STILL_RATE = 0.2, 0.01  # m/s², rad/s: with less, beyond 2σ of what the filter knows, a car may stand
PLAUSIBLE_SPEED, PLAUSIBLE_SIGMAS = 0.5, 3.0  # m/s, 1σ: a standstill must not contradict the filter


class Liveliness(NamedTuple):
    """What has been heard of a car: spread of specific force times spread of rate [m/s² rad/s]; inf: nothing yet."""

    standing: Tensor  # (B,) of the quietest second
    moving: Tensor  # (B,) likewise

    @classmethod
    def unheard(cls, like: Tensor, batch_size: int) -> Liveliness:
        """Of a car that has not been heard."""
        nothing = like.new_full((batch_size,), math.inf)
        return cls(nothing, nothing)

    def limit(self, prior: Float[Tensor, " 1"]) -> Float[Tensor, " B"]:
        """Half way, as logarithms, between standing and moving; near silence where the two sound alike."""
        moving = torch.where(self.moving.isinf(), prior, self.moving)
        standing = torch.where(self.standing.isinf(), moving / APART, self.standing)
        return torch.where(moving > TELLING * standing, (standing * moving).sqrt(), prior / APART)

    def heard(self, now: Tensor, standing: Tensor, moving: Tensor, span: float) -> Liveliness:
        """After a window of ``span`` seconds in which the car surely stood, or moved, or neither."""
        fade = math.exp(span / MEMORY_S)
        return Liveliness(
            torch.where(standing, torch.minimum(fade * self.standing, now), self.standing),
            torch.where(moving, torch.minimum(fade * self.moving, now), self.moving),
        )


@torch.no_grad()
def at_rest(
    epoch: Epoch, turning: Float[Tensor, "B 3"], P: Float[Tensor, "B n n"], before: Liveliness,
    prior: Float[Tensor, " 1"],
) -> tuple[Bool[Tensor, " B"], Liveliness]:  # fmt: skip
    """Whether the car stood in the window, and what has been heard since; ``turning`` is its mean rate [rad/s].

    Of one sample there is no spread: nothing is heard, and no standstill is found.
    """
    if epoch.imu.shape[1] < 2:
        return torch.zeros_like(before.standing) > 0, before
    swing = epoch.imu - epoch.imu.mean(1, keepdim=True)  # torch's var of a middle axis takes four times as long
    variance = swing.square().sum(1) / (epoch.imu.shape[1] - 1)
    force, rate = variance.unflatten(-1, (2, 3)).sum(-1).unbind(-1)
    lively = (force * rate).sqrt()
    span = epoch.dt * epoch.imu.shape[1]
    v, diagonal = epoch.window.end.v_n, P.diagonal(dim1=-2, dim2=-1)
    speed, std = v[:, :2].norm(dim=-1), diagonal[:, VELOCITY][:, :2].sum(-1).sqrt()
    tilt, accel = diagonal[:, ATTITUDE][:, :2].sum(-1), diagonal[:, ACCEL].sum(-1)
    gained = (v - epoch.start.v_n)[:, :2].norm(dim=-1) / span
    still = (gained < STILL_ACCEL + 2 * (GRAVITY**2 * tilt + accel).sqrt()) & (
        turning.norm(dim=-1) < STILL_RATE + 2 * diagonal[:, GYRO].sum(-1).sqrt()
    )
    sure = epoch.used[:, 3:5].all(-1) & (std < SURE_STD)
    after = before.heard(lively, sure & (speed + std < STANDING_SPEED), sure & (speed - std > MOVING_SPEED), span)
    plausible = speed < PLAUSIBLE_SPEED + PLAUSIBLE_SIGMAS * std
    return (lively <= after.limit(prior)) & still & plausible, after
