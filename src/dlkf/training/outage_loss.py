"""Loss of filters with a covariance: errors in outages, and likelihood of their own covariance.

    outage      mean of log(1 + |e|²/m²) of the horizontal error e over the epochs without GNSS
    likelihood  ½ log|P| + ½ (ν + 2) log(1 + eᵀP⁻¹e / ν), horizontal: Student's t with ν = 8 under the filter's own P

The logarithms keep the few hardest segments of a batch from deciding its gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import BatchSolution
from dlkf.training.processes import count_per_process

FREEDOM = 8.0  # ν
SMALLEST_VARIANCE = 1e-4  # m²


def outage_term(solution: BatchSolution, batch: Batch) -> Tensor:
    """Mean over the epochs without GNSS; 0 without any."""
    hidden = ~batch.available & batch.truth_valid & batch.present
    return _mean(torch.log1p(_horizontal(solution, batch).square().sum(-1)), hidden)


def likelihood_term(solution: BatchSolution, batch: Batch) -> Tensor:
    """Half the mean over epochs with GNSS, half that over epochs without; needs ``keep_covariances``."""
    assert solution.covariances is not None
    e = _horizontal(solution, batch)
    P = solution.covariances.updated[..., :2, :2]
    a, b, c = P[..., 0, 0] + SMALLEST_VARIANCE, P[..., 1, 1] + SMALLEST_VARIANCE, P[..., 0, 1]
    det = (a * b - c * c).clamp_min(SMALLEST_VARIANCE**2)
    square = (b * e[..., 0] ** 2 + a * e[..., 1] ** 2 - 2 * c * e[..., 0] * e[..., 1]) / det
    value = 0.5 * det.log() + 0.5 * (FREEDOM + 2) * torch.log1p(square / FREEDOM)
    known = batch.truth_valid & batch.present
    return 0.5 * (_mean(value, known & batch.available) + _mean(value, known & ~batch.available))


def _horizontal(solution: BatchSolution, batch: Batch) -> Float[Tensor, "B T 2"]:
    return (solution.posterior.p_n - torch.nan_to_num(batch.truth.p_n))[..., :2]


def _mean(value: Float[Tensor, "B T"], where: Tensor) -> Tensor:
    return torch.where(where, value, 0.0).sum() / count_per_process(where.sum())
