"""Slow errors of a receiver's positions as states: multipath, orbits and atmosphere, over tens of seconds.

    z = p_fix − p(x̂) − b̂,   H = [… 1 …] in the columns of b,   bₖ₊₁ = κ bₖ + noise of variance (1 − κ²) s²

with b in n, a first-order Gauss-Markov process of the receiver. A filter that takes these errors for white noise
averages over them and becomes too sure of its velocity; one whose position walks with them follows the receiver. With
b as a state it does neither. How large s² is and how fast b changes says the filter round it
(:mod:`dlkf.filters.position_errors`); until then both are zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.integration import Epoch
from dlkf.filters.sources import Parameter, SensorSource
from dlkf.navigation.state import POSITION, ErrorStates

NAMES = ("position_error_north_m", "position_error_east_m", "position_error_down_m")


class SlowErrors(SensorSource):
    """The states alone; the rows of the fix contain them."""

    parameters: ClassVar[Mapping[str, Parameter]] = {name: Parameter(std=0.0) for name in NAMES}


def has_slow_errors(states: ErrorStates) -> bool:
    """Whether a filter has these states."""
    return NAMES[0] in states.others


def subtract_slow_errors(epoch: Epoch, parameters: Mapping[str, Tensor]) -> Epoch:
    """The epoch with the innovation of a fix without its estimated slow errors, (B,) each."""
    errors = torch.stack([parameters[name] for name in NAMES], -1) * epoch.used[:, POSITION]
    return epoch._replace(z=torch.cat((epoch.z[:, POSITION] - errors, epoch.z[:, POSITION.stop :]), -1))


def add_columns(H: Float[Tensor, "B 6 n"], states: ErrorStates) -> Float[Tensor, "B 6 n"]:
    """H of a fix with the columns of the slow errors."""
    H, first = H.clone(), states.of(NAMES[0]).start
    H[:, POSITION, first : first + 3] = torch.eye(3, dtype=H.dtype, device=H.device)
    return H


class ErrorChange(NamedTuple):
    """What becomes of the slow errors in an update interval; they are states ``first`` to ``first`` + 3."""

    kept: Tensor  # (B, 3) κ
    added: Tensor  # (B, 3) m², variance by their process
    followed: Tensor  # (B, 3) m², more than that: in the position as well, with the opposite sign
    walk: Tensor  # (B, 3) m², of the position

    def propagate(self, P: Float[Tensor, "B n n"], first: int, *, follows: bool = True) -> Float[Tensor, "B n n"]:
        """P after it; ``follows``: so far the position has followed the fixes, with their errors."""
        errors = slice(first, first + 3)
        kept = self.shrink(torch.ones_like(P[:, 0]), first)
        P = kept.unsqueeze(-1) * P * kept.unsqueeze(1)
        added, walk = torch.diag_embed(self.added), torch.diag_embed(self.walk)
        if follows:
            followed = torch.diag_embed(self.followed)
            added, walk = added + followed, walk + followed
            P[:, POSITION, errors] -= followed
            P[:, errors, POSITION] -= followed
        P[:, errors, errors] += added
        P[:, POSITION, POSITION] += walk
        return P

    def shrink(self, x: Float[Tensor, "B k"], first: int) -> Float[Tensor, "B k"]:
        """Estimates after it."""
        return torch.cat((x[:, :first], self.kept * x[:, first : first + 3], x[:, first + 3 :]), -1)

    def add_decay(self, Phi: Float[Tensor, "B n n"], first: int) -> Float[Tensor, "B n n"]:
        """Φ of the interval with the decay in it, for a smoother."""
        errors = slice(first, first + 3)
        Phi = Phi.clone()
        Phi[:, errors, errors] = torch.diag_embed(self.kept)
        return Phi
