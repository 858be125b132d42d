"""Error-state model of the tangent-frame strapdown over one whole window (paper.md 2.1, 2.5–2.7).

Truth − estimate, order position, velocity, attitude, accelerometer error, gyroscope error, and where a filter
carries them the elements of the sensor matrices M (measured = (I + M) true + bias):

    δp' = δv
    δv' = G δp − 2W δv − [(C f̂)×] δh − C (ε + δM_a f̂)      W = [ω_ie×], G = ∂g/∂p
    δh' = −W δh − C (ζ + δM_g ω̂)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.navigation import compiled, compiled_transition
from dlkf.navigation.attitude import rotation_from_vector, skew
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, POSITION, STATES, VELOCITY, ErrorStates, NavState
from dlkf.navigation.strapdown import Window

# Response to a source acting at time τ of a window of length T grows like (T − τ)ⁿ: n per source and state
# block, none where the source does not reach the block within the window. In the order of the states driven.
SOURCES = {
    "accel_noise": (1, 0, None, None, None),  # through VELOCITY
    "gyro_noise": (2, 1, 0, None, None),  # ATTITUDE
    "accel_walk": (2, 1, None, 0, None),  # ACCEL
    "gyro_walk": (3, 2, 1, None, 0),  # GYRO
}
DRIVEN = slice(VELOCITY.start, GYRO.stop)  # four blocks of three columns of Φ, one per source
PLAIN = ErrorStates()
RATE_AVERAGE_S = 0.1  # of the mean rate at a boundary, in vehicle constraints and at a start
ARM_RATE_S = 0.02  # the same for the velocity of the lever arm: a mean of 0.1 s lags, and on roads the arm seems short


@dataclass(frozen=True)
class WindowModel:
    """What Φ and Q of all windows of a batch have in common; build with :func:`window_model`."""

    states: ErrorStates
    dt: float
    still: Tensor  # (B, n, n) Φ of a window in which nothing moves: Earth rotation, gravity gradient
    left: Tensor  # (2, M) time from each sample's middle to the end, and 1: integrates once and twice
    density: Tensor  # (1, 4) S of each noise source, the same for all drives
    walk: Tensor  # (n,) variance that a window adds to the states of the car and of further sensors

    @property
    def _over_window(self) -> Float[Tensor, " 4"]:
        """S T of each noise source."""
        return self.density[0] * (self.left.shape[1] * self.dt)

    @property
    def spread(self) -> Float[Tensor, "4 s s"]:
        """S ∫ (1−τ/T)^(nᵢ+nⱼ) dτ of each noise source."""
        return self._over_window[:, None, None] * _shares(self.density.dtype, self.density.device)

    def transition(
        self, start: NavState, window: Window, corrected: Float[Tensor, "B M 6"], frame: TangentFrame
    ) -> Float[Tensor, "B n n"]:
        """Φ of a whole window in closed form from prefix sums, no product of per-sample matrices.

        With s(t) the specific-force velocity gained since the window's start, C(t) the attitude and e a sensor
        error of unit size in body axes (constant for a bias, f̂ or ω̂ along an axis for an element of M),

            Φ_vh = −[s(T)×]   Φ_ph = −[∫s×]   Φ_he = −∫C e   Φ_ve = −∫C e (force), ∫[C f×] (∫C e) (rate)

        and once more integrated for position; Earth rotation, Coriolis and gravity gradient to first order in T.
        """
        if compiled.fits(corrected):
            elements = np.array(self.states.elements, dtype=np.int64).reshape(-1, 2)
            return compiled_transition.transition(
                self.still, start, window, corrected, frame.earth_rate_n, self.dt, elements
            )
        end, T = window.end, window.p_n.shape[1] * self.dt
        columns = self._sensor_columns(start, window, corrected)
        moved = end.p_n - start.p_n
        swept = torch.add((T / 3) * moved, start.v_n, alpha=T * T / 6)  # ∫(p − p₀), exact for constant acceleration
        coriolis = torch.linalg.cross(frame.earth_rate_n.unsqueeze(1), torch.stack((swept, moved), 1))
        fallen = T * window.gravity
        left = torch.add(start.v_n, fallen, alpha=0.5)
        s = torch.stack((torch.sub(moved, left, alpha=T), end.v_n - start.v_n - fallen), 1)
        Phi = self.still.clone()
        Phi[:, :6, ATTITUDE] = -skew(torch.add(s, coriolis, alpha=2)).flatten(1, 2)
        Phi[:, :9, ACCEL.start : self.states.navigation] = columns
        return Phi

    def noise(
        self, Phi: Float[Tensor, "B n n"], scale: Float[Tensor, "B 4 3 3"] | None = None
    ) -> Float[Tensor, "B n n"]:
        """Process noise Q of a whole window from the PSDs of its sources (paper.md 2.6, R016).

        Q = Σ_source S ∫ L(τ) L(τ)ᵀ dτ, where the response L(τ) to noise at time τ is the source's column of Φ
        shrunk by (1−τ/T)ⁿ: exact while attitude and specific force are constant over the window.
        ``scale`` multiplies the standard deviations of the sources, in the axes of their columns of Φ.
        """
        L = Phi[:, :STATES, DRIVEN].unflatten(-1, (4, 3)).transpose(1, 2)
        if scale is None:
            return self._accumulate(L)
        if torch.is_grad_enabled() and scale.requires_grad and not L.requires_grad:
            return _ProcessNoise.apply(L, scale, self)
        return self._accumulate(L @ scale)

    def noise_by_source(self, Phi: Float[Tensor, "B n n"], scale: Float[Tensor, "B 4 3 3"]) -> Float[Tensor, "B 4 s s"]:
        """What each source adds to :meth:`noise`."""
        L = Phi[:, :STATES, DRIVEN].unflatten(-1, (4, 3)).transpose(1, 2) @ scale
        return (L @ L.mT) * self.spread

    def _accumulate(self, L: Float[Tensor, "B 4 s 3"]) -> Float[Tensor, "B n n"]:
        if compiled.fits(L):
            shares = _shares(self.density.dtype, self.density.device)
            return compiled_transition.process_noise(L, self._over_window, shares, self.walk)
        Q = self.walk.diag() + L.new_zeros(len(L), 1, 1)
        Q[:, :STATES, :STATES] = ((L @ L.mT) * self.spread).sum(1)
        return Q

    def _sensor_columns(
        self, start: NavState, window: Window, corrected: Float[Tensor, "B M 6"]
    ) -> Float[Tensor, "B 9 k"]:
        """Columns of Φ of the biases and the elements of M.

        D = ∫C over a sample and g the velocity gained in it: a force error e gives the velocity −Σ D e, a rate error
        Σₖ gₖ × (Σ_{j<k} Dⱼ + Dₖ/2) e = Σⱼ (Σ_{k>j} gₖ + gⱼ/2) × Dⱼ e; for position each sample counts by the time
        that is left. Samples come last.
        """
        dt = self.dt
        C, v, (f, w) = window.C_nb.movedim(1, -1), window.v_n.mT, corrected.mT.contiguous().split(3, 1)
        C = torch.cat((start.C_nb.unsqueeze(-1), C), -1)
        turned = torch.add(C[..., :-1], C[..., 1:]).mul(0.5 * dt).unsqueeze(1)
        v = torch.cat((start.v_n.unsqueeze(-1), v), -1)
        gained = torch.sub(v[..., 1:] - v[..., :-1], window.gravity.unsqueeze(-1), alpha=dt)
        gained = self.left.unsqueeze(1) * gained.unsqueeze(1)  # (B, 2, 3, M): for position, for velocity
        later = gained.sum(-1, keepdim=True) - torch.sub(gained.cumsum(-1), gained, alpha=0.5)
        both = (len(turned), 2, *turned.shape[2:])
        lever = torch.linalg.cross(later.unsqueeze(3).expand(both), turned.expand(both), dim=2)
        force = self._sum_samples(-self.left[:, None, None] * turned, f)
        rate, tilt = self._sum_samples(lever, w), self._sum_samples(-turned, w)
        PV = torch.cat((force[..., :3], rate[..., :3], force[..., 3:], rate[..., 3:]), -1)
        zero = torch.zeros_like(tilt)
        A = torch.cat((zero[..., :3], tilt[..., :3], zero[..., 3:], tilt[..., 3:]), -1)
        return torch.cat((PV, A), 1)

    def _sum_samples(self, x: Float[Tensor, "B r 3 3 M"], e: Float[Tensor, "B 3 M"]) -> Float[Tensor, "B 3*r k"]:
        """Σ x over the samples for a bias, then Σ x[…, row] e[column] for the elements of M."""
        of_bias, matrix = x.sum(-1), self.states.matrix
        if matrix == "none":
            return of_bias.flatten(1, 2)
        if matrix == "scale":
            return torch.cat((of_bias, (x * e[:, None, None]).sum(-1)), -1).flatten(1, 2)
        rows, columns = (list(k) for k in zip(*self.states.elements))
        products = torch.bmm(x.flatten(1, 3), e.mT).unflatten(1, x.shape[1:4])
        return torch.cat((of_bias, products[..., rows, columns]), -1).flatten(1, 2)


class _ProcessNoise(torch.autograd.Function):
    """Q with its gradient in closed form where the scale W alone is learned: of every source, with A = L W and its
    spread σ, ∂W = Lᵀ ((∂Q + ∂Qᵀ) ∘ σ) A."""

    @staticmethod
    def forward(ctx, L, scale, model):
        A = L @ scale
        ctx.save_for_backward(L, A, model.spread)
        return model._accumulate(A)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        L, A, spread = ctx.saved_tensors
        G = g[:, :STATES, :STATES]
        return None, L.mT @ (((G + G.mT).unsqueeze(1) * spread) @ A), None


@lru_cache
@torch.inference_mode(False)
def _shares(dtype: torch.dtype, device: torch.device) -> Tensor:
    """1/(nᵢ + nⱼ + 1) of each noise source (4, s, s)."""
    powers = [[math.inf if p is None else p for p in n] for n in SOURCES.values()]
    order = torch.tensor(powers, dtype=dtype, device=device).repeat_interleave(3, -1)
    return 1 / (order.unsqueeze(2) + order.unsqueeze(1) + 1)


def window_model(
    frame: TangentFrame,
    dt: float,
    samples: int,
    psd: Mapping[str, float],
    *,
    states: ErrorStates = PLAIN,
    walk: Float[Tensor, " w"] | None = None,
) -> WindowModel:
    """The common part of the windows of a batch of frames.

    ``psd`` gives S of ``accel_noise`` [m²/s³], ``gyro_noise`` [rad²/s], ``accel_walk`` [m²/s⁵] and
    ``gyro_walk`` [rad²/s³]. ``walk`` is the PSD of the random walks of the states of the car, and of those of further
    sensors after them.
    """
    T, n = samples * dt, states.count
    like = {"dtype": frame.earth_rate_n.dtype, "device": frame.earth_rate_n.device}
    W, eye = skew(frame.earth_rate_n), torch.eye(3, **like)
    gradient = torch.diag_embed(frame.gravity_gradient())
    still = torch.eye(n, **like).repeat(len(W), 1, 1)
    still[:, POSITION, POSITION] += 0.5 * T * T * gradient
    still[:, POSITION, VELOCITY] = T * eye - T * T * W
    still[:, VELOCITY, POSITION] = T * gradient
    still[:, VELOCITY, VELOCITY] -= 2 * T * W
    still[:, ATTITUDE, ATTITUDE] = rotation_from_vector(-T * frame.earth_rate_n)
    left = T - (torch.arange(samples, **like) + 0.5) * dt
    density = torch.tensor([[psd[source] for source in SOURCES]], **like)
    drift = torch.zeros(n, **like)
    if walk is not None:
        drift[states.navigation :] = T * walk.to(**like)
    return WindowModel(states, dt, still, torch.stack((left, torch.ones_like(left))), density, drift)


def antenna(
    state: NavState, rate_b: Float[Tensor, "B 3"], lever_arm_b: Float[Tensor, "B 3"] | None, frame: TangentFrame
) -> Float[Tensor, "B 6"]:
    """Position and velocity of the antenna in n (paper.md 2.5).

    ``rate_b`` is the corrected angular rate at the fix [rad/s], ``lever_arm_b`` IMU → antenna [m], None for none.
    """
    if lever_arm_b is None:
        return torch.cat((state.p_n, state.v_n), -1)
    arm_n, arm_velocity_n = _rotate_arm(state, rate_b, lever_arm_b)
    velocity = state.v_n + arm_velocity_n - torch.linalg.cross(frame.earth_rate_n, arm_n)
    return torch.cat((state.p_n + arm_n, velocity), -1)


def measurement_matrix(
    state: NavState,
    rate_b: Float[Tensor, "B 3"],
    lever_arm_b: Float[Tensor, "B 3"] | None,
    frame: TangentFrame,
    states: int = STATES,
) -> Float[Tensor, "B 6 n"]:
    """H of antenna position and velocity with the lever arm in it (paper.md 2.5)."""
    H = _identity(states, rate_b.dtype, rate_b.device) + rate_b.new_zeros(len(rate_b), 1, 1)
    if lever_arm_b is not None:
        arm_n, arm_velocity_n = _rotate_arm(state, rate_b, lever_arm_b)
        H[:, :3, ATTITUDE] = -skew(arm_n)
        H[:, 3:, ATTITUDE] = -skew(arm_velocity_n) + skew(frame.earth_rate_n) @ skew(arm_n)
        H[:, 3:, GYRO] = state.C_nb @ skew(lever_arm_b)
    return H


def source_scale(factors: Float[Tensor, "B 4 3"], C_nb: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 4 3 3"]:
    """Factors on the noise sources' standard deviations, given along the body's axes, in the axes of Φ's columns.

    White noise enters through velocity and attitude, whose columns are in n: I + C diag(f − 1) Cᵀ, which is I to the
    bit where all factors are 1; the walks drive the biases, whose columns are in b.
    """
    excess = torch.diag_embed(factors - 1)
    white = C_nb.unsqueeze(1) @ excess[:, :2] @ C_nb.mT.unsqueeze(1)
    return torch.eye(3, dtype=factors.dtype, device=factors.device) + torch.cat((white, excess[:, 2:]), 1)


@lru_cache
@torch.inference_mode(False)
def _identity(states: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.eye(6, states, dtype=dtype, device=device)


def _rotate_arm(state: NavState, rate_b: Tensor, lever_arm_b: Tensor) -> tuple[Tensor, Tensor]:
    """The lever arm l and its velocity ω × l in n."""
    both = torch.stack((lever_arm_b, torch.linalg.cross(rate_b, lever_arm_b)), -1)
    arm, velocity = (state.C_nb @ both).unbind(-1)
    return arm, velocity


def mask_rows(
    H: Float[Tensor, "B m n"], R: Float[Tensor, "B m"], used: Bool[Tensor, "B m"]
) -> tuple[Float[Tensor, "B m n"], Float[Tensor, "B m"]]:
    """H and diagonal R in which unused components have no effect: zero row, unit variance."""
    return H * used.unsqueeze(-1), torch.where(used, R, 1.0)
