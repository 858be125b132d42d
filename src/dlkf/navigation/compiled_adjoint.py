"""The gradient of a window of strapdown, compiled: the adjoint of :mod:`dlkf.navigation.strapdown` sample by sample.

The way there is gone once more, and back from the last sample to the first; sums over later samples (U, V, T below)
grow on the way. The same equations as the tensor form's, which takes over without numba or on a GPU.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from torch import Tensor

from dlkf.navigation.compiled import cross, dot, gains, njit, plus, rotation, row, scale, times


def adjoint(
    C0: Tensor, imu: Tensor, dt: float, gradient: Tensor, earth_rate: Tensor,
    Gp: Tensor, Gv: Tensor, GC: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients in p₀, v₀ (B, 3), C₀ (B, 3, 3) and the samples (B, M, 6).

    From those in position, velocity (B, m, 3) and attitude (B, m, 3, 3) at the end of the last m samples, zero before;
    ``gradient`` (B, 3) is the diagonal of gravity's [1/s²].
    """
    B = len(imu)
    p0, v0, turn, samples = imu.new_empty(B, 3), imu.new_empty(B, 3), imu.new_empty(B, 3), imu.new_empty(imu.shape)
    arrays = (x.detach().contiguous().numpy() for x in (C0, imu, gradient.expand(B, 3), earth_rate, Gp, Gv, GC))
    _adjoint(*arrays, dt, p0.numpy(), v0.numpy(), turn.numpy(), samples.numpy())
    return p0, v0, turn, samples


@njit()
@no_type_check
def _rotate_back(A, k, u):
    """A[k]ᵀ u."""
    return (
        A[k, 0, 0] * u[0] + A[k, 1, 0] * u[1] + A[k, 2, 0] * u[2],
        A[k, 0, 1] * u[0] + A[k, 1, 1] * u[1] + A[k, 2, 1] * u[2],
        A[k, 0, 2] * u[0] + A[k, 1, 2] * u[1] + A[k, 2, 2] * u[2],
    )


@njit()
@no_type_check
def _adjoint(C0, imu, gradient, w, Gp, Gv, GC, dt, grad_p0, grad_v0, turn, grad_imu):
    """V, U: what velocity and position that a sample's force gives are worth to all later ends of samples; T: what a
    small turn of the attitude is. Gp, Gv, GC with Coriolis' part (``Hp``, ``Hv``) add to them on the way back."""
    B, M, _ = imu.shape
    first = M - GC.shape[1]
    A = np.empty((M + 1, 3, 3))  # C₀ R before the first sample and at the end of each
    gained, moved = np.empty((M, 3)), np.empty((M, 3))
    zero = 0.0, 0.0, 0.0
    for b in range(B):
        for i in range(3):
            A[0, i, 0], A[0, i, 1], A[0, i, 2] = row(C0, b, i)
        for k in range(M):
            phi = imu[b, k, 3] * dt, imu[b, k, 4] * dt, imu[b, k, 5] * dt
            once, twice = gains(phi, row(imu, b, k), dt)
            R = rotation(phi)
            for i in range(3):
                a = row(A, k, i)
                gained[k, i], moved[k, i] = dot(a, once), dot(a, twice) * dt
                A[k + 1, i, 0], A[k + 1, i, 1], A[k + 1, i, 2] = times(a, R)
        p0, v0, gravity, U, V, T = zero, zero, zero, zero, zero, zero
        for k in range(M - 1, -1, -1):
            V = plus(V, dt, U)  # U of the samples after this one
            if k >= first:
                t, n = (k + 1) * dt, k - first
                earth = w[b, 0], w[b, 1], w[b, 2]
                gp, gv = row(Gp, b, n), row(Gv, b, n)
                Hp, Hv = cross(earth, gp), cross(earth, gv)
                of_g = plus(plus(plus(gv, t / 2, gp), t, Hv), t * t / 3, Hp)
                gravity = plus(gravity, t, of_g)
                p0, v0 = plus(p0, 1, gp), plus(v0, 1, plus(gv, t, plus(plus(gp, 2, Hv), t, Hp)))
                V, U = plus(V, 1, plus(gv, t, Hv)), plus(U, 1, plus(plus(gp, 1, Hv), t, Hp))
                # what a turn at the sample's end is worth, and with the sample's own part one at its start
                for j in range(3):
                    column = GC[b, n, 0, j], GC[b, n, 1, j], GC[b, n, 2, j]
                    along = A[k + 1, 0, j], A[k + 1, 1, j], A[k + 1, 2, j]
                    T = plus(T, 1, cross(along, plus(column, t, cross(earth, column))))
            r1, r2, twist = _rotate_back(A, k, V), _rotate_back(A, k, U), _rotate_back(A, k + 1, T)
            ends = (gained[k, 0], gained[k, 1], gained[k, 2]), (moved[k, 0], moved[k, 1], moved[k, 2])
            T = plus(plus(T, 1, cross(ends[0], V)), 1, cross(ends[1], U))
            phi, f = (imu[b, k, 3] * dt, imu[b, k, 4] * dt, imu[b, k, 5] * dt), row(imu, b, k)
            e1, e2 = scale(dt / 2, plus(r1, dt / 3, r2)), scale(dt / 6, plus(r1, dt / 4, r2))
            back = plus(cross(e1, phi), 1, cross(phi, cross(phi, e2)))
            spin = cross(phi, twist)
            spin2 = cross(phi, spin)
            rotated = plus(plus(plus(twist, 1 / 2, spin), 1 / 6, spin2), 1 / 24, cross(phi, spin2))
            leaned = plus(plus(plus(cross(f, e1), dot(phi, f), e2), dot(phi, e2), f), -2 * dot(f, e2), phi)
            for i in range(3):
                grad_imu[b, k, i] = dt * (r1[i] + dt / 2 * r2[i]) + back[i]
                grad_imu[b, k, 3 + i] = dt * (rotated[i] + leaned[i])
        for i in range(3):
            grad_p0[b, i] = p0[i] + gradient[b, i] * gravity[i]
            grad_v0[b, i] = v0[i] + dt * M / 2 * gradient[b, i] * gravity[i]
            turn[b, i] = T[i]
