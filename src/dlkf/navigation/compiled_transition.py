"""Φ of a whole window sample by sample, compiled: the equations of :mod:`dlkf.navigation.error_model` as loops."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from torch import Tensor

from dlkf.navigation.compiled import cross, njit, plus, row, scale


def transition(
    still: Tensor, start: Any, window: Any, samples: Tensor, earth_rate: Tensor, dt: float, elements: np.ndarray
) -> Tensor:
    """Φ (B, n, n) of :class:`dlkf.navigation.error_model.WindowModel`, with the ``elements`` (e, 2) of the sensor
    matrices among the states."""
    Phi = still.clone()
    given = (*start, window.p_n, window.v_n, window.C_nb, window.gravity, samples, earth_rate)
    _transition(*(x.numpy() for x in given), dt, elements, Phi.numpy())
    return Phi


@njit()
@no_type_check
def add(total, s, x):
    """total ← total + s x of rows of any length."""
    for r in range(len(x)):
        total[r] += s * x[r]


@njit()
@no_type_check
def _transition(p0, v0, C0, p, v, C, g, samples, earth_rate, dt, elements, Phi):
    """What a window's motion adds to Φ of one in which nothing moves: what a tilt does to velocity and position, with
    what the specific force gained (``s``) and Coriolis, and the sensors' columns."""
    B, M = v.shape[:2]
    T, last = M * dt, M - 1
    for b in range(B):
        fall, earth = (g[b, 0], g[b, 1], g[b, 2]), (earth_rate[b, 0], earth_rate[b, 1], earth_rate[b, 2])
        speed = v0[b, 0], v0[b, 1], v0[b, 2]
        moved = plus(row(p, b, last), -1, (p0[b, 0], p0[b, 1], p0[b, 2]))
        s_p = plus(moved, -T, plus(speed, T / 2, fall))
        s_v = plus(plus(row(v, b, last), -1, speed), -T, fall)
        swept = plus(scale(T / 3, moved), T * T / 6, speed)
        for i, s in ((0, plus(s_p, 2, cross(earth, swept))), (3, plus(s_v, 2, cross(earth, moved)))):
            Phi[b, i, 7], Phi[b, i + 1, 8], Phi[b, i + 2, 6] = s[2], s[0], s[1]  # −[s×]
            Phi[b, i + 1, 6], Phi[b, i + 2, 7], Phi[b, i, 8] = -s[2], -s[0], -s[1]
            Phi[b, i, 6] = Phi[b, i + 1, 7] = Phi[b, i + 2, 8] = 0.0
    _sensor_columns(C0, v0, C, v, g, samples, dt, elements, Phi[:, :9, 9:])


@njit()
@no_type_check
def _sensor_columns(C0, v0, C, v, g, samples, dt, elements, out):
    """What a unit error of every sensor column c does to the window's end, sum over its samples from the last to the
    first, of a bias (1) and of an element (c, d) of M (the sample of axis d).

    An accelerometer's error along C e_c changes velocity at once and position over what is ``left`` of the window; a
    gyroscope's tilts the attitude by C e_c from then on, which turns all velocity gained from the sample's middle on
    (``ahead``), and what that moves until the end (``far``).
    """
    B, M = v.shape[:2]
    e = len(elements)
    kinds = 4 if e else 1
    by_force, by_rate = np.empty(18), np.empty(27)  # of a sample: position, velocity; these and attitude, (i, c) each
    of_force, of_rate = np.empty((4, 18)), np.empty((4, 27))
    for b in range(B):
        of_force[:], of_rate[:] = 0.0, 0.0
        ahead, far = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        fall = g[b, 0], g[b, 1], g[b, 2]
        for k in range(M - 1, -1, -1):
            left = (M - k - 0.5) * dt
            before = row(v, b, k - 1) if k else (v0[b, 0], v0[b, 1], v0[b, 2])
            gained = plus(plus(row(v, b, k), -1, before), -dt, fall)
            ahead, far = plus(ahead, 0.5, gained), plus(far, 0.5 * left, gained)
            for c in range(3):
                turned = (
                    0.5 * dt * ((C[b, k - 1, 0, c] if k else C0[b, 0, c]) + C[b, k, 0, c]),
                    0.5 * dt * ((C[b, k - 1, 1, c] if k else C0[b, 1, c]) + C[b, k, 1, c]),
                    0.5 * dt * ((C[b, k - 1, 2, c] if k else C0[b, 2, c]) + C[b, k, 2, c]),
                )
                moved, sped = cross(far, turned), cross(ahead, turned)
                for i in range(3):
                    by_force[3 * i + c], by_force[9 + 3 * i + c] = -left * turned[i], -turned[i]
                    by_rate[3 * i + c], by_rate[9 + 3 * i + c], by_rate[18 + 3 * i + c] = moved[i], sped[i], -turned[i]
            ahead, far = plus(ahead, 0.5, gained), plus(far, 0.5 * left, gained)
            for d in range(kinds):
                f, w = (samples[b, k, d - 1], samples[b, k, 2 + d]) if d else (1.0, 1.0)
                add(of_force[d], f, by_force)
                add(of_rate[d], w, by_rate)
        for n in range(3 + e):
            c, d, to = (n, 0, n) if n < 3 else (elements[n - 3, 0], elements[n - 3, 1] + 1, 3 + n)
            for i in range(6):
                out[b, i, to] = of_force[d, 3 * i + c]
            for i in range(9):
                out[b, i, to + (3 if n < 3 else e)] = of_rate[d, 3 * i + c]


def process_noise(L: Tensor, density: Tensor, shares: Tensor, walk: Tensor) -> Tensor:
    """Q (B, n, n) of :meth:`dlkf.navigation.error_model.WindowModel.noise` from what the sources do, (B, 4, s, 3),
    their ``density`` (4,) over the window, ``shares`` (4, s, s) and what it adds to the diagonal, ``walk`` (n,)."""
    Q = L.new_empty(len(L), len(walk), len(walk))
    _process_noise(*(x.numpy() for x in (L, density, shares, walk, Q)))
    return Q


@njit()
@no_type_check
def _process_noise(L, density, shares, walk, Q):
    B, sources, states = L.shape[:3]
    Q[:] = 0.0
    for b in range(B):
        for s in range(sources):
            for i in range(states):
                x, y, z = L[b, s, i, 0], L[b, s, i, 1], L[b, s, i, 2]
                if x == 0.0 and y == 0.0 and z == 0.0:
                    continue
                for j in range(i + 1):
                    along = x * L[b, s, j, 0] + y * L[b, s, j, 1] + z * L[b, s, j, 2]
                    Q[b, i, j] += along * (density[s] * shares[s, i, j])
        for i in range(states):
            for j in range(i):
                Q[b, j, i] = Q[b, i, j]
        for i in range(len(walk)):
            Q[b, i, i] += walk[i]
