"""The slow part of a receiver's position errors as three states, a Gauss-Markov process.

Multipath, orbits and atmosphere change over tens of seconds. A fix is predicted as position plus b̂, with

    b(t + T) = exp(−T/τ) b(t) + w,

where w has the variance by which the errors of positions have been seen to move in an interval
(:mod:`dlkf.filters.position_errors`). So a position is a mean over many τ, and neither it nor the velocity follows the
wander. b is in the axes of the tangent frame, which turn by less than a degree where the frame moves with the car.
A filter with the source :class:`dlkf.filters.aids.receiver.SlowErrors` has the states; ``plus`` drives them.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.filters.integration import Covariances, Epoch
from dlkf.navigation.state import POSITION, ErrorStates

NAMES = ("fix_error_north_m", "fix_error_east_m", "fix_error_down_m")
WANDER_S = 40.0  # s, τ


def has_slow_errors(states: ErrorStates) -> bool:
    """Whether a filter has these states."""
    return NAMES[0] in states.others


def of_slow_errors(states: ErrorStates) -> slice:
    """Their place among the error states."""
    first = states.of(NAMES[0]).start
    return slice(first, first + 3)


def select_slow_errors(parameters: Float[Tensor, "B k"], states: ErrorStates) -> Float[Tensor, "B 3"]:
    """b̂ among the estimates of the sources' parameters."""
    first = of_slow_errors(states).start - states.of_others.start
    return parameters[:, first : first + 3]


def predict_slow_errors(epoch: Epoch, slow: Float[Tensor, "B 3"]) -> Epoch:
    """The epoch with an innovation of which b̂ has been taken off."""
    z = epoch.z - torch.nn.functional.pad(slow, (0, 3)) * epoch.used
    return epoch._replace(z=z)


def join_slow_errors(P: Float[Tensor, "B n n"], states: ErrorStates) -> Float[Tensor, "B n n"]:
    """P with position plus b, which is what a fix shows, in the place of the position; itself without b."""
    if not has_slow_errors(states):
        return P
    P, slow = P.clone(), of_slow_errors(states)
    P[:, POSITION] += P[:, slow]
    P[:, :, POSITION] += P[:, :, slow]
    return P


def leave_out_slow_errors(
    epoch: Epoch, c: Covariances, slow: Float[Tensor, "B 3"], states: ErrorStates
) -> tuple[Epoch, Covariances]:
    """Innovation and H as if there were no such states; ``slow`` was taken off the innovation."""
    z = epoch.z + torch.nn.functional.pad(slow, (0, 3)) * epoch.used
    H = c.H.clone()
    H[..., of_slow_errors(states)] = 0
    return epoch._replace(z=z), c._replace(H=H)


def add_slow_columns(H: Float[Tensor, "B 6 n"], states: ErrorStates) -> Float[Tensor, "B 6 n"]:
    """H of a fix with the columns of b: 1 in its positions."""
    H = H.clone()
    H[:, POSITION, of_slow_errors(states)] = torch.eye(3, dtype=H.dtype, device=H.device)
    return H


def split_start(P: Float[Tensor, "B n n"], states: ErrorStates) -> Float[Tensor, "B n n"]:
    """P of a start whose position is that of a fix: b is as uncertain as that, and the position off by −b beside it."""
    slow, P = of_slow_errors(states), P.clone()
    variance = P[:, POSITION, POSITION].diagonal(dim1=-2, dim2=-1).clone()
    P[:, slow, slow] = torch.diag_embed(variance)
    F = torch.eye(P.shape[-1], dtype=P.dtype, device=P.device)
    F[POSITION, slow] = -torch.eye(3, dtype=P.dtype, device=P.device)
    return F @ P @ F.mT


def let_decay(P: Float[Tensor, "B n n"], states: ErrorStates, seconds: float) -> Float[Tensor, "B n n"]:
    """P after so long without w."""
    P, slow, share = P.clone(), of_slow_errors(states), decay(seconds)
    P[:, slow] *= share
    P[:, :, slow] *= share
    return P


def decay_estimates(parameters: Float[Tensor, "B k"], states: ErrorStates, seconds: float) -> Float[Tensor, "B k"]:
    """The estimates of the sources' parameters after so long."""
    first = of_slow_errors(states).start - states.of_others.start
    parameters = parameters.clone()
    parameters[:, first : first + 3] *= decay(seconds)
    return parameters


def let_wander(
    P: Float[Tensor, "B n n"], variance: Float[Tensor, "B 3"], fixed: Bool[Tensor, " B"], states: ErrorStates,
    seconds: float,
) -> Float[Tensor, "B n n"]:  # fmt: skip
    """P of :func:`let_decay` with w of this ``variance``; where there was no fix, so much that b stays as uncertain."""
    slow, P = of_slow_errors(states), P.clone()
    block = P[:, slow, slow]
    kept = block * (decay(seconds) ** -2 - 1)
    P[:, slow, slow] = block + torch.where(fixed[:, None, None], torch.diag_embed(variance), kept)
    return P


def decay(seconds: float) -> float:
    """exp(−T/τ)."""
    return math.exp(-seconds / WANDER_S)
