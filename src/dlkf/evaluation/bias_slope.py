"""Does a filter estimate the IMU error, or has it memorised one? (paper.md 4.7)"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import torch
from torch import Tensor

from dlkf.console import Counted
from dlkf.data.draws import piece_generator
from dlkf.data.masks import BiasLaw, with_bias
from dlkf.evaluation.metrics import Array
from dlkf.evaluation.results import last_known
from dlkf.evaluation.run import Scene, score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.smoother import Filter


def injected_response(
    base: Scores,
    filters: Mapping[str, Filter],
    scenes: Iterable[Scene],
    *,
    law: BiasLaw,
    seed: int,
    total: int | None = None,
    progress: Counted | None = None,
) -> tuple[Array, dict[str, Array]]:
    """A bias injected into every piece (P, 6), and how far each filter's last estimate followed it (P, 6).

    The bias is drawn from N(0, σ²), the σ of ``law``, for each piece by itself, anew where the same
    piece comes again with another outage; ``base`` are the scores of
    the same filters and scenes without it. Works on real drives, whose IMU error nobody knows. The slope of
    the second against the first (metrics.slope) is 1 for an estimator, 0 for a memoriser.
    """
    drawn: list[Tensor] = []
    seen: Counter[tuple[str, float]] = Counter()

    def bias(piece: tuple[str, float]) -> Tensor:
        generator = piece_generator(seed, f"bias {seen[piece]}", *piece)
        return law.std * torch.randn(6, generator=generator, dtype=torch.float64)

    def shifted() -> Iterator[Scene]:
        for batch, mask in scenes:
            pieces = list(zip(batch.drive, batch.t_start.tolist()))
            drawn.append(torch.stack([bias(piece) for piece in pieces]))
            seen.update(pieces)
            yield with_bias(batch, drawn[-1]), mask

    scores = score_scenes(filters, shifted(), total=total, progress=progress)
    followed: dict[str, Array] = {
        name: last_known(run.imu_error) - last_known(base.filters[name].imu_error)
        for name, run in scores.filters.items()
    }
    return torch.cat(drawn).numpy(), followed
