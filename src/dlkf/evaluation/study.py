"""One comparison from scenes to numbers: what both ``evaluate`` and the end of a training run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import NamedTuple

import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, show_progress
from dlkf.data.draws import segment_generator
from dlkf.data.masks import BiasLaw, add_bias
from dlkf.evaluation.metrics import Array, slope
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.results import BASELINE, SETTLE_S, Results, imu_error_values, last_finite, summarise_scores
from dlkf.evaluation.run import Scene, score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.smoother import Filter


class ScoredRun(NamedTuple):
    """Scores of every filter; with injected biases these (P, 6) and how far each filter's estimate followed them."""

    scores: Scores
    cause: Array | None = None
    followed: Mapping[str, Array] | None = None


def run_scenes(
    filters: Mapping[str, Filter],
    scenes: Scenes,
    *,
    kinds: Mapping[str, str] | str,
    groups: Mapping[str, str] | None = None,
    law: BiasLaw | None = None,
    seed: int = 0,
    counting: Callable[[str], AbstractContextManager[ProgressCallback | None]] = show_progress,
) -> ScoredRun:
    """Every filter over the scenes, with ``law`` once more with biases added to the IMU; ``counting`` shows how far."""
    with counting("Running filters") as progress:
        scores = score_scenes(filters, scenes, total=scenes.runs, kinds=kinds, groups=groups, progress=progress)
    if law is None:
        return ScoredRun(scores)
    with counting("Running with injected biases") as progress:
        response = inject_bias(scores, filters, scenes, law=law, total=scenes.runs, progress=progress, seed=seed)
    return ScoredRun(scores, *response)


def inject_bias(
    base: Scores, filters: Mapping[str, Filter], scenes: Iterable[Scene], *, law: BiasLaw, seed: int,
    total: int | None = None, progress: ProgressCallback | None = None,
) -> tuple[Array, dict[str, Array]]:  # fmt: skip
    """A bias injected into every segment (P, 6), and how far each filter's last estimate followed it (P, 6).

    The bias is drawn from N(0, σ²), the σ of ``law``, for each segment by itself, again where the same segment comes
    again with another outage; ``base`` are the scores of the same filters and scenes without it. Works on real drives,
    whose IMU error is unknown. The slope of the second against the first (metrics.slope; paper.md 4.7) is 1 for an
    estimator, 0 for a memoriser.
    """
    drawn: list[Tensor] = []
    seen: Counter[tuple[str, float]] = Counter()

    def bias(segment: tuple[str, float]) -> Tensor:
        generator = segment_generator(seed, f"bias {seen[segment]}", *segment)
        return law.std * torch.randn(6, generator=generator, dtype=torch.float64)

    def shift_scenes() -> Iterator[Scene]:
        for batch, mask in scenes:
            segments = list(zip(batch.drive, batch.t_start.tolist()))
            drawn.append(torch.stack([bias(segment) for segment in segments]))
            seen.update(segments)
            yield add_bias(batch, drawn[-1]), mask

    scores = score_scenes(filters, shift_scenes(), total=total, progress=progress)
    return torch.cat(drawn).numpy(), {
        name: last_finite(run.imu_error) - last_finite(base.filters[name].imu_error)
        for name, run in scores.filters.items()
    }


def make_results(
    run: ScoredRun, *, baseline: str = BASELINE, settle_s: float = SETTLE_S, seed: int = 0
) -> list[Results]:
    """The results of each kind of data, with the ``injected_slope`` of each filter's IMU-error estimate where biases
    were added."""
    scores = run.scores
    made = [
        summarise_scores(scores.of_kind(kind), settle_s=settle_s, baseline=baseline, seed=seed) for kind in scores.kinds
    ]
    if run.cause is None:
        return made
    for k, result in enumerate(made):
        rows = [i for i, p in enumerate(scores.segments) if p.kind == result.kind]
        slopes = {n: slope(x[rows], run.cause[rows], intercept=False) for n, x in (run.followed or {}).items()}
        values = (imu_error_values(result.kind, n, "injected_slope", six) for n, six in slopes.items())
        made[k] = result.with_values([v for six in values for v in six])
    return made
