"""Rauch-Tung-Striebel smoother over a closed-loop error-state filter, over a whole drive (Groves 3.4.3).

A closed-loop filter starts every epoch with a zero error state, so what future fixes add to epoch k beyond its
filtered state is δₖ, the smoothed error of that state:

    δₖ = Gₖ (dxₖ₊₁ + δₖ₊₁)     Gₖ = Pₖ⁺ Φₖ₊₁ᵀ (Pₖ₊₁⁻)⁻¹     Pₖˢ = Pₖ⁺ + Gₖ (Pₖ₊₁ˢ − Pₖ₊₁⁻) Gₖᵀ

with dxₖ₊₁ the correction that the filter made at k+1. The smoothed state is the filtered one ⊞ δₖ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.data.drive import Batch
from dlkf.filters.g_sensitivity import has_g_sensitivity, select_matrix
from dlkf.filters.integration import BatchSolution, Estimator, integrate
from dlkf.filters.model_based import has_covariance
from dlkf.navigation.state import IMU, PVA, STATES, NavState

NO_COVARIANCE = "smoother=rts needs a filter with a covariance: plus, or mbkf15, mbkf21, mbkf33, aekf with endings"
ROUNDING = 1e-13  # added to unit variances


@dataclass(frozen=True)
class SmoothedSolution:
    """A filter whose solution is to be smoothed: no estimator, since its output at an epoch needs those after it."""

    filter: Estimator


Filter = Estimator | SmoothedSolution  # what runs over whole drives


def run_smoother(estimator: Filter, smoother: str) -> SmoothedSolution:
    """A filter to be smoothed by name (``rts``); InputError for another name or a filter without a covariance."""
    if smoother != "rts":
        raise InputError(f"unknown smoother {smoother!r}; known: rts")
    if not (isinstance(estimator, SmoothedSolution) or has_covariance(estimator)):
        raise InputError(NO_COVARIANCE)
    return estimator if isinstance(estimator, SmoothedSolution) else SmoothedSolution(estimator)


def smooth(batch: Batch, estimator: Estimator) -> BatchSolution:
    """Filter a batch forwards and smooth it backwards; the solution's posterior, IMU error and std are smoothed.

    Epochs in the padding after a segment's end carry nothing back. Raises InputError for a filter without a
    covariance (``ins``, a learned filter).
    """
    filtered = integrate(batch, estimator, keep_covariances=True)
    known = filtered.covariances
    if known is None:
        raise InputError(NO_COVARIANCE)
    present = batch.present.to(known.updated.device)
    T = present.shape[1]
    delta, P = torch.zeros_like(known.dx[:, -1]), known.updated[:, -1]
    deltas, variances = [delta], [P.diagonal(dim1=-2, dim2=-1)]
    for k in range(T - 2, -1, -1):
        predicted, updated = known.predicted[:, k + 1], known.updated[:, k]
        G = _gain(predicted, known.Phi[:, k + 1] @ updated)
        here = present[:, k + 1, None]
        carried = (G @ (known.dx[:, k + 1] + delta).unsqueeze(-1)).squeeze(-1)
        delta = torch.where(here, carried, 0.0)
        smoothed = updated + G @ (P - predicted) @ G.mT
        P = torch.where(here.unsqueeze(-1), 0.5 * (smoothed + smoothed.mT), updated)
        deltas.append(delta)
        variances.append(P.diagonal(dim1=-2, dim2=-1))
    dx, variance = (torch.stack(x[::-1], 1) for x in (deltas, variances))
    variance = variance[..., :STATES].clamp_min(0)
    if filtered.std is not None:  # the slow part of the fixes' errors is in 1σ beside P, and no smoother averages it
        beside = filtered.std.square() - known.updated.diagonal(dim1=-2, dim2=-1)[..., :STATES]
        variance = variance + beside.clamp_min(0)
    return replace(
        filtered,
        posterior=NavState(*filtered.posterior).correct(dx[..., PVA]),
        imu_error=filtered.imu_error + dx[..., IMU] + _matrix_part(filtered, dx, batch, estimator),
        std=variance.sqrt(),
    )


def _gain(predicted: Tensor, cross: Tensor) -> Tensor:
    """(P⁻⁻¹ Φ P⁺)ᵀ, with states brought to unit variance; one that is known for certain (variance 0) gains nothing."""
    sigma = predicted.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    certain = sigma == 0
    unit = torch.where(certain, 1.0, sigma)
    normalised = predicted / (unit.unsqueeze(-1) * unit.unsqueeze(-2)) + torch.diag_embed(certain + ROUNDING)
    solved = torch.cholesky_solve(cross / unit.unsqueeze(-1), torch.linalg.cholesky_ex(normalised)[0])
    return (solved / unit.unsqueeze(-1)).mT


def _matrix_part(filtered: BatchSolution, dx: Tensor, batch: Batch, estimator: Any) -> Tensor | float:
    """What the smoothed change of sensor matrices and g-sensitivity makes of each epoch's mean sample (B, T, 6)."""
    states = estimator.states
    mean = batch.imu.mean(2) - filtered.imu_error
    if has_g_sensitivity(states):
        change = select_matrix(dx.flatten(0, -2)[:, states.of_others], states)
        shown = torch.bmm(change, mean.flatten(0, -2)[:, :2].unsqueeze(-1)).reshape(*mean.shape[:-1], 3)
        of_force = torch.nn.functional.pad(shown, (3, 0))
    else:
        of_force = 0.0
    if not states.elements:
        return of_force
    change = dx[..., states.of_matrix].unflatten(-1, (2, -1))
    parts = torch.zeros_like(mean).unflatten(-1, (2, 3))
    for n, (i, j) in enumerate(states.elements):
        parts[..., i] += change[..., n] * mean.unflatten(-1, (2, 3))[..., j]
    return parts.flatten(-2) + of_force
