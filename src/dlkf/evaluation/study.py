"""One comparison from scenes to numbers: what both ``evaluate`` and the end of a training run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager

import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress, show_progress
from dlkf.base.errors import InputError, did_you_mean
from dlkf.data.draws import segment_generator
from dlkf.data.masks import BiasLaw, add_bias
from dlkf.evaluation.protocol import Scenes
from dlkf.evaluation.results import BASELINE, SETTLE_S, Results, last_finite, summarise_scores
from dlkf.evaluation.run import Scene, score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.build import filter_names, is_filter
from dlkf.filters.smoother import Filter


def run_scenes(
    filters: Mapping[str, Filter],
    scenes: Scenes,
    *,
    kinds: Mapping[str, str] | str,
    groups: Mapping[str, str] | None = None,
    law: BiasLaw | None = None,
    seed: int = 0,
    counting: Callable[[str], AbstractContextManager[ProgressCallback]] = show_progress,
) -> Scores:
    """Every filter over the scenes, with ``law`` once more with biases added to the IMU; ``counting`` shows how far."""
    with counting("Running filters") as progress:
        scores = score_scenes(filters, scenes, total=scenes.runs, kinds=kinds, groups=groups, progress=progress)
    if law is not None:
        with counting("Running with injected biases") as progress:
            inject_bias(scores, filters, scenes, law=law, total=scenes.runs, progress=progress, seed=seed)
    return scores


def inject_bias(
    scores: Scores, filters: Mapping[str, Filter], scenes: Iterable[Scene], *, law: BiasLaw, seed: int,
    total: int | None = None, progress: ProgressCallback = no_progress,
) -> None:  # fmt: skip
    """A bias injected into every segment, and how far each filter's last estimate followed it, into the ``scores`` of
    the same filters and scenes without it.

    The bias is drawn from N(0, σ²), the σ of ``law``, for each segment by itself, again where the same segment comes
    again with another outage. Works on real drives, whose IMU error is unknown.
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

    shifted = score_scenes(filters, shift_scenes(), total=total, progress=progress)
    scores.injected_bias = torch.cat(drawn).numpy()
    for name, run in scores.filters.items():
        run.bias_response = last_finite(shifted.filters[name].imu_error) - last_finite(run.imu_error)


def choose_baseline(baseline: str | None, models: Collection[str]) -> str:
    """The filter that the others are compared with: the one that was named, else ``mbkf15`` or, without it, the first.

    InputError for a name that is neither among the models nor a filter's.
    """
    if baseline is None:
        return BASELINE if BASELINE in models else next(iter(models))
    if baseline not in models and not is_filter(baseline):
        near = did_you_mean(baseline, (*models, *filter_names())) or "; see model="
        raise InputError(f"baseline={baseline} is none of the models {', '.join(models)}{near}")
    return baseline


def make_results(
    scores: Scores, *, baseline: str = BASELINE, settle_s: float = SETTLE_S, seed: int = 0
) -> list[Results]:
    """The results of each kind of data."""
    return [
        summarise_scores(scores.of_kind(kind), settle_s=settle_s, baseline=baseline, seed=seed) for kind in scores.kinds
    ]
