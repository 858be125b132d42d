"""One comparison from scenes to numbers: what both ``evaluate`` and the end of a training run."""

from __future__ import annotations

from collections.abc import Mapping

from dlkf.console import counting
from dlkf.data.masks import BiasLaw
from dlkf.evaluation.bias_slope import injected_response
from dlkf.evaluation.metrics import slope
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.results import BASELINE, SETTLE_S, Results, imu_error_values, summarise_scores
from dlkf.evaluation.run import score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.smoother import Filter
from dlkf.settings import settings_from


def study(
    filters: Mapping[str, Filter],
    scenes: Scenes,
    *,
    kinds: Mapping[str, str] | str,
    groups: Mapping[str, str] | None = None,
    baseline: str = BASELINE,
    settle_s: float = SETTLE_S,
    injected_bias: BiasLaw | Mapping[str, float] | None = None,
    seed: int = 0,
) -> tuple[Scores, list[Results]]:
    """Scores of every filter, and the results of each kind of data.

    With ``injected_bias`` everything runs once more with biases added to
    the IMU, and the results carry the ``injected_slope`` of its IMU-error estimate per filter.
    """
    with counting("Running filters") as progress:
        scores = score_scenes(
            filters, scenes, total=scenes.runs, kinds=kinds, groups=groups, progress=progress
        )
    made = [
        summarise_scores(scores.of_kind(kind), settle_s=settle_s, baseline=baseline, seed=seed)
        for kind in scores.kinds
    ]
    if injected_bias:
        law = settings_from(BiasLaw, injected_bias, "injected_bias")
        with counting("Running with injected biases") as progress:
            cause, followed = injected_response(
                scores, filters, scenes, law=law, total=scenes.runs, progress=progress, seed=seed
            )
        for k, result in enumerate(made):
            rows = [i for i, p in enumerate(scores.pieces) if p.kind == result.kind]
            slopes = {n: slope(x[rows], cause[rows], intercept=False) for n, x in followed.items()}
            values = (imu_error_values(result.kind, n, "injected_slope", six) for n, six in slopes.items())
            made[k] = result.with_values([v for six in values for v in six])
    return scores, made
