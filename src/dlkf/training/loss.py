"""Training loss on position, velocity and attitude (paper eq 9; R061–R067), and two terms of filters with a covariance:

    outage      mean of log(1 + |e|²/m²) of the horizontal error e over the epochs without GNSS
    likelihood  ½ log|P| + ½ (ν + 2) log(1 + eᵀP⁻¹e / ν), horizontal: Student's t with ν = 8 under the filter's own P

Their logarithms keep the few hardest segments of a batch from deciding its gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import reduce
from math import prod
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from dlkf.base.classes import TARGET, instantiate
from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field, settings_from
from dlkf.data.drive import Batch
from dlkf.filters.integration import BatchSolution
from dlkf.navigation.state import NavState
from dlkf.training.processes import count_per_process

TERMS = ("position", "velocity", "attitude")
FREEDOM = 8.0  # ν
SMALLEST_VARIANCE = 1e-4  # m²


@dataclass(frozen=True)
class LossConfig(Ranged, where="loss", least=0, greatest=1e9):
    """``scale`` [m, m/s, rad]: the error where smooth-L1 turns from square to linear; ``prior`` and
    ``posterior``: how much the states before and after the update count (paper.md 2.8, 4.12); ``position``,
    ``velocity``, ``attitude``: fixed factors of the three losses beside the adaptive weights, 0 leaves one out (R124).
    A segment whose position error passes ``diverged_m`` is left out of the batch's loss (paper.md 4.13). ``outage``,
    ``likelihood``: factors of the two terms above."""

    position_scale: float = bounded_field(1.0, 1e-6, 1e9)
    velocity_scale: float = bounded_field(0.1, 1e-6, 1e9)
    attitude_scale: float = bounded_field(0.02, 1e-6, 1e9)
    prior: float = 1.0
    posterior: float = 1.0
    position: float = 1.0
    velocity: float = 1.0
    attitude: float = 1.0
    diverged_m: float = bounded_field(1e4, 1e-3, 1e9)
    outage: float = 0.0
    likelihood: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not ((self.prior + self.posterior) * sum(self.factors.values()) or self.outage or self.likelihood):
            raise InputError(
                "loss: all factors are 0; one of position, velocity and attitude and one of prior and posterior must "
                "be above 0, or outage or likelihood"
            )

    def __call__(self, solution: BatchSolution, batch: Batch) -> Mapping[str, Tensor]:
        """:func:`pva_losses` with these settings."""
        return pva_losses(solution, batch, self)

    @property
    def factors(self) -> dict[str, float]:
        """The fixed factors of position, velocity and attitude."""
        return {term: getattr(self, term) for term in TERMS}


LOSS = ("__call__",)  # method of a loss
PAPER_FIELDS = {f.name for f in fields(LossConfig)}  # settings that lie beside _target_ where a preset is the base
Loss = Callable[[BatchSolution, Batch], Mapping[str, Tensor]]


def pva_losses(solution: BatchSolution, batch: Batch, config: LossConfig) -> dict[str, Tensor]:
    """Mean smooth-L1 of the scaled errors of position, velocity and attitude, without weights and fixed factors.

    Beside them the terms of filters with a covariance. Attitude error is log(C_ref Ĉᵀ), never a difference of angles.
    Epochs without truth do not count; a batch without any attitude truth has an attitude loss of 0. Segments that
    diverged do not count either, in any term.
    """
    off = (solution.posterior.p_n - torch.nan_to_num(batch.truth.p_n)).detach().abs().amax(-1)
    sound = (torch.where(batch.truth_valid & batch.present, off, 0.0) < config.diverged_m).all(1, keepdim=True)
    known = batch.truth_valid & batch.present & sound
    losses = {}
    if config.outage:
        grown = torch.log1p(_horizontal(solution, batch).square().sum(-1))
        losses["outage"] = config.outage * _mean(grown, known & ~batch.available)
    if config.likelihood:
        losses["likelihood"] = config.likelihood * likelihood_term(solution, batch, known)
    total = config.prior + config.posterior
    if not total:
        return losses
    scales = (config.position_scale, config.velocity_scale, config.attitude_scale)
    masks = (batch.truth_valid, batch.truth_valid, batch.attitude_valid)
    eye = torch.eye(3, dtype=batch.imu.dtype, device=batch.imu.device)
    truth = NavState(
        torch.nan_to_num(batch.truth.p_n),
        torch.nan_to_num(batch.truth.v_n),
        torch.where(batch.attitude_valid[..., None, None], batch.truth.C_nb, eye),
    )
    errors = [(w, state.error_to(truth)) for w, state in
              ((config.prior, solution.prior), (config.posterior, solution.posterior)) if w]  # fmt: skip
    for i, (term, scale, mask) in enumerate(zip(TERMS, scales, masks)):
        keep = (mask & batch.present & sound)[..., None]
        count = count_per_process(3 * keep.sum())
        value = batch.imu.new_zeros(())
        for weight, error in errors:
            e = error[..., 3 * i : 3 * i + 3] / scale
            each = smooth_l1_loss(e, torch.zeros_like(e), reduction="none")
            value = value + weight / total * torch.where(keep, each, torch.zeros_like(each)).sum() / count
        losses[term] = value
    return losses


def likelihood_term(solution: BatchSolution, batch: Batch, known: Bool[Tensor, "B T"]) -> Tensor:
    """Half the mean over epochs with GNSS, half that over epochs without, of those with known truth; needs
    ``keep_covariances``."""
    assert solution.covariances is not None
    e = _horizontal(solution, batch)
    P = solution.covariances.updated[..., :2, :2]
    a, b, c = P[..., 0, 0] + SMALLEST_VARIANCE, P[..., 1, 1] + SMALLEST_VARIANCE, P[..., 0, 1]
    det = (a * b - c * c).clamp_min(SMALLEST_VARIANCE**2)
    square = (b * e[..., 0] ** 2 + a * e[..., 1] ** 2 - 2 * c * e[..., 0] * e[..., 1]) / det
    value = 0.5 * det.log() + 0.5 * (FREEDOM + 2) * torch.log1p(square / FREEDOM)
    return 0.5 * (_mean(value, known & batch.available) + _mean(value, known & ~batch.available))


def _horizontal(solution: BatchSolution, batch: Batch) -> Float[Tensor, "B T 2"]:
    return (solution.posterior.p_n - torch.nan_to_num(batch.truth.p_n))[..., :2]


def _mean(value: Float[Tensor, "B T"], where: Tensor) -> Tensor:
    return torch.where(where, value, 0.0).sum() / count_per_process(where.sum())


def build_loss(values: Mapping[str, Any]) -> Loss:
    """The loss of plain settings: that of the paper, or with ``_target_: module.Class`` a user's own.

    The class is called with the settings that it takes, and its object with (solution, batch); it gives a mapping of
    named losses, of which position, velocity and attitude get the weights in force. InputError where it cannot be
    found or takes other settings.
    """
    if TARGET in values:
        return instantiate(values, "loss", LOSS, spare=PAPER_FIELDS)
    return settings_from(LossConfig, values, "loss")


def unit_weights() -> dict[str, float]:
    """Weights of 1."""
    return dict.fromkeys(TERMS, 1.0)


def weighted_loss(losses: Mapping[str, Tensor], *weights: Mapping[str, float]) -> Tensor:
    """w_p L_p + w_v L_v + w_h L_h (paper eq 9), and the terms without weights; several weights of a term multiply."""
    return reduce(torch.add, (prod(w.get(term, 1.0) for w in weights) * loss for term, loss in losses.items()))
