"""Baselines as good as training drives can make them: tuned noise, and the prior knowledge of one IMU.

Nothing here looks at validation or test drives (R018; paper.md 4.6).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import NamedTuple

import torch

from dlkf.data.drive import Batch
from dlkf.filters.build import build_causal
from dlkf.filters.integration import Estimator, integrate
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec

FACTORS: Mapping[str, tuple[float, ...]] = {
    "accel_noise": (1.0, 3.0, 10.0, 30.0, 100.0),
    "gyro_noise": (1.0, 3.0, 10.0, 30.0, 100.0),
    "accel_walk": (1.0, 10.0, 100.0, 1000.0),
    "gyro_walk": (1.0, 10.0, 100.0, 1000.0),
    "velocity_std": (0.5, 1.0, 2.0, 5.0),
    "position_std": (0.5, 1.0, 2.0, 5.0),
}


# what a filter with these endings, or of this base, is told beside
MORE_FACTORS: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "nhc": {"lateral_std": (0.05, 0.1, 0.2, 0.5, 1.0), "vertical_std": (0.05, 0.1, 0.2, 0.5, 1.0)},
    "car": {"lateral_std": (0.02, 0.05, 0.1, 0.2, 0.5), "vertical_std": (0.02, 0.05, 0.1, 0.2, 0.5)},
    "gated": {"gate": (0.99, 0.999, 0.9999, 0.999999)},
    "aekf": {"forgetting": (0.3, 0.7, 0.9, 0.97, 0.99, 0.997)},
}
OBJECTIVES = ("rms", "median", "log")


class Trial(NamedTuple):
    """One point of the search: which factor had which value, and the objective [m]."""

    factor: str
    value: float
    score: float


def factors_of(name: str) -> dict[str, tuple[float, ...]]:
    """The factors of a filter that a search tries, and their values."""
    found = dict(FACTORS)
    for part in name.partition("+")[0].split("_"):
        found |= MORE_FACTORS.get(part, {})
    return found


def outage_error(estimator: Estimator, batches: Sequence[Batch], objective: str = "rms") -> float:
    """Horizontal position error [m] over the epochs without GNSS of all batches; inf if the filter diverged.

    ``rms`` over all epochs, which a few hard outages decide; or over each piece, and of these the ``median`` or
    the geometric mean (``log``), to which every piece counts alike.
    """
    squares, counts = [], []
    for batch in batches:
        with torch.inference_mode():
            solution = integrate(batch, estimator)
        hidden = ~batch.available & batch.truth_valid & batch.present
        error = (solution.posterior.p_n - batch.truth.p_n)[..., :2].square().sum(-1)
        squares.append(torch.where(hidden, error, 0.0).sum(-1))
        counts.append(hidden.sum(-1))
    square, count = torch.cat(squares), torch.cat(counts)
    seen = count > 0
    if not (bool(square.isfinite().all()) and bool(seen.any())):
        return float("inf")
    if objective == "rms":
        return float(square.sum() / count.sum()) ** 0.5
    pieces = (square[seen] / count[seen]).sqrt()
    return float(pieces.quantile(0.5) if objective == "median" else pieces.clamp_min(1e-3).log().mean().exp())


def tuned(
    imu: ImuSpec,
    batches: Sequence[Batch],
    *,
    name: str = "mbkf15",
    factors: Mapping[str, Sequence[float]] | None = None,
    start: Tuning | None = None,
    objective: str = "rms",
    rounds: int = 2,
    progress: Callable[[Trial], None] | None = None,
) -> tuple[Tuning, float]:
    """Over-bounding factors of a filter by coordinate search on training pieces with outages.

    Returns the best factors and their :func:`outage_error` [m]; ``progress`` is told every trial.
    """

    def judged(trial: Tuning) -> float:
        return outage_error(build_causal(name, imu, "tuning does not", tuning=trial), batches, objective)

    best = start or Tuning()
    score = judged(best)
    for _ in range(rounds):
        before = best
        for factor, values in (factors or factors_of(name)).items():
            for value in values:
                if value == getattr(best, factor):
                    continue
                trial = replace(best, **{factor: value})
                error = judged(trial)
                if progress is not None:
                    progress(Trial(factor, value, error))
                if error < score:
                    best, score = trial, error
        if best == before:
            break
    return best, score


def mean_imu_error(
    imu: ImuSpec, tuning: Tuning, batches: Sequence[Batch]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and spread of the IMU error over training pieces, as the 15-state filter estimates it with GNSS.

    No truth is used. The spread of the estimates about their mean is what a filter that starts from the mean
    still has to find: the estimator's own scatter where all drives share one IMU, the turn-on spread where
    they do not.
    """
    last = []
    for batch in batches:
        seen = replace(batch, available=torch.ones_like(batch.available))
        with torch.inference_mode():
            filtered = integrate(seen, build_causal("mbkf15", imu, "a prior does not", tuning=tuning))
        last.append(filtered.imu_error[:, -1])
    estimates = torch.cat(last)
    floor = torch.tensor([1e-3] * 3 + [1e-5] * 3, dtype=estimates.dtype)
    mean, spread = estimates.mean(0), torch.maximum(estimates.std(0), floor)
    return tuple(mean.tolist()), tuple(spread.tolist())


def tuning_values(tuning: Tuning) -> dict[str, float]:
    """The factors as plain values for a config, a log or a report."""
    return asdict(tuning)
