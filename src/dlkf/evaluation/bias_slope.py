"""Does a filter estimate the IMU error, or has it memorised one? (paper.md 4.7)"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback
from dlkf.data.draws import segment_generator
from dlkf.data.masks import BiasLaw, add_bias
from dlkf.evaluation.metrics import Array
from dlkf.evaluation.results import last_finite
from dlkf.evaluation.run import Scene, score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.smoother import Filter


def inject_bias(
    base: Scores,
    filters: Mapping[str, Filter],
    scenes: Iterable[Scene],
    *,
    law: BiasLaw,
    seed: int,
    total: int | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[Array, dict[str, Array]]:
    """A bias injected into every segment (P, 6), and how far each filter's last estimate followed it (P, 6).

    The bias is drawn from N(0, σ²), the σ of ``law``, for each segment by itself, again where the same
    segment comes again with another outage; ``base`` are the scores of
    the same filters and scenes without it. Works on real drives, whose IMU error is unknown. The slope of
    the second against the first (metrics.slope) is 1 for an estimator, 0 for a memoriser.
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
    followed: dict[str, Array] = {
        name: last_finite(run.imu_error) - last_finite(base.filters[name].imu_error)
        for name, run in scores.filters.items()
    }
    return torch.cat(drawn).numpy(), followed
