"""The gradient of a window of strapdown, compiled: the adjoint of :mod:`dlkf.navigation.strapdown` sample by sample.

The way there is gone once more, and back from the last sample to the first; sums over later samples (U, V, T below)
grow on the way. The same equations as the tensor form's, which takes over without numba or on a GPU.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from torch import Tensor

from dlkf.navigation.compiled import _rotation, njit


def adjoint(
    C0: Tensor, imu: Tensor, dt: float, gradient: Tensor, earth_rate: Tensor,
    Gp: Tensor, Gv: Tensor, GC: Tensor, attitude_from: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients in p₀, v₀ (B, 3), C₀ (B, 3, 3) and the samples (B, M, 6).

    From those in position, velocity (B, M, 3) and attitude (B, M, 3, 3) at the end of every sample, of attitude zero
    before sample ``attitude_from``; ``gradient`` (B, 3) is the diagonal of gravity's [1/s²].
    """
    B = len(imu)
    p0, v0, turn, samples = imu.new_empty(B, 3), imu.new_empty(B, 3), imu.new_empty(B, 3), imu.new_empty(imu.shape)
    arrays = (x.detach().contiguous().numpy() for x in (C0, imu, gradient.expand(B, 3), earth_rate, Gp, Gv, GC))
    _adjoint(*arrays, attitude_from, dt, p0.numpy(), v0.numpy(), turn.numpy(), samples.numpy())
    return p0, v0, turn, samples


@njit(cache=True, inline="always")
@no_type_check
def _cross(a, b, out):
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
@no_type_check
def _rotate_back(C, u, out):
    for j in range(3):
        out[j] = C[0, j] * u[0] + C[1, j] * u[1] + C[2, j] * u[2]


@njit(cache=True)
@no_type_check
def _adjoint(C0, imu, gradient, w, Gp, Gv, GC, attitude_from, dt, grad_p0, grad_v0, turn, grad_imu):
    B, M, _ = imu.shape
    A = np.empty((M + 1, 3, 3), imu.dtype)  # C₀ R before the first sample and at the end of each
    gained, moved = np.empty((M, 3), imu.dtype), np.empty((M, 3), imu.dtype)
    R = np.empty((3, 3), imu.dtype)
    vectors = np.empty((16, 3), imu.dtype)
    phi, dv, c1, c2, Hv, Hp, r1, r2, e1, e2, twist, spin, spin2, a1, a2, a3 = vectors
    for b in range(B):
        A[0] = C0[b]
        for k in range(M):
            for i in range(3):
                dv[i], phi[i] = imu[b, k, i] * dt, imu[b, k, 3 + i] * dt
            _cross(phi, dv, c1)
            _cross(phi, c1, c2)
            _rotation(phi[0], phi[1], phi[2], R)
            for i in range(3):
                gained[k, i], moved[k, i] = 0, 0
                for j in range(3):
                    gained[k, i] += A[k, i, j] * (dv[j] + c1[j] / 2 + c2[j] / 6)
                    moved[k, i] += A[k, i, j] * (dv[j] / 2 + c1[j] / 6 + c2[j] / 24) * dt
                    A[k + 1, i, j] = A[k, i, 0] * R[0, j] + A[k, i, 1] * R[1, j] + A[k, i, 2] * R[2, j]
        p0, v0, gravity = np.zeros(3, imu.dtype), np.zeros(3, imu.dtype), np.zeros(3, imu.dtype)
        U, V, T = np.zeros(3, imu.dtype), np.zeros(3, imu.dtype), np.zeros(3, imu.dtype)
        for k in range(M - 1, -1, -1):
            t = (k + 1) * dt
            _cross(w[b], Gv[b, k], Hv)
            _cross(w[b], Gp[b, k], Hp)
            for i in range(3):
                gp, gv = Gp[b, k, i], Gv[b, k, i]
                gravity[i] += t * (gv + t * gp / 2 + t * Hv[i] + t * t * Hp[i] / 3)
                v0[i] += gv + t * (gp + 2 * Hv[i] + t * Hp[i])
                p0[i] += gp
                V[i] += gv + t * Hv[i] + dt * U[i]  # U of the samples after this one
                U[i] += gp + Hv[i] + t * Hp[i]
            # what a turn at the sample's end is worth, and with the sample's own part one at its start
            if k >= attitude_from:
                for j in range(3):
                    _cross(w[b], GC[b, k, :, j], a1)
                    for i in range(3):
                        a1[i] = GC[b, k, i, j] + t * a1[i]
                    _cross(A[k + 1, :, j], a1, a2)
                    for i in range(3):
                        T[i] += a2[i]
            _rotate_back(A[k], V, r1)
            _rotate_back(A[k], U, r2)
            _rotate_back(A[k + 1], T, twist)
            _cross(gained[k], V, a1)
            _cross(moved[k], U, a2)
            for i in range(3):
                T[i] += a1[i] + a2[i]
                phi[i] = imu[b, k, 3 + i] * dt
                r1[i], r2[i] = r1[i] * dt, r2[i] * dt * dt
                e1[i], e2[i] = r1[i] / 2 + r2[i] / 6, r1[i] / 6 + r2[i] / 24
            _cross(e1, phi, a1)
            _cross(phi, e2, a2)
            _cross(phi, a2, a3)
            _cross(phi, twist, spin)
            _cross(phi, spin, spin2)
            _cross(phi, spin2, c1)
            _cross(imu[b, k, :3], e1, c2)
            along_f = phi[0] * imu[b, k, 0] + phi[1] * imu[b, k, 1] + phi[2] * imu[b, k, 2]
            along_e = phi[0] * e2[0] + phi[1] * e2[1] + phi[2] * e2[2]
            f_e = imu[b, k, 0] * e2[0] + imu[b, k, 1] * e2[1] + imu[b, k, 2] * e2[2]
            for i in range(3):
                grad_imu[b, k, i] = r1[i] + r2[i] / 2 + a1[i] + a3[i]
                rotated = twist[i] + spin[i] / 2 + spin2[i] / 6 + c1[i] / 24
                leaned = c2[i] + e2[i] * along_f + imu[b, k, i] * along_e - 2 * phi[i] * f_e
                grad_imu[b, k, 3 + i] = (rotated + leaned) * dt
        for i in range(3):
            grad_p0[b, i] = p0[i] + gradient[b, i] * gravity[i]
            grad_v0[b, i] = v0[i] + dt * M / 2 * gradient[b, i] * gravity[i]
            turn[b, i] = T[i]
