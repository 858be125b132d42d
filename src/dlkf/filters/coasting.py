"""Receivers that extrapolate: in a tunnel many give fixes for some seconds that go on as the last one, with its 1σ.

Position and velocity of such fixes agree with each other, so a gate follows them. But their velocity repeats, which
that of a measured fix does by chance alone, while the car brakes, turns or speeds up. So a velocity is no measurement
where it is that of the last fix within ``SAME`` (horizontally), while the INS, since the first fix with it, has gained
more than ``GAINED`` and ``SIGMAS`` of what tilt and biases explain; and so are those after it, until it changes. The
position is none either where it has moved as far as this velocity says, within ``ALONG``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.integration import Epoch
from dlkf.navigation.earth import STANDARD_GRAVITY
from dlkf.navigation.state import ACCEL, ATTITUDE

SAME = 0.01  # m/s: between two velocities of which the second is the first one
GAINED, SIGMAS = 0.3, 3.0  # m/s; 1σ of the INS
ALONG = 0.2  # m: between an extrapolated position and the last one moved on
LAST_S = 5.0  # between two fixes that are compared


class Coasting(NamedTuple):
    """What the velocity of the last fixes was, and the INS's change since it is the same."""

    place: Tensor  # (B, 2) m, of the last fix with a velocity
    velocity: Tensor  # (B, 2) m/s, of that fix; NaN: none
    age: Tensor  # (B,) s since that fix
    gained: Tensor  # (B, 2) m/s, by the INS since the first fix with it
    std: Tensor  # (B,) m/s, 1σ of that
    found: Tensor  # (B, 2) bool: position and velocity of the last fix are no measurements

    @classmethod
    def begin(cls, like: Tensor) -> Coasting:
        """No fix yet."""
        zeros, B = like.new_zeros, len(like)
        nothing = torch.full_like(zeros(B, 2), torch.nan)
        return cls(zeros(B, 2), nothing, zeros(B), zeros(B, 2), zeros(B), zeros(B, 2) > 0)

    def update(self, epoch: Epoch, P: Float[Tensor, "B n n"]) -> Coasting:
        """After an update interval that begins with the covariance ``P``."""
        moves, age = epoch.used[:, 3:5].all(-1), self.age + epoch.span_s
        place, velocity = epoch.fix.value[:, :2], epoch.fix.value[:, 3:5]
        gained = self.gained + (epoch.window.end.v_n - epoch.start.v_n)[:, :2]
        std = self.std + epoch.span_s * acceleration_variance(epoch, P).sqrt()  # an error of tilt stays
        same = moves & ((velocity - self.velocity).norm(dim=-1) < SAME) & (age < LAST_S + 0.5 * epoch.span_s)
        stale = same & (self.found[:, 1] | (gained.norm(dim=-1) > GAINED + SIGMAS * std))
        along = (place - self.place - age.unsqueeze(-1) * velocity).norm(dim=-1) < ALONG
        m, new = moves.unsqueeze(-1), moves & ~same
        return Coasting(
            torch.where(m, place, self.place), torch.where(m, velocity, self.velocity), torch.where(moves, 0.0, age),
            torch.where(new.unsqueeze(-1), 0.0, gained), torch.where(new, 0.0, std),
            torch.where(epoch.used.any(-1, keepdim=True), torch.stack((stale & along, stale), 1), self.found),
        )  # fmt: skip


def acceleration_variance(epoch: Epoch, P: Float[Tensor, "B n n"]) -> Float[Tensor, " B"]:
    """Of each component of the INS's acceleration [(m/s²)²]: what tilt makes of gravity, heading of the horizontal
    force, and the bias of the accelerometers."""
    variance = P.diagonal(dim1=-2, dim2=-1)
    force = epoch.corrected[..., :2].mean(1).square().sum(-1)
    tilt, heading = variance[:, ATTITUDE][:, :2].amax(-1), variance[:, ATTITUDE][:, 2]
    return STANDARD_GRAVITY**2 * tilt + force * heading + variance[:, ACCEL].amax(-1)
