"""Strapdown by the window: position, velocity and attitude after every sample, without a loop over samples.

Inside a window the IMU error is constant, so attitude is a prefix product of rotations and velocity and
position are prefix sums. In the tangent frame n, which is fixed to the Earth (checklist 2.1, 2.3),

    C' = C [w_b×] − [ω×] C,    v' = C f_b + g(p) − 2 ω × v,    p' = v,    ω = Earth rate.

Rate and specific force are constant within a sample (they are its means) and integrated exactly, gravity is
taken at the window's midpoint, Earth rotation and Coriolis are exact to first order in ωT: with
S = Σ ΔV and P = Σ ΔP the velocity and position gained from specific force, integration by parts leaves

    v(t) = v₀ + g t + S − ω × (t S + P + 2 v₀ t + g t²)
    p(t) = p₀ + v₀ t + g t²/2 + P − ω × (t P + v₀ t² + g t³/3).

The gradient is written out by hand (the adjoint of a prefix product is a suffix sum), which costs one
forward pass instead of a graph of some hundred nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation.attitude import orthonormalised, prefix_rotations, skew
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState


class Window(NamedTuple):
    """What the strapdown made of one window of M samples: the state at the end of each sample."""

    p_n: Tensor  # (B, M, 3) m
    v_n: Tensor  # (B, M, 3) m/s
    C_nb: Tensor  # (B, M, 3, 3)

    @property
    def end(self) -> NavState:
        """State at the end of the window."""
        return NavState(self.p_n[:, -1], self.v_n[:, -1], self.C_nb[:, -1])

    def before(self, lag: Float[Tensor, " B"], dt: float) -> NavState:
        """State ``lag`` seconds before the window's end, linear between samples (0 ≤ lag < window)."""
        M = self.p_n.shape[1]
        place = (M - 1 - lag / dt).clamp(0, M - 1)
        low = place.floor().clamp(max=max(M - 2, 0)).long()
        high = (low + 1).clamp(max=M - 1)
        part = (place - low)[:, None]
        row = torch.arange(len(low), device=low.device)
        p = torch.lerp(self.p_n[row, low], self.p_n[row, high], part)
        v = torch.lerp(self.v_n[row, low], self.v_n[row, high], part)
        C = torch.lerp(self.C_nb[row, low], self.C_nb[row, high], part[..., None])
        return NavState(p, v, orthonormalised(C))


def strapdown(
    start: NavState,
    imu: Float[Tensor, "B M 6"],
    dt: float,
    frame: TangentFrame,
) -> Window:
    """Mechanise one window of corrected IMU samples (specific force m/s², rate rad/s) from ``start``.

    Differentiable in the start state and the samples; attitude gradients live in the tangent space of SO(3).
    """
    with torch.no_grad():
        half = 0.5 * dt * imu.shape[1]
        gravity = frame.gravity(start.p_n + half * start.v_n)
    p, v, C = _Strapdown.apply(
        start.p_n, start.v_n, start.C_nb, imu, dt, gravity, frame.gravity_gradient(), frame.earth_rate_n
    )
    return Window(p, v, C)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=-1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


class _Strapdown(torch.autograd.Function):
    """Forward and adjoint of the window; lower-case names follow the module's equations."""

    @staticmethod
    def forward(ctx, p0, v0, C0, imu, dt, g, gradient, earth_rate):
        f, phi = imu[..., :3], imu[..., 3:] * dt
        B, M = phi.shape[:2]
        R = prefix_rotations(phi)
        R_before = torch.cat((torch.eye(3, dtype=R.dtype, device=R.device).expand(B, 1, 3, 3), R[:, :-1]), 1)
        # mean of exp(s φ) over the sample, once for velocity, twice integrated for position
        turn = _cross(phi, f)
        turn2 = _cross(phi, turn)
        f1 = f + turn / 2 + turn2 / 6
        f2 = f / 2 + turn / 6 + turn2 / 24
        gained = (R_before * f1.unsqueeze(-2)).sum(-1) * dt @ C0.mT  # ΔV per sample in n
        moved = (R_before * f2.unsqueeze(-2)).sum(-1) * dt**2 @ C0.mT
        S = gained.cumsum(1)
        P = (moved + dt * (S - gained)).cumsum(1)
        t = torch.arange(1, M + 1, dtype=phi.dtype, device=phi.device)[:, None] * dt
        w, v, gn = earth_rate.unsqueeze(1), v0.unsqueeze(1), g.unsqueeze(1)
        v_n = v + gn * t + S - _cross(w, t * (S + 2 * v + gn * t) + P)
        p_n = p0.unsqueeze(1) + t * (v + 0.5 * gn * t) + P - _cross(w, t * (P + t * (v + gn * t / 3)))
        A = (R.mT.reshape(B, 3 * M, 3) @ C0.mT).reshape(B, M, 3, 3).mT  # C0 R
        C_nb = A - t.unsqueeze(-1) * (skew(earth_rate).unsqueeze(1) @ A)
        C_nb = torch.cat((C_nb[:, :-1], orthonormalised(C_nb[:, -1:])), 1)
        ctx.save_for_backward(imu, C0, A, gained, moved, gradient, earth_rate)
        ctx.dt = dt
        return p_n, v_n, C_nb

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, Gp, Gv, GC):
        imu, C0, A, gained, moved, gradient, earth_rate = ctx.saved_tensors
        dt = ctx.dt
        f, phi = imu[..., :3], imu[..., 3:] * dt
        M = phi.shape[1]
        t = torch.arange(1, M + 1, dtype=phi.dtype, device=phi.device)[:, None] * dt
        w = earth_rate.unsqueeze(1)
        Hv, Hp = _cross(w, Gv), _cross(w, Gp)
        grad_g = (t * (Gv + 0.5 * t * Gp + t * Hv + t * t * Hp / 3)).sum(1)
        grad_v0 = (Gv + t * (Gp + 2 * Hv + t * Hp)).sum(1) + 0.5 * M * dt * gradient * grad_g
        grad_p0 = Gp.sum(1) + gradient * grad_g
        # suffix sums: what each ΔP and ΔV in n is worth
        U = _suffix_sum(Gp + Hv + t * Hp)
        V = _suffix_sum(Gv + t * Hv) + dt * (_suffix_sum(U) - U)
        # attitude: tangent gradient in n at each sample's start and end
        GA = GC + t.unsqueeze(-1) * (skew(earth_rate).unsqueeze(1) @ GC)
        tau_end = _axial(GA, A)
        tau_start = _cross(gained, V) + _cross(moved, U)
        T = _suffix_sum(tau_end) + _suffix_sum(tau_start) - tau_start  # at the end of each sample
        grad_theta = T[:, 0] + tau_start[:, 0]
        A_before = torch.cat((C0.unsqueeze(1), A[:, :-1]), 1)
        to_body = (A_before * V.unsqueeze(-1)).sum(-2) * dt
        to_body2 = (A_before * U.unsqueeze(-1)).sum(-2) * dt**2
        e0 = to_body + to_body2 / 2
        e1 = to_body / 2 + to_body2 / 6
        e2 = to_body / 6 + to_body2 / 24
        grad_f = e0 + _cross(e1, phi) + _cross(phi, _cross(phi, e2))
        torque = (A * T.unsqueeze(-1)).sum(-2)
        spin = _cross(phi, torque)
        spin2 = _cross(phi, spin)
        grad_phi = torque + spin / 2 + spin2 / 6 + _cross(phi, spin2) / 24
        grad_phi = grad_phi + _cross(f, e1) + e2 * _dot(phi, f) + f * _dot(e2, phi) - 2 * phi * _dot(f, e2)
        grad_C0 = 0.5 * skew(grad_theta) @ C0
        return grad_p0, grad_v0, grad_C0, torch.cat((grad_f, grad_phi * dt), -1), None, None, None, None


def _suffix_sum(x: Tensor) -> Tensor:
    return x.sum(1, keepdim=True) - x.cumsum(1) + x


def _axial(G: Tensor, A: Tensor) -> Tensor:
    """g with tr(Gᵀ [δ×] A) = g·δ: the sum over columns of A_col × G_col."""
    return torch.linalg.cross(A, G, dim=-2).sum(-1)
