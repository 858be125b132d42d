"""Error-state model of the tangent-frame strapdown over one whole window (checklist 2.1, 2.5, 2.6).

Truth − estimate, order position, velocity, attitude, accelerometer error, gyroscope error:

    δp' = δv
    δv' = G δp − 2W δv − [(C f̂)×] δh − C ε        W = [ω_ie×], G = ∂g/∂p
    δh' = −W δh − C ζ
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.navigation.attitude import rotation_from_vector, skew
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import ACCEL, ATTITUDE, GYRO, POSITION, STATES, VELOCITY, NavState
from dlkf.navigation.strapdown import Window

# Response to a source acting at time τ of a window of length T grows like (T − τ)ⁿ: n per source and state
# block, none where the source does not reach the block within the window.
SOURCES = {
    "accel_noise": (VELOCITY, (1, 0, None, None, None)),
    "gyro_noise": (ATTITUDE, (2, 1, 0, None, None)),
    "accel_walk": (ACCEL, (2, 1, None, 0, None)),
    "gyro_walk": (GYRO, (3, 2, 1, None, 0)),
}


def window_transition(
    start: NavState, window: Window, dt: float, frame: TangentFrame
) -> Float[Tensor, "B 15 15"]:
    """Φ of a whole window in closed form from prefix sums, no product of per-sample matrices.

    With s(t) the specific-force velocity gained since the window's start and C(t) the attitude,

        Φ_vh = −[s(T)×]   Φ_ph = −[∫s×]   Φ_hζ = Φ_vε = −∫C   Φ_pε = −∬C
        Φ_vζ = ∫[C f×] (∫C)   Φ_pζ = ∬[C f×] (∫C)

    plus Earth rotation, Coriolis and gravity gradient to first order in T.
    """
    B, M = window.p_n.shape[:2]
    T = M * dt
    like = {"dtype": window.p_n.dtype, "device": window.p_n.device}
    gravity = frame.gravity(start.p_n + 0.5 * T * start.v_n)
    C_before = torch.cat((start.C_nb.unsqueeze(1), window.C_nb[:, :-1]), 1)
    turned = (0.5 * dt) * (C_before + window.C_nb)  # ∫C over each sample
    A_mid = turned.cumsum(1) - 0.5 * turned
    v_before = torch.cat((start.v_n.unsqueeze(1), window.v_n[:, :-1]), 1)
    gained = window.v_n - v_before - (dt * gravity).unsqueeze(1)
    left = T - (torch.arange(M, **like) + 0.5) * dt  # time from each sample's middle to the end
    lever = torch.linalg.cross(gained.unsqueeze(-1).expand(B, M, 3, 3), A_mid, dim=-2)
    weights = torch.stack((torch.ones_like(left), left))
    integrals = weights @ torch.cat((turned.flatten(2), lever.flatten(2)), -1)  # (B, 2, 18)
    (A1, B1), (A2, B2) = (x.split(9, -1) for x in integrals.unbind(1))

    W = skew(frame.earth_rate_n)
    eye = torch.eye(3, **like)
    Phi = torch.eye(STATES, **like).repeat(B, 1, 1)
    end = window.end
    gradient = torch.diag_embed(frame.gravity_gradient())
    Phi[:, POSITION, POSITION] += 0.5 * T * T * gradient
    Phi[:, POSITION, VELOCITY] = T * eye - T * T * W
    Phi[:, VELOCITY, POSITION] = T * gradient
    Phi[:, VELOCITY, VELOCITY] -= 2 * T * W
    moved = end.p_n - start.p_n
    swept = T / 3 * moved + T * T / 6 * start.v_n  # ∫(p − p₀), exact for constant acceleration
    coriolis_v = 2 * torch.linalg.cross(frame.earth_rate_n, moved)
    coriolis_p = 2 * torch.linalg.cross(frame.earth_rate_n, swept)
    Phi[:, VELOCITY, ATTITUDE] = -skew(end.v_n - start.v_n - T * gravity + coriolis_v)
    Phi[:, POSITION, ATTITUDE] = -skew(moved - T * start.v_n - 0.5 * T * T * gravity + coriolis_p)
    Phi[:, ATTITUDE, ATTITUDE] = rotation_from_vector(-T * frame.earth_rate_n)
    Phi[:, VELOCITY, ACCEL] = -A1.unflatten(-1, (3, 3))
    Phi[:, POSITION, ACCEL] = -A2.unflatten(-1, (3, 3))
    Phi[:, ATTITUDE, GYRO] = -A1.unflatten(-1, (3, 3))
    Phi[:, VELOCITY, GYRO] = B1.unflatten(-1, (3, 3))
    Phi[:, POSITION, GYRO] = B2.unflatten(-1, (3, 3))
    return Phi


def noise_weights(T: float, dtype: torch.dtype, device: torch.device) -> dict[str, Float[Tensor, "15 15"]]:
    """∫ (1−τ/T)^(nᵢ+nⱼ) dτ = T/(nᵢ+nⱼ+1) for every pair of states and each noise source."""
    weights = {}
    for source, (_, powers) in SOURCES.items():
        n = torch.tensor([float("inf") if p is None else float(p) for p in powers], dtype=dtype, device=device)
        n = n.repeat_interleave(3)
        weights[source] = T / (n[:, None] + n[None, :] + 1)
    return weights


def window_noise(
    Phi: Float[Tensor, "B 15 15"], psd: dict[str, float], weights: dict[str, Float[Tensor, "15 15"]]
) -> Float[Tensor, "B 15 15"]:
    """Process noise Q of a whole window from the PSDs of its sources (checklist 2.6, R016).

    Q = Σ_source S ∫ L(τ) L(τ)ᵀ dτ, where the response L(τ) to noise at time τ is the source's column of Φ
    shrunk by (1−τ/T)ⁿ: exact while attitude and specific force are constant over the window. ``psd`` gives S
    of ``accel_noise`` [m²/s³], ``gyro_noise`` [rad²/s], ``accel_walk`` [m²/s⁵] and ``gyro_walk`` [rad²/s³].
    """
    Q = torch.zeros_like(Phi)
    for source, S in psd.items():
        if S:
            L = Phi[:, :, SOURCES[source][0]]
            Q = Q + (S * weights[source]) * (L @ L.mT)
    return Q


def measurement(
    state: NavState,
    rate_b: Float[Tensor, "B 3"],
    lever_arm_b: Float[Tensor, "B 3"],
    frame: TangentFrame,
) -> tuple[Float[Tensor, "B 6"], Float[Tensor, "B 6 15"]]:
    """Predicted antenna position and velocity, and H with the lever arm in it (checklist 2.5).

    ``rate_b`` is the corrected angular rate at the fix [rad/s], ``lever_arm_b`` IMU → antenna [m].
    """
    arm_n = (state.C_nb @ lever_arm_b.unsqueeze(-1)).squeeze(-1)
    swing_n = (state.C_nb @ torch.linalg.cross(rate_b, lever_arm_b).unsqueeze(-1)).squeeze(-1)
    velocity = state.v_n + swing_n - torch.linalg.cross(frame.earth_rate_n, arm_n)
    predicted = torch.cat((state.p_n + arm_n, velocity), -1)
    B = len(arm_n)
    H = torch.zeros(B, 6, STATES, dtype=arm_n.dtype, device=arm_n.device)
    H[:, :3, POSITION] = torch.eye(3, dtype=arm_n.dtype, device=arm_n.device)
    H[:, 3:, VELOCITY] = torch.eye(3, dtype=arm_n.dtype, device=arm_n.device)
    H[:, :3, ATTITUDE] = -skew(arm_n)
    H[:, 3:, ATTITUDE] = -skew(swing_n) + skew(frame.earth_rate_n) @ skew(arm_n)
    H[:, 3:, GYRO] = state.C_nb @ skew(lever_arm_b)
    return predicted, H


def masked(
    H: Float[Tensor, "B 6 15"], R: Float[Tensor, "B 6"], used: Bool[Tensor, "B 6"]
) -> tuple[Float[Tensor, "B 6 15"], Float[Tensor, "B 6"]]:
    """H and diagonal R in which unused components have no effect: zero row, unit variance."""
    return H * used.unsqueeze(-1), torch.where(used, R, torch.ones_like(R))
