"""The Kalman prediction and update, and their gradients in closed form.

    S = H P Hᵀ + R    K = P Hᵀ S⁻¹    dx = K z    P⁺ = A P Aᵀ + K R Kᵀ,  A = I − K H      (paper eqs 4–6, Joseph form)

At the optimal gain P⁺ does not change with K to first order, and A P = P⁺, so with u = S⁻¹ z

    ∂P⁺ = A ∂P Aᵀ + K ∂R Kᵀ − K ∂H P⁺ − P⁺ ∂Hᵀ Kᵀ
    ∂dx = A ∂P Hᵀ u − K ∂R u − K ∂H dx + P⁺ ∂Hᵀ u + K ∂z

which takes fewer products than what autograd makes of the update step by step, and solves with S for one column.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.navigation import compiled
from dlkf.navigation.state import PVA


def kalman_prediction(
    P: Float[Tensor, "B n n"], Phi: Float[Tensor, "B n n"], Q: Float[Tensor, "B n n"]
) -> Float[Tensor, "B n n"]:
    """Φ P Φᵀ + Q for symmetric P. Below :data:`PVA` Φ is the identity, for what stands there walks.

    So fewer products do, in C and for the gradient through a Φ that is not learned; with D the rows of Φ − I above,

        Φ P Φᵀ = P + D P + P Dᵀ + D P Dᵀ,  ∂P = Φᵀ ∂P⁻ Φ = (I + D)ᵀ ∂P⁻ (I + D)
    """
    if torch.is_grad_enabled() and P.requires_grad and not Phi.requires_grad:
        return _KalmanPrediction.apply(P, Phi, Q)
    if compiled.is_recorded():
        return propagate_covariance(P, Phi[:, PVA]) + Q
    return torch.baddbmm(Q, Phi, torch.bmm(Phi, P).mT)


def propagate_covariance(P: Float[Tensor, "B n n"], top: Float[Tensor, "B 9 n"]) -> Float[Tensor, "B n n"]:
    """Φ P Φᵀ for symmetric P, where Φ is the identity below its rows ``top``."""
    TP = torch.bmm(top, P)
    cross = TP[:, :, PVA.stop :]
    upper = torch.cat((torch.bmm(TP, top.mT), cross), -1)
    lower = torch.cat((cross.mT, P[:, PVA.stop :, PVA.stop :]), -1)
    return torch.cat((upper, lower), 1)


def kalman_update(
    P: Float[Tensor, "B n n"], H: Float[Tensor, "B m n"], R: Float[Tensor, "B m"], z: Float[Tensor, "B m"]
) -> tuple[Float[Tensor, "B n"], Float[Tensor, "B n m"], Float[Tensor, "B n n"]]:
    """Correction, gain and covariance for symmetric P and diagonal R; the gain is returned without a gradient."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in (P, H, R, z)):
        return _KalmanUpdate.apply(P, H, R, z)
    return _compute_update(P, H, R, z)[:3]


def _compute_update(P: Tensor, H: Tensor, R: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """dx, K, P⁺ and S. For any K, P⁺ = X − K (H X − R Kᵀ) with X = P − (H P)ᵀ Kᵀ: no product of n × n matrices."""
    HP = torch.bmm(H, P)
    S = torch.baddbmm(torch.diag_embed(R), HP, H.mT)
    Kt = _solve(S, HP)
    X = torch.baddbmm(P, HP.mT, Kt, alpha=-1)
    surplus = torch.baddbmm(R.unsqueeze(-1) * Kt, H, X, beta=-1)
    dx = torch.bmm(Kt.mT, z.unsqueeze(-1)).squeeze(-1)
    P = torch.baddbmm(X, Kt.mT, surplus, alpha=-1)
    return dx, Kt.mT, torch.lerp(P, P.mT, 0.5), S


def _solve(S: Float[Tensor, "B m m"], X: Float[Tensor, "B m n"]) -> Float[Tensor, "B m n"]:
    """S⁻¹ X."""
    return compiled.solve(S, X) if compiled.fits(S) else torch.linalg.solve_ex(S, X)[0]


class _KalmanPrediction(torch.autograd.Function):
    """Names as in :func:`kalman_prediction`."""

    @staticmethod
    def forward(ctx, P, Phi, Q):
        D = Phi[:, PVA].clone()
        D.diagonal(dim1=-2, dim2=-1).sub_(1)
        ctx.save_for_backward(D)
        DP = torch.bmm(D, P)
        out = P + Q
        out[:, PVA].add_(DP)
        out[:, :, PVA].add_(DP.mT)
        out[:, PVA, PVA].add_(torch.bmm(DP, D.mT))
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g):
        (D,) = ctx.saved_tensors
        of_P = torch.baddbmm(g, D.mT, g[:, PVA])
        return of_P.baddbmm_(of_P[:, :, PVA].clone(), D), None, g


class _KalmanUpdate(torch.autograd.Function):
    """Names as in the module's equations."""

    @staticmethod
    def forward(ctx, P, H, R, z):
        dx, K, updated, S = _compute_update(P, H, R, z)
        ctx.save_for_backward(H, z, dx, K, updated, S)
        ctx.mark_non_differentiable(K)
        return dx, K, updated

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, of_dx, _of_K, of_P):
        H, z, dx, K, updated, S = ctx.saved_tensors
        Kt, g = K.mT, of_dx.unsqueeze(-1)
        u = _solve(S, z.unsqueeze(-1))
        G = torch.lerp(of_P, of_P.mT, 0.5)
        KG, Kg = torch.bmm(Kt, G), torch.bmm(Kt, g)
        KGK = torch.bmm(KG, K)
        # Aᵀ G A + Aᵀ g uᵀ H, without A
        inner = torch.baddbmm(KG, KGK, H, alpha=-1)
        outer = torch.baddbmm(KG.mT, g - torch.bmm(H.mT, Kg), u.mT, beta=-1)
        of_P = torch.baddbmm(G, H.mT, inner, alpha=-1).baddbmm_(outer, H)
        of_H = None
        if ctx.needs_input_grad[1]:
            of_H = torch.baddbmm(torch.bmm(u, torch.bmm(g.mT, updated)), KG, updated, alpha=-2)
            of_H = torch.baddbmm(of_H, Kg, dx.unsqueeze(-2), alpha=-1)
        of_R = KGK.diagonal(dim1=-2, dim2=-1) - (u * Kg).squeeze(-1)
        return of_P, of_H, of_R, Kg.squeeze(-1)
