"""The window's sums sample by sample, compiled: what a filter without gradients on a CPU spends its time in.

The same equations as :mod:`dlkf.navigation.strapdown` (and in ``compiled_*`` its gradient and Φ) in the form in which a
textbook writes them, for one drive as for many. Without numba, or on a GPU, the tensor forms take over. numba is loaded
with the first use of a loop, which takes half a second.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, no_type_check

import numpy as np
import torch
from torch import Tensor

from dlkf.base.console import warn_once

AVAILABLE, TROUBLE = True, ""  # until numba has been asked for
_tensor_forms, _spared = False, False
_loops: list[tuple[Callable, dict[str, Any]]] = []  # that wait for numba, with its options
_loading = threading.Lock()
ROOMS_WITH_LOOPS = ("dlkf.navigation.", "dlkf.data.compiled")


def fits(x: Tensor, *, gradients: bool = False) -> bool:
    """Whether the compiled form may stand in for the tensor form: in main memory, and no gradient asked for but by
    one that has ``gradients``.

    Warns once if something prevents it.
    """
    if x.device.type != "cpu" or is_recorded():
        return False
    if _spared or (not gradients and (torch.is_grad_enabled() or x.requires_grad)):
        return False
    if _loops:
        _load()
    if TROUBLE:
        warn_once(TROUBLE)
    return AVAILABLE


def is_recorded() -> bool:
    """Whether operations are recorded, by an export or a compiler, which cannot follow values out of tensors."""
    return _tensor_forms or torch.compiler.is_compiling()


@contextmanager
def tensor_forms() -> Iterator[None]:
    """Inside the block the tensor forms are taken in any case and nothing branches on values: an export needs it."""
    global _tensor_forms
    before, _tensor_forms = _tensor_forms, True
    try:
        yield
    finally:
        _tensor_forms = before


@contextmanager
def without_loops() -> Iterator[None]:
    """Use the tensor forms inside the block: for work that is shorter than loading numba."""
    global _spared
    before, _spared = _spared, True
    try:
        yield
    finally:
        _spared = before


def load_loops() -> None:
    """Load numba now, with the loops of all modules that are there, for work that is worth it."""
    if _loops and not _spared:
        _load()


def loops_are_loaded() -> bool:
    """Whether the loops run compiled, and nobody forbids them."""
    return AVAILABLE and not _loops and not (_spared or is_recorded())


def njit(**options: Any) -> Callable[[Callable], Any]:
    """``numba.njit`` of a function, when :func:`fits` first asks for it; until then, and without numba, the function as
    it is."""

    def register(function: Callable) -> Any:
        _loops.append((function, options))
        return function

    return register


def _load() -> None:
    """The loops that wait through numba, kept between processes where there is a folder for it, in their place in the
    modules that have them."""
    global AVAILABLE, TROUBLE
    with _loading:
        try:
            import numba
        except (ImportError, OSError) as error:  # not there, or not for this NumPy
            AVAILABLE = False
            TROUBLE = f"numba cannot be loaded ({error}), so filters run up to 2 × slower; install one for this Python"
            _loops.clear()
            return
        modules = [module for name, module in list(sys.modules.items()) if name.startswith(ROOMS_WITH_LOOPS)]
        for function, options in _loops:
            try:
                loop = numba.njit(cache=True, **options)(function)
            except RuntimeError:  # numba's word for no folder that it may write into
                TROUBLE = "every process compiles the loops again, some 3 s each; set NUMBA_CACHE_DIR to a folder"
                loop = numba.njit(**options)(function)
            for module in modules:
                vars(module).update({name: loop for name, value in vars(module).items() if value is function})
        _loops.clear()


def mechanise(
    p0: Tensor, v0: Tensor, C0: Tensor, imu: Tensor, dt: float, g: Tensor, earth_rate: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Position (B, M, 3), velocity (B, M, 3) and attitude (B, M, 3, 3) at the end of every sample."""
    B, M, _ = imu.shape
    p, v, C = imu.new_empty(B, M, 3), imu.new_empty(B, M, 3), imu.new_empty(B, M, 3, 3)
    given = (p0.numpy(), v0.numpy(), C0.numpy(), imu.numpy(), g.numpy(), earth_rate.numpy())
    _mechanise(*given, dt, p.numpy(), v.numpy(), C.numpy())
    return p, v, C


def rotations(phi: Tensor) -> Tensor:
    """exp([φ×]) of rotation vectors (…, 3)."""
    out = phi.new_empty(*phi.shape, 3)
    _rotations(phi.reshape(-1, 3).numpy(), out.view(-1, 3, 3).numpy())
    return out


def gravity(
    p_n: Tensor, stretching: Tensor, centre: Tensor, axis: Tensor, shape: Tensor, constants: tuple[float, ...]
) -> Tensor:
    """Gravity (B, 3) of :class:`dlkf.navigation.earth.TangentFrame`; ``shape`` (B, 3) is height, 1/(2R), slope."""
    g = torch.empty_like(p_n)
    given: Any = (*(x.numpy() for x in (p_n, stretching, centre, axis, shape)), *constants, g.numpy())
    _gravity(*given)
    return g


def solve(S: Tensor, X: Tensor) -> Tensor:
    """S⁻¹ X of symmetric positive definite matrices (B, m, m) and columns (B, m, n)."""
    out = X.clone(memory_format=torch.contiguous_format)
    _eliminate(S.numpy(), out.numpy())
    return out


@njit()
@no_type_check
def cross(a, b):
    """a × b of three numbers each, which stay in registers, as those of the functions below do."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit()
@no_type_check
def dot(a, b):
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit()
@no_type_check
def scale(s, a):
    """s a."""
    return s * a[0], s * a[1], s * a[2]


@njit()
@no_type_check
def plus(a, s, b):
    """a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@njit()
@no_type_check
def row(x, b, k):
    """Vector x[b, k]."""
    return x[b, k, 0], x[b, k, 1], x[b, k, 2]


@njit()
@no_type_check
def rotation(phi):
    """exp([φ×]), a row each; up to 0.2 rad by the first terms of sine and cosine, which is all that float64 has."""
    x, y, z = phi
    s = 0.25 * (x * x + y * y + z * z)  # (φ/2)²
    if s < 0.01:
        q0 = 1 - s / 2 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56)))
        scale = 0.5 * (1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72))))
    else:
        half = math.sqrt(s)
        q0, scale = math.cos(half), 0.5 * math.sin(half) / half
    q1, q2, q3 = scale * x, scale * y, scale * z
    return (
        (1 - 2 * (q2 * q2 + q3 * q3), 2 * (q1 * q2 - q0 * q3), 2 * (q1 * q3 + q0 * q2)),
        (2 * (q1 * q2 + q0 * q3), 1 - 2 * (q1 * q1 + q3 * q3), 2 * (q2 * q3 - q0 * q1)),
        (2 * (q1 * q3 - q0 * q2), 2 * (q2 * q3 + q0 * q1), 1 - 2 * (q1 * q1 + q2 * q2)),
    )


@njit()
@no_type_check
def times(a, R):
    """aᵀ R of a row and a matrix."""
    return (
        a[0] * R[0][0] + a[1] * R[1][0] + a[2] * R[2][0],
        a[0] * R[0][1] + a[1] * R[1][1] + a[2] * R[2][1],
        a[0] * R[0][2] + a[1] * R[1][2] + a[2] * R[2][2],
    )


@njit()
@no_type_check
def gains(phi, f, dt):
    """∫ exp(s φ) ds f dt over a sample, once for velocity and twice for position (over dt)."""
    dv = f[0] * dt, f[1] * dt, f[2] * dt
    turn = cross(phi, dv)
    again = cross(phi, turn)
    return (
        (dv[0] + turn[0] / 2 + again[0] / 6, dv[1] + turn[1] / 2 + again[1] / 6, dv[2] + turn[2] / 2 + again[2] / 6),
        (
            dv[0] / 2 + turn[0] / 6 + again[0] / 24,
            dv[1] / 2 + turn[1] / 6 + again[1] / 24,
            dv[2] / 2 + turn[2] / 6 + again[2] / 24,
        ),
    )


@njit()
@no_type_check
def _rotations(phi, out):
    for b in range(len(phi)):
        R = rotation((phi[b, 0], phi[b, 1], phi[b, 2]))
        for i in range(3):
            out[b, i, 0], out[b, i, 1], out[b, i, 2] = R[i]


@njit(error_model="numpy")  # what cannot be solved is not finite, as with LAPACK, and no error
@no_type_check
def _eliminate(S, X):
    """Gauss and Jordan's elimination, for which positive definite matrices need no exchange of rows; X ← S⁻¹ X."""
    B, m, n = X.shape
    W, pivot = np.empty((m, m + n), S.dtype), np.empty(m + n, S.dtype)  # S beside X
    for b in range(B):
        for i in range(m):  # element by element: numba takes seconds to compile what checks the shapes of slices
            for c in range(m + n):
                W[i, c] = S[b, i, c] if c < m else X[b, i, c - m]
        for j in range(m):
            inverse = 1 / W[j, j]
            for c in range(m + n):
                pivot[c] = inverse * W[j, c]
            for i in range(m):
                factor = W[i, j]
                for c in range(m + n):
                    W[i, c] -= factor * pivot[c]
            for c in range(m + n):
                W[j, c] = pivot[c]
        for i in range(m):
            for c in range(n):
                X[b, i, c] = W[i, m + c]


@njit()
@no_type_check
def _gravity(p, stretching, centre, axis, shape, equator, somigliana, eccentricity_sq, curvature, g):
    for b in range(len(p)):
        along, square = 0.0, 0.0
        for i in range(3):
            g[b, i] = centre[b, i, 0]
            for j in range(3):
                g[b, i] += stretching[b, i, j] * p[b, j]
            along += g[b, i] * axis[b, i]
            square += g[b, i] * g[b, i]
        s2 = along * along / square
        height = shape[b, 0] - p[b, 2] + (p[b, 0] ** 2 + p[b, 1] ** 2) * shape[b, 1]
        surface = equator * (1 + somigliana * s2) / math.sqrt(1 - eccentricity_sq * s2)
        factor = -surface * (1 + height * (curvature * height - shape[b, 2])) / math.sqrt(square)
        for i in range(3):
            g[b, i] *= factor


@njit()
@no_type_check
def _mechanise(p0, v0, C0, imu, g, w, dt, p, v, C):
    """Sample by sample the result of ``strapdown`` for a window.

    A = C₀ R, the attitude in axes that do not turn with the Earth; S, P velocity and position that the specific force
    has given since the window's start; Coriolis' part of both (``swing``) follows from the motion without it, and
    attitude turns back by the Earth's rotation since the start.
    """
    B, M, _ = imu.shape
    zero = 0.0, 0.0, 0.0
    for b in range(B):
        A = row(C0, b, 0), row(C0, b, 1), row(C0, b, 2)
        start, speed = (p0[b, 0], p0[b, 1], p0[b, 2]), (v0[b, 0], v0[b, 1], v0[b, 2])
        fall, earth = (g[b, 0], g[b, 1], g[b, 2]), (w[b, 0], w[b, 1], w[b, 2])
        S, P = zero, zero
        for k in range(M):
            phi = imu[b, k, 3] * dt, imu[b, k, 4] * dt, imu[b, k, 5] * dt
            once, twice = gains(phi, row(imu, b, k), dt)
            P = plus(P, dt, plus(S, 1, (dot(A[0], twice), dot(A[1], twice), dot(A[2], twice))))
            S = plus(S, 1, (dot(A[0], once), dot(A[1], once), dot(A[2], once)))
            R = rotation(phi)
            A = times(A[0], R), times(A[1], R), times(A[2], R)
            t = (k + 1) * dt
            free = plus(speed, t, fall)  # v₀ + g t
            swing_v = cross(earth, plus(P, t, plus(plus(S, 1, speed), 1, free)))
            swing_p = cross(earth, plus(P, t, plus(speed, t / 3, fall)))
            at_v = plus(plus(free, 1, S), -1, swing_v)
            at_p = plus(plus(start, 1, P), t, plus(plus(speed, t / 2, fall), -1, swing_p))
            turned = (
                plus(A[0], t, plus(scale(earth[2], A[1]), -earth[1], A[2])),
                plus(A[1], t, plus(scale(earth[0], A[2]), -earth[2], A[0])),
                plus(A[2], t, plus(scale(earth[1], A[0]), -earth[0], A[1])),
            )
            for i in range(3):
                p[b, k, i], v[b, k, i] = at_p[i], at_v[i]
                C[b, k, i, 0], C[b, k, i, 1], C[b, k, i, 2] = turned[i]
