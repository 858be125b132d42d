"""Search of noise factors, and of the prior IMU error of drives that share one IMU.

Nothing here looks at validation or test drives (R018; paper.md 4.6).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress, show_progress, warn_once
from dlkf.base.errors import InputError
from dlkf.data.drive import Batch
from dlkf.evaluation.metrics import PVA, end_errors, geometric_mean, mean_error, segment_errors
from dlkf.filters.build import FilterName, build_causal
from dlkf.filters.integration import Estimator, integrate
from dlkf.filters.model_based import Mbkf, bias_sigma
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.state import ErrorStates
from dlkf.onboard.compiled_filter import CompiledFilter, compile_filter

FACTORS: Mapping[str, tuple[float, ...]] = {
    "accel_noise": (1.0, 3.0, 10.0, 30.0, 100.0),
    "gyro_noise": (1.0, 3.0, 10.0, 30.0, 100.0),
    "accel_walk": (1.0, 10.0, 100.0, 1000.0),
    "gyro_walk": (1.0, 10.0, 100.0, 1000.0),
    "velocity_std": (0.5, 1.0, 2.0, 5.0),
    "position_std": (0.5, 1.0, 2.0, 5.0),
}

IN_C = 3600  # epochs of segments from which on a search pays for the library that its filter has to be made into
BIAS_SPREADS = (3.0, 1.0, 0.3, 0.1)  # of the mean IMU error's 1σ
MATRIX_SPREADS = (10.0, 3.0, 1.0, 0.3)
PATIENCE = 2  # values in a row that are worse, before the rest on that side is left out

CONSTRAINT_STDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # m/s

# what a filter with these endings, or of this base, takes besides
MORE_FACTORS: Mapping[str, Mapping[str, tuple[float, ...]]] = {
    "nhc": {"lateral_std": CONSTRAINT_STDS, "vertical_std": CONSTRAINT_STDS},
    "car": {"lateral_std": CONSTRAINT_STDS, "vertical_std": CONSTRAINT_STDS},
    "gated": {"gate": (0.99, 0.999, 0.9999, 0.999999)},
    "speed": {"wheel_std": (0.03, 0.05, 0.1, 0.2, 0.5)},
    "heading": {"heading_std": (0.5, 1.0, 2.0, 5.0)},
    "baro": {"baro_std": (0.2, 0.5, 1.0, 2.0)},
    "aekf": {"forgetting": (0.3, 0.7, 0.9, 0.97, 0.99, 0.997)},
}


class Trial(NamedTuple):
    """One point of the search: which factor had which value, and the objective."""

    factor: str
    value: float
    score: float


def list_factors(name: str) -> dict[str, tuple[float, ...]]:
    """The factors of a filter that a search tries, and their values."""
    found = dict(FACTORS)
    base, endings, own = FilterName.parse(name)
    for part in (base, *endings, *own):
        found |= MORE_FACTORS.get(part, {})
    return found


def evaluate_objective(estimator: Estimator, batches: Sequence[Batch], objective: str = "log") -> float:
    """What tuning makes small, over all batches; inf if the filter diverged or there is nothing to compare.

    ``log``, ``rms``, ``median``: horizontal error [m] at the end of the outages
    (:func:`dlkf.evaluation.metrics.mean_error`). ``pva``: geometric mean of the RMS of position [m], velocity [m/s] and
    attitude [rad] over each segment: where factors change all three by the same share, so does this.
    """
    measure = segment_errors if objective == PVA else end_errors
    found = []
    for batch in batches:
        with torch.inference_mode():
            found.append(measure(batch, integrate(batch, estimator).posterior))
    errors = np.concatenate(found)
    if objective == PVA:
        known = errors[~np.isnan(errors)]
        return geometric_mean(known) if len(known) else math.inf
    error = mean_error(errors, objective)
    return math.inf if math.isnan(error) else error


def tune_filter(
    imu: ImuSpec,
    batches: Sequence[Batch],
    *,
    name: str = "mbkf15",
    factors: Mapping[str, Sequence[float]] | None = None,
    start: Tuning | None = None,
    objective: str = "log",
    rounds: int = 2,
    prior: Prior | None = None,
    progress: ProgressCallback = no_progress,
) -> tuple[Tuning, float, list[Trial]]:
    """Over-bounding factors of a filter by coordinate search on training segments.

    A factor goes up its values, or down them, until two in a row are worse; nothing is tried twice. From an hour of
    segments on trials run compiled (:mod:`dlkf.onboard`), which is the same to rounding; where they cannot, a line
    has the reason. ``prior`` is given to a filter with ``_prior``. Returns the best factors, their
    :func:`evaluate_objective`, and the trials; ``progress`` gets how many they are and can be at most.
    """
    best = start or Tuning()

    def build(trial: Tuning) -> Estimator:
        return build_causal(name, imu, "tuning does not", tuning=trial, prior=prior)

    in_c = _fits_c(build(best), batches)

    @cache
    def evaluate(trial: Tuning) -> float:
        return evaluate_objective(_in_c(build(trial), batches[0]) if in_c else build(trial), batches, objective)

    score, factors, trials = evaluate(best), factors or list_factors(name), list[Trial]()
    most = rounds * sum(map(len, factors.values()))
    for _ in range(rounds):
        before = best
        for factor, values in factors.items():
            now = getattr(best, factor)
            up, down = sorted(v for v in values if v > now), sorted((v for v in values if v < now), reverse=True)
            for side in (up, down):
                worse = 0
                for value in side:
                    trial = replace(best, **{factor: value})
                    error = evaluate(trial)
                    trials.append(Trial(factor, value, error))
                    progress(len(trials), most)
                    worse = 0 if error < score else worse + 1
                    if error < score:
                        best, score = trial, error
                    elif worse == PATIENCE and math.isfinite(score):
                        break
                if getattr(best, factor) != now:
                    break
        if best == before:
            break
    return best, score, trials


def tune_under_bar(
    imu: ImuSpec, batches: Sequence[Batch], name: str, rounds: int, **options: Any
) -> tuple[Tuning, float, list[Trial]]:
    """:func:`tune_filter` under a bar, for it takes minutes on much data."""
    with show_progress(f"Tuning {name}") as bar:
        return tune_filter(imu, batches, name=name, rounds=rounds, progress=bar, **options)


def _in_c(estimator: Estimator, batch: Batch) -> CompiledFilter:
    return compile_filter(estimator, 1 / batch.dt, batch.epoch_s)


def _fits_c(estimator: Estimator, batches: Sequence[Batch]) -> bool:
    """Whether trials run compiled: it pays, and a library can be made of the filter, which may be one's own."""
    if sum(int(b.present.sum()) for b in batches) < IN_C:
        return False
    try:
        _in_c(estimator, batches[0])
    except (InputError, OSError) as error:  # OSError: a cache that cannot be written, a library that cannot be loaded
        warn_once(f"trials run in torch, some 3 × slower: {error}")
        return False
    return True


def mean_imu_error(imu: ImuSpec, tuning: Tuning, batches: Sequence[Batch], name: str = "mbkf15") -> Prior:
    """Mean and spread of the IMU error over training segments, as a filter estimates it with GNSS.

    No truth is used. Biases: mean and spread of the estimates. The spread is what a filter that starts from the mean
    still has to find: the estimator's own scatter where all drives share one IMU, the turn-on spread where they do
    not; of a single segment, which has no scatter, the turn-on spread of the preset. Sensor matrices, which a segment
    of a minute or two hardly shows: all segments together as measurements of one unit, Λ = Λ₀ + Σ (Pᵢ⁻¹ − Λ₀) and mean
    Λ⁻¹ Σ Pᵢ⁻¹ xᵢ for estimates xᵢ, Pᵢ that began at zero and Λ₀⁻¹. (A turn of all axes together is not separable from
    attitude; it does no harm, but its spread comes out too small.)
    """
    estimator = build_causal(name, imu, "a prior does not", tuning=tuning)
    assert isinstance(estimator, Mbkf)
    states = estimator.states
    last, pulls, gains, before = [], [], [], None
    for batch in batches:
        seen = replace(batch, available=torch.ones_like(batch.available))
        with torch.inference_mode():
            filtered = integrate(seen, estimator, keep_covariances=True)
            before = _information(estimator.begin(seen)[0].P, states)[0]
        assert filtered.covariances is not None and filtered.error is not None
        known = _information(filtered.covariances.updated[:, -1], states)
        last.append(torch.cat((filtered.error.bias, filtered.error.elements(states)), -1)[:, -1].double())
        gains.append((known - before).sum(0))
        pulls.append((known @ last[-1][:, 6:, None]).sum(0))
    estimates = torch.cat(last)
    floor = torch.tensor([1e-3] * 3 + [1e-5] * (states.imu - 3), dtype=estimates.dtype)
    mean, spread = estimates.mean(0), torch.zeros_like(estimates[0])
    spread[:6] = estimates[:, :6].std(0) if len(estimates) > 1 else bias_sigma(imu, states)
    if states.elements:
        assert before is not None
        together = torch.linalg.inv(before + torch.stack(gains).sum(0))
        mean[6:] = (together @ torch.stack(pulls).sum(0))[:, 0]
        spread[6:] = together.diagonal().sqrt()
    return Prior(tuple(mean.tolist()), tuple(torch.maximum(spread, floor).tolist()))


def _information(P: Float[Tensor, "B n n"], states: ErrorStates) -> Float[Tensor, "B m m"]:
    """Inverse covariance of the sensor matrices, the other states unknown."""
    return torch.linalg.inv(P[:, states.of_matrix, states.of_matrix].double())


def best_prior(
    imu: ImuSpec,
    tunings: Sequence[Tuning],
    batches: Sequence[Batch],
    name: str = "mbkf15_prior",
    objective: str = "log",
    longer: Sequence[Batch] | None = None,
) -> tuple[Prior, Tuning]:
    """The prior, and the factors of ``tunings`` with it, with which ``name`` has the least objective on ``batches``.

    The mean IMU error is found with each of the factors on ``longer`` segments with GNSS throughout (default:
    ``batches``). Its spread is tried times several numbers, for biases and sensor matrices apart: it is the estimator's
    scatter where all drives share one IMU, and then too wide or, of many segments together, too narrow.
    """
    tunings = list(dict.fromkeys(tunings))
    without_prior = FilterName.parse(name).drop("prior")
    known = [mean_imu_error(imu, tuning, longer or batches, without_prior) for tuning in tunings]
    spreads = product(BIAS_SPREADS, MATRIX_SPREADS if len(known[0].mean) > 6 else (1.0,))
    trials = [(p.scale_spread(*spread), tuning) for spread in spreads for p in known for tuning in tunings]
    in_c = _fits_c(build_causal(name, imu, "a prior does not", prior=trials[0][0]), batches)

    errors = []
    with show_progress(f"Prior of {name}") as bar:
        for prior, tuning in trials:
            estimator = build_causal(name, imu, "a prior does not", tuning=tuning, prior=prior)
            errors.append(evaluate_objective(_in_c(estimator, batches[0]) if in_c else estimator, batches, objective))
            bar(len(errors), len(trials))
    return trials[errors.index(min(errors))]
