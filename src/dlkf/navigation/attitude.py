"""Rotations on tensors: rotation vectors, matrices, quaternions, roll-pitch-yaw, prefix products."""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation import compiled

_TINY = 1e-30  # keeps sin(x)/x finite at zero; its root vanishes against 1 in any precision


@lru_cache
@torch.inference_mode(False)
def _skew_map(dtype: torch.dtype, device: torch.device) -> Tensor:
    """(3, 9): u ↦ [u×] row by row."""
    levi_civita = torch.zeros(3, 3, 3, dtype=dtype, device=device)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        levi_civita[j, i, k], levi_civita[j, k, i] = 1, -1
    return levi_civita.flatten(1)


@lru_cache
@torch.inference_mode(False)
def _quaternion_maps(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """(16, 4): q ↦ the matrix of multiplication by q from the left; (9, 16): q qᵀ ↦ rotation matrix, by rows."""
    like = {"dtype": dtype, "device": device}
    w, x, y, z = torch.eye(4, **like)
    left = torch.stack((w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w))
    rotation = torch.zeros(9, 4, 4, **like)
    signs = ((1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1))
    for i, row in enumerate(signs):
        rotation[4 * i] = torch.diag(torch.tensor(row, **like))
    for i, j, k, sign in ((0, 1, 2, -1), (1, 0, 2, 1), (0, 2, 1, 1), (2, 0, 1, -1), (1, 2, 0, -1), (2, 1, 0, 1)):
        rotation[3 * i + j, 1 + i, 1 + j] = 2
        rotation[3 * i + j, 0, 1 + k] = 2 * sign
    return left, rotation.flatten(1)


def skew(u: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Cross-product matrix [u×]: skew(u) @ a = u × a."""
    return (u @ _skew_map(u.dtype, u.device)).unflatten(-1, (3, 3))


def rotation_from_vector(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """exp([φ×]) through the quaternion of φ [rad]; smooth at zero."""
    if compiled.fits(phi):
        return compiled.rotations(phi)
    planes = phi.reshape(-1, 3).mT
    return _rotation_planes(_quaternion_planes(planes)).movedim(-1, 0).reshape(*phi.shape, 3)


def _quaternion_planes(phi: Tensor) -> Tensor:
    """Quaternions (4, …), scalar first, of rotation vectors (3, …)."""
    half = torch.sqrt(0.25 * (phi * phi).sum(0, keepdim=True) + _TINY)
    return torch.cat((torch.cos(half), (0.5 * torch.sin(half) / half) * phi))


def _rotation_planes(q: Tensor) -> Tensor:
    """Rotation matrices (3, 3, …) of unit quaternions (4, …)."""
    rotation = _quaternion_maps(q.dtype, q.device)[1]
    pairs = (q.unsqueeze(0) * q.unsqueeze(1)).reshape(16, -1)
    return (rotation @ pairs).reshape(3, 3, *q.shape[1:])


def vector_from_rotation(C: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector log(C) [rad], |φ| ≤ π, through the quaternion: accurate for small and large angles."""
    q = quaternion_from_rotation(C)
    w, u = q[..., :1], q[..., 1:]
    u, w = torch.where(w < 0, -u, u), w.abs()
    x = (u * u).sum(-1, keepdim=True)
    small = x < 1e-8
    s = torch.sqrt(torch.where(small, torch.ones_like(x), x))
    scale = torch.where(small, 2 / w.clamp_min(0.5) * (1 - x / (3 * w * w).clamp_min(0.25)), 2 * torch.atan2(s, w) / s)
    return scale * u


def quaternion_from_rotation(C: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion, scalar first, by the largest of the four pivots (Shepperd 1978)."""
    m00, m01, m02 = C[..., 0, 0], C[..., 0, 1], C[..., 0, 2]
    m10, m11, m12 = C[..., 1, 0], C[..., 1, 1], C[..., 1, 2]
    m20, m21, m22 = C[..., 2, 0], C[..., 2, 1], C[..., 2, 2]
    pivots = torch.stack((1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), -1)
    rows = torch.stack(
        (
            torch.stack((pivots[..., 0], m21 - m12, m02 - m20, m10 - m01), -1),
            torch.stack((m21 - m12, pivots[..., 1], m10 + m01, m02 + m20), -1),
            torch.stack((m02 - m20, m10 + m01, pivots[..., 2], m21 + m12), -1),
            torch.stack((m10 - m01, m02 + m20, m21 + m12, pivots[..., 3]), -1),
        ),
        -2,
    )
    best = pivots.argmax(-1)[..., None, None].expand(*pivots.shape[:-1], 1, 4)
    q = rows.gather(-2, best).squeeze(-2)
    return q / q.norm(dim=-1, keepdim=True)


def rotation_from_rpy(rpy: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """C_nb from roll, pitch, yaw [rad]: C = Rz(yaw) Ry(pitch) Rx(roll) (Groves 2.22 transposed)."""
    cr, cp, cy = torch.cos(rpy).unbind(-1)
    sr, sp, sy = torch.sin(rpy).unbind(-1)
    return torch.stack(
        (
            cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy,
            cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy,
            -sp, sr * cp, cr * cp,
        ),
        -1,
    ).unflatten(-1, (3, 3))  # fmt: skip


def rpy_from_rotation(C: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Roll, pitch, yaw [rad] of C_nb, yaw in (−π, π] (Groves 2.23)."""
    pitch = torch.atan2(-C[..., 2, 0], torch.hypot(C[..., 2, 1], C[..., 2, 2]))
    return torch.stack((torch.atan2(C[..., 2, 1], C[..., 2, 2]), pitch, torch.atan2(C[..., 1, 0], C[..., 0, 0])), -1)


def orthonormalise(C: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """One Newton step towards the nearest rotation, C(3I − CᵀC)/2: enough for rounding errors."""
    flat = C.reshape(-1, 3, 3)
    return torch.baddbmm(flat, flat, torch.bmm(flat.mT, flat), beta=1.5, alpha=-0.5).reshape(C.shape)


def prefix_rotations(phi: Float[Tensor, "3 b m"]) -> Float[Tensor, "3 3 b m"]:
    """All prefix products exp([φ₁×]) … exp([φ_k×]), k = 1…m, in log₂(m) doubling steps, no Python loop over m.

    Axes come first, so that every operation runs over contiguous planes; rotations are quaternions, multiplied by
    the matrix of left multiplication, in six tensor operations a step.
    """
    q = _quaternion_planes(phi)
    left = _quaternion_maps(q.dtype, q.device)[0]
    step = 1
    while step < q.shape[2]:
        earlier = q[..., :-step]
        matrix = (left @ earlier.reshape(4, -1)).reshape(4, 4, *earlier.shape[1:])
        q = torch.cat((q[..., :step], (matrix * q[..., step:]).sum(1)), -1)
        step *= 2
    return _rotation_planes(q)
