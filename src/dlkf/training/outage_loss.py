"""Loss of filters that know how well they know: outages, likelihood of their own covariance, forward speed.

    outage      mean of log(1 + |e|²/m²) of the horizontal error e over the epochs without GNSS
    likelihood  ½ log|P| + ½ (ν + 2) log(1 + eᵀP⁻¹e / ν), horizontal: Student's t with ν = 8 under the filter's own P
    speed       log σ + ½ (κ + 1) log(1 + ((v̂ − v) / σ)² / κ) of a forward speed that a network tells, κ = 4

The logarithms keep the few hardest pieces of a batch from deciding its gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import Solution
from dlkf.training.processes import count_per_process

FREEDOM, SPEED_FREEDOM = 8.0, 4.0  # ν, κ
SMALLEST_VARIANCE = 1e-4  # m²


def outage_term(solution: Solution, batch: Batch) -> Tensor:
    """Mean over the epochs without GNSS; 0 without any."""
    hidden = ~batch.available & batch.truth_valid & batch.present
    return _mean(torch.log1p(_horizontal(solution, batch).square().sum(-1)), hidden)


def likelihood_term(solution: Solution, batch: Batch) -> Tensor:
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


def speed_term(solution: Solution, batch: Batch) -> Tensor:
    """Mean over the epochs with true attitude; 0 for a filter that tells no speed."""
    if solution.speed is None:
        return batch.imu.new_zeros(())
    truth = (torch.nan_to_num(batch.truth.C_nb)[..., 0] * torch.nan_to_num(batch.truth.v_n)).sum(-1)
    told, std = solution.speed.unbind(-1)
    square = ((told - truth) / std).square()
    value = std.log() + 0.5 * (SPEED_FREEDOM + 1) * torch.log1p(square / SPEED_FREEDOM)
    return _mean(value, batch.attitude_valid & batch.present)


def _horizontal(solution: Solution, batch: Batch) -> Float[Tensor, "B T 2"]:
    return (solution.posterior.p_n - torch.nan_to_num(batch.truth.p_n))[..., :2]


def _mean(value: Float[Tensor, "B T"], where: Tensor) -> Tensor:
    return torch.where(where, value, 0.0).sum() / count_per_process(where.sum())
