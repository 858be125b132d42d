"""Baselines as good as training drives can make them: tuned noise, and the prior knowledge of one IMU.

Nothing here looks at validation or test drives (R018, R111; checklist 4.6).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace

import torch

from dlkf.data.drive import Batch
from dlkf.filters.build import build_filter
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


def outage_rms(estimator: Estimator, batches: Sequence[Batch]) -> float:
    """Horizontal position RMS [m] over the epochs without GNSS of all batches; inf if the filter diverged."""
    square, count = 0.0, 0
    for batch in batches:
        with torch.inference_mode():
            solution = integrate(batch, estimator)
        hidden = ~batch.available & batch.truth_valid & batch.present
        error = (solution.posterior.p_n - batch.truth.p_n)[..., :2].square().sum(-1)[hidden]
        square += float(error.sum())
        count += len(error)
    rms = (square / count) ** 0.5 if count else float("nan")
    return rms if rms == rms else float("inf")


def tuned(
    imu: ImuSpec,
    batches: Sequence[Batch],
    *,
    factors: Mapping[str, Sequence[float]] = FACTORS,
    rounds: int = 2,
    progress: Callable[[str], None] | None = None,
) -> tuple[Tuning, float]:
    """Over-bounding factors of the 15-state filter by coordinate search on training pieces with outages.

    Returns the best factors and their outage RMS [m].
    """
    best = Tuning()
    score = outage_rms(build_filter("mbkf15", imu, tuning=best), batches)
    for _ in range(rounds):
        before = best
        for name, values in factors.items():
            for value in values:
                if value == getattr(best, name):
                    continue
                trial = replace(best, **{name: value})
                rms = outage_rms(build_filter("mbkf15", imu, tuning=trial), batches)
                if rms < score:
                    best, score = trial, rms
            if progress is not None:
                progress(f"tuning {name}: {getattr(best, name):g}, outage RMS {score:.2f} m")
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
            last.append(integrate(seen, build_filter("mbkf15", imu, tuning=tuning)).imu_error[:, -1])
    estimates = torch.cat(last)
    floor = torch.tensor([1e-3] * 3 + [1e-5] * 3, dtype=estimates.dtype)
    mean, spread = estimates.mean(0), torch.maximum(estimates.std(0), floor)
    return tuple(mean.tolist()), tuple(spread.tolist())


def tuning_values(tuning: Tuning) -> dict[str, float]:
    """The factors as plain values for a config, a log or a report."""
    return asdict(tuning)
