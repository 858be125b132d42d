"""The Kalman update drive by drive, compiled: the equations of :mod:`dlkf.filters.kalman_update` as loops over rows,
which skip the zeros of H."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from torch import Tensor

from dlkf.navigation.compiled import njit


def update(P: Tensor, H: Tensor, R: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """dx (B, n), Kᵀ (B, m, n) and P⁺ (B, n, n)."""
    dx, Kt, updated = P.new_empty(P.shape[:2]), P.new_empty(H.shape), P.new_empty(P.shape)
    _update(*(x.numpy() for x in (P, H, R, z, dx, Kt, updated)))
    return dx, Kt, updated


@njit(error_model="numpy")  # what cannot be solved is not finite, as with LAPACK, and no error
@no_type_check
def _update(P, H, R, z, dx, Kt, updated):
    B, m, n = H.shape
    HP, surplus = np.empty((m, n), P.dtype), np.empty((m, n), P.dtype)
    S, X = np.empty((m, m), P.dtype), np.empty((n, n), P.dtype)
    W, pivot = np.empty((m, m + n), P.dtype), np.empty(m + n, P.dtype)  # S beside H P
    for b in range(B):
        HP[:] = 0
        S[:] = 0
        for r in range(m):
            for k in range(n):
                h = H[b, r, k]
                if h != 0:
                    for j in range(n):
                        HP[r, j] += h * P[b, k, j]
        for r in range(m):
            for k in range(n):
                h = H[b, r, k]
                if h != 0:
                    for q in range(m):
                        S[q, r] += HP[q, k] * h
            S[r, r] += R[b, r]
        W[:, :m], W[:, m:] = S, HP
        for j in range(m):
            inverse = 1 / W[j, j]
            for c in range(m + n):
                pivot[c] = inverse * W[j, c]
            for i in range(m):
                factor = W[i, j]
                for c in range(m + n):
                    W[i, c] -= factor * pivot[c]
            W[j] = pivot
        K = Kt[b]
        K[:] = W[:, m:]
        X[:] = P[b]
        dx[b] = 0
        for r in range(m):
            for i in range(n):
                a = HP[r, i]
                dx[b, i] += K[r, i] * z[b, r]
                for j in range(n):
                    X[i, j] -= a * K[r, j]
        for r in range(m):
            for j in range(n):
                surplus[r, j] = R[b, r] * K[r, j]
            for k in range(n):
                h = H[b, r, k]
                if h != 0:
                    for j in range(n):
                        surplus[r, j] -= h * X[k, j]
        for r in range(m):
            for i in range(n):
                a = K[r, i]
                for j in range(n):
                    X[i, j] -= a * surplus[r, j]
        for i in range(n):
            for j in range(i + 1):
                updated[b, i, j] = updated[b, j, i] = 0.5 * (X[i, j] + X[j, i])
