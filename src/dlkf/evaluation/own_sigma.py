"""What a filter says of itself against what happened: its own 1σ against errors and innovations."""

from __future__ import annotations

import numpy as np

from dlkf.evaluation.metrics import Array, outage_end
from dlkf.evaluation.scores import FilterRun, Scores
from dlkf.running.innovations import SigmaFit, fit_sigma, rms


def horizontal_sigma(run: FilterRun) -> Array:
    """√(σ_n² + σ_e²) (P, T) [m], NaN where the filter has none."""
    return np.hypot(run.position_std[..., 0], run.position_std[..., 1])


def sigma_samples(scores: Scores, name: str) -> dict[tuple[str, str, str], Array]:
    """The filter's own horizontal 1σ at the end of every outage [m]."""
    w = scores.windows
    if not len(w.segment):
        return {}
    return {("outages", "end", "sigma"): outage_end(horizontal_sigma(scores.filters[name]), w)}


def innovation_rms(run: FilterRun) -> float:
    """RMS of all innovations over their 1σ; NaN of a filter without covariance."""
    return rms(run.innovation)


def innovation_fit(run: FilterRun) -> SigmaFit | None:
    """Whether the filter's 1σ fits its innovations; segments count as independent."""
    return fit_sigma(*run.innovation)
