"""Rotations on tensors: rotation vectors, matrices, quaternions, roll-pitch-yaw, prefix products."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_TINY = 1e-30  # keeps sin(x)/x finite at zero; its root vanishes against 1 in any precision


def skew(u: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Cross-product matrix [u×]: skew(u) @ a = u × a."""
    x, y, z = u.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), -1).unflatten(-1, (3, 3))


def rotation_from_vector(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """exp([φ×]) by Rodrigues' formula; φ [rad]. Smooth at zero (series below 0.1 rad)."""
    x = (phi * phi).sum(-1)
    small = x < 1e-2
    safe = torch.where(small, torch.ones_like(x), x)
    angle = torch.sqrt(safe)
    a = torch.where(small, 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72))), torch.sin(angle) / angle)
    half = torch.sin(angle / 2) / angle
    b = torch.where(small, (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90)))) / 2, 2 * half * half)
    K = skew(phi)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + a[..., None, None] * K + b[..., None, None] * (K @ K)


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
    return torch.stack(
        (torch.atan2(C[..., 2, 1], C[..., 2, 2]), pitch, torch.atan2(C[..., 1, 0], C[..., 0, 0])), -1
    )


def orthonormalised(C: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """One Newton step towards the nearest rotation, C(3I − CᵀC)/2: enough for rounding errors."""
    eye = torch.eye(3, dtype=C.dtype, device=C.device)
    return 0.5 * C @ (3 * eye - C.mT @ C)


def prefix_rotations(phi: Float[Tensor, "3 b m"]) -> Float[Tensor, "3 3 b m"]:
    """All prefix products exp([φ₁×]) … exp([φ_k×]), k = 1…m, in log₂(m) doubling steps, no Python loop over m.

    Axes come first, so that every operation runs over contiguous planes. A rotation is carried as the
    Cayley-Klein pair (α, β) = (w + i z, y − i x) of its quaternion: two complex numbers multiply in a third
    of the tensor operations that a quaternion needs.
    """
    half = torch.sqrt(0.25 * (phi * phi).sum(0) + _TINY)
    u = (0.5 * torch.sin(half) / half) * phi
    a, b = torch.complex(torch.cos(half), u[2]), torch.complex(u[1], -u[0])
    step = 1
    while step < a.shape[1]:
        a0, b0, a1, b1 = a[:, :-step], b[:, :-step], a[:, step:], b[:, step:]
        a = torch.cat((a[:, :step], a0 * a1 - b0 * b1.conj()), 1)
        b = torch.cat((b[:, :step], a0 * b1 + b0 * a1.conj()), 1)
        step *= 2
    w, x, y, z = a.real, -b.imag, b.real, a.imag
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    return torch.stack(
        (
            1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
            2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
            2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
        ),
    ).unflatten(0, (3, 3))  # fmt: skip
