"""What a log does not know of its receiver: the age of a fix and of its velocity, its clock, where the antenna is.

With a delay d of the fixes and an antenna at l̂ = l + δl from the IMU, a fix that is stamped t is predicted as position
and velocity of the antenna at t − d (:func:`dlkf.navigation.error_model.antenna`): between two samples of the window,
and beyond its ends with the acceleration a there. H has −v_a and −a for δd (zero below ``MOVING``, where v_a is mostly
the filter's own error, which is in the innovation too), C and C [ω×] for δl, with v_a the velocity of the antenna, and
λ + d for the age of the fix. a is the change of velocity over ``SLOPE_S`` to either side, inside
the window: a mean over all of it lags when the car turns, and the delay seems too certain. A
receiver's clock that is fast by r against that of the IMU makes the delay grow, ḋ = r (:func:`let_delay_grow`).

Position and velocity of a fix are rarely of the same time: a velocity is a mean over a Doppler or carrier-phase
interval, and lags, as a position does that the receiver smooths. The velocity is thus predicted at t − d − e, with −a
of that time for δd and δe; the swing of the arm is that of the position. A filter with the source ``+receiver``
(:class:`Receiver`) estimates d, e, δl and r.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.filters.branches import may_branch, select_branch
from dlkf.filters.integration import Epoch, rate_before
from dlkf.filters.sources import Parameter, SensorSource
from dlkf.navigation.attitude import skew
from dlkf.navigation.error_model import ARM_RATE_S, antenna
from dlkf.navigation.state import POSITION, ErrorStates, NavState

DELAY = "fix_delay_s"
VELOCITY_DELAY = "velocity_delay_s"
ARM = ("lever_forward_m", "lever_right_m", "lever_down_m")
DRIFT = "clock_drift_ppm"
PPM = 1e-6
MOVING = 1.0  # m/s: a slower car shows no delay
SLOPE_S = 0.2  # s to either side of a fix, over which the acceleration is a mean

# sums of states that fixes show, by positions (0) and velocities (1): a velocity that of both delays
SHOWN = (((DELAY,), 0), ((DELAY, VELOCITY_DELAY), 1), *(((name,), 0) for name in ARM))


class Receiver(SensorSource):
    """Delays of fixes and velocities, antenna and clock; it has no rows of its own, those of the fix contain them."""

    parameters: ClassVar[Mapping[str, Parameter]] = {
        DELAY: Parameter(std=0.05, walk=1e-4, largest=0.9),
        VELOCITY_DELAY: Parameter(std=0.1, largest=1.0),
        **{name: Parameter(std=0.2, largest=2.0) for name in ARM},
        DRIFT: Parameter(std=100.0, walk=0.1, largest=1000.0),
    }


def has_receiver(states: ErrorStates) -> bool:
    """Whether a filter has these states."""
    return DELAY in states.others


def widen_start(P: Float[Tensor, "B n n"], start: NavState, states: ErrorStates) -> Float[Tensor, "B n n"]:
    """P of a start whose position is that of a fix: its error is δp + v δd − C δl with those of age and antenna."""
    k = states.of(ARM[0]).start
    F = torch.eye(P.shape[-1], dtype=P.dtype, device=P.device).repeat(len(P), 1, 1)
    F[:, POSITION, states.of(DELAY).start] = start.v_n
    F[:, POSITION, k : k + 3] = -start.C_nb
    return F @ P @ F.mT


def let_delay_grow(
    P: Float[Tensor, "B n n"], parameters: Float[Tensor, "B k"], states: ErrorStates, seconds: float
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B k"]]:
    """P and the estimates after so long without a fix: d + r t."""
    d, r, first = states.of(DELAY).start, states.of(DRIFT).start, states.of_others.start
    P, parameters, grows = P.clone(), parameters.clone(), PPM * seconds
    P[:, d] += grows * P[:, r]
    P[:, :, d] += grows * P[:, :, r]
    parameters[:, d - first] += grows * parameters[:, r - first]
    return P, parameters


def discount_information(
    P: Float[Tensor, "B n n"], dx: Float[Tensor, "B n"], parameters: Float[Tensor, "B k"], states: ErrorStates,
    kept: Float[Tensor, "B 2"],
) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"]]:  # fmt: skip
    """P and correction if only the share ``kept`` of the information of fixes about delays and antenna was justified,
    since the noise of their positions and velocities is larger than the filter took it for.

    Positions show the delay and the antenna, velocities the sum of both delays. With P₀ the variance of the prior,
    whose mean is zero, and x the estimate of such a quantity after its correction:

        1/P⁺ = 1/P₀ + s (1/P − 1/P₀),   x⁺ = x s P⁺/P

    that is a measurement of x with negative information. The other states change by their covariance with it.
    """
    if not has_receiver(states):
        return P, dx
    discounted = (kept < 1).any(-1)
    if may_branch(discounted) and not bool(discounted.any()):
        return P, dx
    before, first = (P, dx), states.of_others.start
    for names, part in SHOWN:
        which, share = [states.of(name).start for name in names], kept[:, part]
        column = P[:, which].sum(1)
        with torch.no_grad():
            x = (parameters[:, [k - first for k in which]] + dx[:, which]).sum(-1)
            variance = column[:, which].sum(-1)
            prior = sum(Receiver.parameters[name].std ** 2 for name in names)
            gained = (1 - variance / prior).clamp_min(0.0)  # the rest is the prior
            ratio = 1 / (1 - (1 - share) * gained)
            change = torch.where(gained > 0, x * (share * ratio - 1), 0.0) / variance
            factor = ((ratio - 1) / variance).unsqueeze(-1)
        P = P + (factor * column).unsqueeze(-1) * column.unsqueeze(1)
        dx = dx + change.unsqueeze(-1) * column
    return select_branch(discounted, P, before[0]), select_branch(discounted, dx, before[1])


def add_drift(Phi: Float[Tensor, "B n n"], states: ErrorStates, seconds: float) -> Float[Tensor, "B n n"]:
    """Φ of an update interval with the growth of the delay in it, for a smoother."""
    Phi = Phi.clone()
    Phi[:, states.of(DELAY).start, states.of(DRIFT).start] = PPM * seconds
    return Phi


def predict_fix(epoch: Epoch, parameters: Mapping[str, Tensor]) -> Epoch:
    """The epoch with the innovation, and the state at the fix, that estimates (B,) of delays and antenna give."""
    arm = torch.stack([parameters[name] for name in ARM], -1)
    if epoch.lever_arm_b is not None:
        arm = arm + epoch.lever_arm_b
    lag, M, dt = parameters[DELAY], epoch.imu.shape[1], epoch.dt
    if epoch.fix.lag is not None:
        lag = lag + epoch.fix.lag
    lag_v = lag + parameters[VELOCITY_DELAY]
    within, within_v = lag.clamp(0.0, M * dt), lag_v.clamp(0.0, M * dt)
    at_fix = epoch.window.interpolate_before(epoch.start, within, dt)
    few = max(1, min(M, round(ARM_RATE_S / dt)))
    rate, beyond = rate_before(epoch.corrected[..., 3:], within / dt, few), (lag - within).unsqueeze(-1)
    p, v = antenna(at_fix, rate, arm, epoch.frame).split(3, -1)
    p = p - beyond * v + 0.5 * beyond.square() * _acceleration(epoch, lag)
    v = v + epoch.window.velocity_before(epoch.start, within_v, dt) - at_fix.v_n
    v = v - (lag_v - within_v).unsqueeze(-1) * _acceleration(epoch, lag_v)
    z, fix = (epoch.fix.value - torch.cat((p, v), -1)) * epoch.used, epoch.fix._replace(lag=lag, velocity_lag=lag_v)
    return epoch._replace(at_fix=at_fix, rate_at_fix_b=rate, lever_arm_b=arm, z=z, fix=fix)


def add_columns(H: Float[Tensor, "B 6 n"], epoch: Epoch, states: ErrorStates) -> Float[Tensor, "B 6 n"]:
    """H with the columns of delays and antenna, for an epoch of :func:`predict_fix`."""
    H, C, k = H.clone(), epoch.at_fix.C_nb, states.of(ARM[0]).start
    v = antenna(epoch.at_fix, epoch.rate_at_fix_b, epoch.lever_arm_b, epoch.frame)[:, 3:]
    assert epoch.fix.velocity_lag is not None
    moves, a = v.norm(dim=-1, keepdim=True) > MOVING, _acceleration(epoch, epoch.fix.velocity_lag)
    H[:, :, states.of(DELAY).start] = torch.where(moves, -torch.cat((v, a), -1), 0.0)
    H[:, 3:, states.of(VELOCITY_DELAY).start] = torch.where(moves, -a, 0.0)
    H[:, :, k : k + 3] = torch.cat((C, C @ skew(epoch.rate_at_fix_b)), 1)
    return H


def _acceleration(epoch: Epoch, lag: Float[Tensor, " B"]) -> Float[Tensor, "B 3"]:
    """Mean over ``SLOPE_S`` to either side of ``lag`` seconds before the window's end, inside the window [m/s²]."""
    span, dt = epoch.imu.shape[1] * epoch.dt, epoch.dt
    least = min(SLOPE_S, 0.5 * span)
    middle = lag.clamp(0.0, span)
    late, early = (middle - least).clamp_min(0.0), (middle + least).clamp_max(span)
    gained = epoch.window.velocity_before(epoch.start, late, dt) - epoch.window.velocity_before(epoch.start, early, dt)
    return gained / (early - late).unsqueeze(-1)
