"""Strapdown by the window: position, velocity and attitude after every sample, without a loop over samples.

Inside a window the IMU error is constant, so attitude is a prefix product of rotations and velocity and
position are prefix sums. In the tangent frame n, which is fixed to the Earth (paper.md 2.1, 2.3),

    C' = C [w_b×] − [ω×] C,    v' = C f_b + g(p) − 2 ω × v,    p' = v,    ω = Earth rate.

Rate and specific force are constant within a sample (they are its means) and integrated to third order, gravity is
taken at the window's midpoint, Earth rotation and Coriolis are exact to first order in ωT: with
S = Σ ΔV and P = Σ ΔP the velocity and position gained from specific force, integration by parts leaves

    v(t) = v₀ + g t + S − ω × (t S + P + 2 v₀ t + g t²)
    p(t) = p₀ + v₀ t + g t²/2 + P − ω × (t P + v₀ t² + g t³/3).

The gradient is written out by hand (the adjoint of a prefix product is a suffix sum), which costs one
forward pass instead of a graph of some hundred nodes. Both are here for tensors on any device; with numba
and on a CPU the loops of :mod:`dlkf.navigation.compiled` take their place.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation import compiled, compiled_adjoint
from dlkf.navigation.attitude import orthonormalise, prefix_rotations, skew
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState


class Window(NamedTuple):
    """What the strapdown made of one window of M samples: the state at the end of each, and at the very end."""

    p_n: Tensor  # (B, M, 3) m
    v_n: Tensor  # (B, M, 3) m/s
    C_nb: Tensor  # (B, M, 3, 3)
    end: NavState  # (B, …), attitude orthonormalised
    gravity: Tensor  # (B, 3) m/s² that acted over the window

    def interpolate_before(self, start: NavState, lag: Float[Tensor, " B"], dt: float) -> NavState:
        """State ``lag`` seconds before the window's end, linear between samples (0 ≤ lag ≤ window); ``start`` is that
        at its beginning."""
        place = self._place(lag, dt)
        p = _interpolate(start.p_n, self.p_n, *place)
        v = _interpolate(start.v_n, self.v_n, *place)
        C = _interpolate(start.C_nb.flatten(1), self.C_nb.flatten(2), *place)
        return NavState(p, v, orthonormalise(C.unflatten(-1, (3, 3))))

    def velocity_before(self, start: NavState, lag: Float[Tensor, " B"], dt: float) -> Float[Tensor, "B 3"]:
        """The velocity of :meth:`interpolate_before`."""
        return _interpolate(start.v_n, self.v_n, *self._place(lag, dt))

    def _place(self, lag: Float[Tensor, " B"], dt: float) -> tuple[Tensor, Tensor]:
        """Sample (B,) in which that time lies, and which part (B, 1) of it has gone by."""
        M = self.p_n.shape[1]
        place = (M - lag / dt).clamp(0, M)
        sample = place.floor().clamp(max=M - 1).long()
        return sample, (place - sample).unsqueeze(-1)


def strapdown(start: NavState, imu: Float[Tensor, "B M 6"], dt: float, frame: TangentFrame) -> Window:
    """Mechanise one window of corrected IMU samples (specific force m/s², rate rad/s) from ``start``.

    Differentiable in the start state and the samples; attitude gradients live in the tangent space of SO(3).
    """
    with torch.no_grad():
        half = 0.5 * dt * imu.shape[1]
        gravity = frame.gravity(torch.add(start.p_n, start.v_n, alpha=half))
    if torch.is_grad_enabled():
        function = _CompiledStrapdown if compiled.fits(imu, gradients=True) else _Strapdown
        p, v, C, *end = function.apply(
            start.p_n, start.v_n, start.C_nb, imu, dt, gravity, frame.gravity_gradient(), frame.earth_rate_n
        )
    elif compiled.fits(imu):
        p, v, C = compiled.mechanise(*start, imu, dt, gravity, frame.earth_rate_n)
        end = p[:, -1].clone(), v[:, -1].clone(), orthonormalise(C[:, -1])  # views would keep the whole window
    else:
        (p, v, C, *end), _ = _mechanise(*start, imu, dt, gravity, frame.earth_rate_n)
    return Window(p, v, C, NavState(*end), gravity)


def _interpolate(
    start: Float[Tensor, "B n"], ends: Float[Tensor, "B M n"], sample: Tensor, part: Float[Tensor, "B 1"]
) -> Float[Tensor, "B n"]:
    """Between a sample's begin and end, of values at the window's start and at the samples' ends."""
    row = torch.arange(len(sample), device=sample.device)
    begin = torch.where(sample.unsqueeze(-1) > 0, ends[row, (sample - 1).clamp_min(0)], start)
    return torch.lerp(begin, ends[row, sample], part)


@lru_cache
@torch.inference_mode(False)
def _times(M: int, dt: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Time since the window's start at the end of each sample."""
    return torch.arange(1, M + 1, dtype=dtype, device=device) * dt


def _mechanise(p0: Tensor, v0: Tensor, C0: Tensor, imu: Tensor, dt: float, g: Tensor, earth_rate: Tensor):
    """States after every sample and at the end, and what the adjoint needs of the way there.

    Inside, the axes come first and the samples last: (3, B, M) vectors and (3, 3, B, M) matrices, so that
    every operation runs over contiguous planes.
    """
    planes = imu.permute(2, 0, 1).contiguous()
    f, phi = planes[:3], planes[3:] * dt
    M = phi.shape[2]
    C = C0.permute(1, 2, 0).unsqueeze(-1)  # (3, 3, B, 1)
    p, v, g3, w = (x.mT.unsqueeze(-1) for x in (p0, v0, g, earth_rate))
    A = torch.cat((C, _product(C, prefix_rotations(phi))), -1)  # C₀ R, Earth rotation left out
    A_before, A = A[..., :-1], A[..., 1:]  # at each sample's begin and end
    # ∫ exp(s φ) ds f over the sample, once for velocity, twice for position
    dv = f * dt
    turn = torch.linalg.cross(phi, dv, dim=0)
    turn2 = torch.linalg.cross(phi, turn, dim=0)
    once = torch.add(torch.add(dv, turn, alpha=1 / 2), turn2, alpha=1 / 6)
    twice = torch.add(torch.add(0.5 * dv, turn, alpha=1 / 6), turn2, alpha=1 / 24)
    gained, moved = (A_before.unsqueeze(1) * torch.stack((once, twice)).unsqueeze(0)).sum(2).unbind(1)
    S = gained.cumsum(-1)
    moved = moved * dt
    P = torch.add(moved, torch.sub(S, gained), alpha=dt).cumsum(-1)
    t = _times(M, dt, phi.dtype, phi.device)
    fallen = g3 * t
    reach = torch.stack((v + fallen / 3, v + fallen + v + S)) * t + P  # under the Coriolis cross products
    swing = torch.linalg.cross(w.expand_as(reach[0]).unsqueeze(0), reach, dim=1)
    v_n = v + fallen + S - swing[1]
    p_n = p + t * (torch.add(v, fallen, alpha=0.5) - swing[0]) + P
    C_nb = A - t * torch.linalg.cross(w.unsqueeze(1), A, dim=0)
    p_n, v_n, C_nb = p_n.permute(1, 2, 0), v_n.permute(1, 2, 0), C_nb.permute(2, 3, 0, 1)
    states = p_n, v_n, C_nb, p_n[:, -1].clone(), v_n[:, -1].clone(), orthonormalise(C_nb[:, -1])
    return states, (f, phi, A, A_before, gained, moved)


class _Strapdown(torch.autograd.Function):
    """Forward and adjoint of the window; names follow the module's equations."""

    @staticmethod
    def forward(ctx, p0, v0, C0, imu, dt, g, gradient, earth_rate):
        states, (f, phi, A, A_before, gained, moved) = _mechanise(p0, v0, C0, imu, dt, g, earth_rate)
        ctx.save_for_backward(f, phi, C0, A, A_before, gained, moved, gradient, earth_rate)
        ctx.dt = dt
        ctx.set_materialize_grads(False)
        return states

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, Gp, Gv, GC, gp, gv, gC):
        f, phi, C0, A, A_before, gained, moved, gradient, earth_rate = ctx.saved_tensors
        dt, M = ctx.dt, phi.shape[-1]
        t = _times(M, dt, phi.dtype, phi.device)
        w = earth_rate.mT.unsqueeze(-1)
        Gp = _add_end_gradient(Gp, gp, gained, (2, 0, 1))
        Gv = _add_end_gradient(Gv, gv, gained, (2, 0, 1))
        Hv, Hp = _cross(w, Gv), _cross(w, Gp)
        grad_g = (t * (Gv + 0.5 * t * Gp + t * Hv + t * t * Hp / 3)).sum(-1).mT
        grad_v0 = (Gv + t * (Gp + 2 * Hv + t * Hp)).sum(-1).mT + 0.5 * M * dt * gradient * grad_g
        grad_p0 = Gp.sum(-1).mT + gradient * grad_g
        # suffix sums: what each ΔP and ΔV is worth
        U = _suffix_sum(Gp + Hv + t * Hp)
        V = _suffix_sum(Gv + t * Hv) + dt * (_suffix_sum(U) - U)
        # attitude: tangent gradient in n, for a turn at each sample's end (T) and start
        torque = _cross(gained, V) + _cross(moved, U)
        at_end = None
        if GC is not None or gC is not None:
            GC = _add_end_gradient(GC, gC, A, (2, 3, 0, 1))
            at_end = _cross(A, GC + t * _cross(w.unsqueeze(1), GC)).sum(1)
        T = _suffix_sum(torque if at_end is None else torque + at_end)
        grad_C0 = 0.5 * skew(T[..., 0].mT) @ C0
        T = T - torque
        r1, r2 = _rotate_back(A_before, V) * dt, _rotate_back(A_before, U) * dt**2
        e1, e2 = r1 / 2 + r2 / 6, r1 / 6 + r2 / 24
        grad_f = r1 + r2 / 2 + _cross(e1, phi) + _cross(phi, _cross(phi, e2))
        twist = _rotate_back(A, T)
        spin = _cross(phi, twist)
        spin2 = _cross(phi, spin)
        grad_phi = twist + spin / 2 + spin2 / 6 + _cross(phi, spin2) / 24
        grad_phi = grad_phi + _cross(f, e1) + e2 * _dot(phi, f) + f * _dot(e2, phi) - 2 * phi * _dot(f, e2)
        grad_imu = torch.cat((grad_f, grad_phi * dt)).permute(1, 2, 0)
        return grad_p0, grad_v0, grad_C0, grad_imu, None, None, None, None


class _CompiledStrapdown(torch.autograd.Function):
    """The same by compiled loops, samples first and axes last."""

    @staticmethod
    def forward(ctx, p0, v0, C0, imu, dt, g, gradient, earth_rate):
        C0, imu = C0.detach(), imu.detach()
        p, v, C = compiled.mechanise(p0.detach(), v0.detach(), C0, imu, dt, g, earth_rate)
        ctx.save_for_backward(C0, imu, gradient, earth_rate)
        ctx.dt = dt
        ctx.set_materialize_grads(False)
        return p, v, C, p[:, -1].clone(), v[:, -1].clone(), orthonormalise(C[:, -1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, Gp, Gv, GC, gp, gv, gC):
        C0, imu, gradient, earth_rate = ctx.saved_tensors
        only_end = Gp is None and Gv is None and GC is None
        shape = (len(imu), 1 if only_end else imu.shape[1], 3)
        Gp, Gv, GC = _add_end(Gp, gp, C0, shape), _add_end(Gv, gv, C0, shape), _add_end(GC, gC, C0, (*shape, 3))
        p0, v0, turn, samples = compiled_adjoint.adjoint(C0, imu, ctx.dt, gradient, earth_rate, Gp, Gv, GC)
        return p0, v0, 0.5 * skew(turn) @ C0, samples, None, None, None, None


def _add_end(samples: Tensor | None, end: Tensor | None, like: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Gradient of the last samples (B, m, …) with that of the end state added to the last."""
    full = like.new_zeros(shape) if samples is None else samples.clone()
    if end is not None:
        full[:, -1] += end
    return full


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=0)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(0)


def _rotate_back(C: Tensor, u: Tensor) -> Tensor:
    return (C * u.unsqueeze(1)).sum(0)


def _product(A: Tensor, B: Tensor) -> Tensor:
    return (A.unsqueeze(2) * B.unsqueeze(0)).sum(1)


def _suffix_sum(x: Tensor) -> Tensor:
    return x.sum(-1, keepdim=True) - x.cumsum(-1) + x


def _add_end_gradient(samples: Tensor | None, end: Tensor | None, like: Tensor, order: tuple[int, ...]) -> Tensor:
    """Gradient of all samples with that of the end state added to the last, axes first."""
    full = torch.zeros_like(like) if samples is None else samples.permute(*order).contiguous()
    if end is not None:
        full[..., -1] += end.permute(*range(1, end.ndim), 0)
    return full
