"""Receivers that extrapolate: in a tunnel many give fixes for some seconds that go on as the last one, with its 1σ.

Position and velocity of such fixes agree with each other, so a gate follows them. But their velocity repeats, which
that of a measured fix does by chance alone, while the car brakes, turns or speeds up. So a velocity is no measurement
where it is that of the last fix within ``SAME`` (horizontally), while the INS, since the first fix with it, has gained
more than ``GAINED`` and ``SIGMAS`` of what tilt and biases explain; and so are those after it, until it changes. The
position is none either where it has moved as far as this velocity says, within ``ALONG``.

Of a receiver without velocities, the velocity is that between its last two positions, the same where the last one lies
within ``STRAIGHT`` of where those before it lead; it is a mean, and so is then that of the INS.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.integration import Epoch
from dlkf.filters.stationarity import acceleration_std
from dlkf.navigation.earth import STANDARD_GRAVITY
from dlkf.navigation.state import ACCEL, ATTITUDE

SAME = 0.01  # m/s: between two velocities of which the second is the first one
GAINED, SIGMAS = 0.1, 3.0  # m/s; 1σ of the INS
ALONG = 0.2  # m: between an extrapolated position and the last one moved on
STRAIGHT = 0.05  # m: the same of a receiver without velocities, whose positions the log rounds
LAST_S = 5.0  # between two fixes that are compared


class Coasting(NamedTuple):
    """What the velocity of the last fixes was, and the INS's change since it is the same."""

    place: Tensor  # (B, 2) m, of the last fix with a velocity, or with a position alone if that is long ago
    velocity: Tensor  # (B, 2) m/s, of that fix, or between it and the one before; NaN: none
    measured: Tensor  # (B,) bool: that fix has a velocity
    age: Tensor  # (B,) s since that fix
    lead: Tensor  # (B, 2) m/s, of the INS's velocity at the end of the last window over its mean in it
    gained: Tensor  # (B, 2) m/s, by the INS since the first fix with that velocity
    std: Tensor  # (B,) m/s, 1σ of that
    found: Tensor  # (B, 2) bool: position and velocity of the last fix are no measurements

    @classmethod
    def begin(cls, like: Tensor) -> Coasting:
        """No fix yet."""
        zeros, B = like.new_zeros, len(like)
        nothing = torch.full_like(zeros(B, 2), torch.nan)
        return cls(zeros(B, 2), nothing, zeros(B) > 0, zeros(B), zeros(B, 2), zeros(B, 2), zeros(B), zeros(B, 2) > 0)

    def update(self, epoch: Epoch, P: Float[Tensor, "B n n"]) -> Coasting:
        """After an update interval that begins with the covariance ``P``."""
        start, end, age = epoch.start, epoch.window.end, self.age + epoch.span_s
        recent, measured = age < LAST_S + 0.5 * epoch.span_s, epoch.used[:, 3:5].all(-1)
        alone = epoch.used[:, :2].all(-1) & ~measured & ~(self.measured & recent)
        fixed, of_fix = measured | alone, torch.where(measured | alone, measured, self.measured)
        place = epoch.fix.value[:, :2]
        between = (place - self.place) / age.unsqueeze(-1)
        velocity = torch.where(measured.unsqueeze(-1), epoch.fix.value[:, 3:5], between)

        mean = (end.p_n - start.p_n)[:, :2] / epoch.span_s  # of the INS, as ``between`` is one
        at_ends, of_means = (end.v_n - start.v_n)[:, :2], mean - start.v_n[:, :2] + self.lead
        gained = self.gained + torch.where(of_fix.unsqueeze(-1), at_ends, of_means)
        force_n = torch.bmm(end.C_nb, epoch.corrected[..., :3].mean(1).unsqueeze(-1)).squeeze(-1)
        std = self.std + epoch.span_s * acceleration_std(P, end.C_nb, force_n)  # an error of tilt stays

        change = (velocity - self.velocity).norm(dim=-1)
        same = fixed & recent & (change < torch.where(measured, SAME, STRAIGHT / age))
        stale = same & (self.found[:, 1] | (gained.norm(dim=-1) > GAINED + SIGMAS * std))
        along = (place - self.place - age.unsqueeze(-1) * velocity).norm(dim=-1) < ALONG
        f, new = fixed.unsqueeze(-1), fixed & ~same
        return Coasting(
            torch.where(f, place, self.place), torch.where(f, velocity, self.velocity), of_fix,
            torch.where(fixed, 0.0, age), end.v_n[:, :2] - mean,
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
