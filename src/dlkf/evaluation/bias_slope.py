"""Does a filter estimate the IMU error, or has it memorised one? (paper.md 4.7)"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from dlkf.data.draws import piece_generator
from dlkf.data.drive import Batch
from dlkf.evaluation.metrics import Array
from dlkf.evaluation.results import last_known
from dlkf.evaluation.run import Scene, score_scenes
from dlkf.evaluation.scores import Scores
from dlkf.filters.integration import Estimator


def injected(batch: Batch, bias: Tensor) -> Batch:
    """The batch with a constant added to its raw IMU (B, 6) and to its true IMU error."""
    return replace(
        batch,
        imu=batch.imu + bias.to(batch.imu)[:, None, None],
        true_imu_error=batch.true_imu_error + bias.to(batch.true_imu_error)[:, None],
    )


def injected_response(
    base: Scores,
    filters: Mapping[str, Estimator],
    scenes: Iterable[Scene],
    *,
    accel: float,
    gyro: float,
    seed: int = 0,
    total: int | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> tuple[Array, dict[str, Array]]:
    """A bias injected into every piece (P, 6), and how far each filter's last estimate followed it (P, 6).

    The bias is drawn from N(0, accel²) [m/s²] and N(0, gyro²) [rad/s] for each piece by itself, anew where the same
    piece comes again with another outage; ``base`` are the scores of
    the same filters and scenes without it. Works on real drives, whose IMU error nobody knows. The slope of
    the second against the first (metrics.slope) is 1 for an estimator, 0 for a memoriser.
    """
    sigma = torch.tensor([accel] * 3 + [gyro] * 3, dtype=torch.float64)
    drawn: list[Tensor] = []
    seen: Counter[tuple[str, float]] = Counter()

    def bias(piece: tuple[str, float]) -> Tensor:
        generator = piece_generator(seed, f"bias {seen[piece]}", *piece)
        return sigma * torch.randn(6, generator=generator, dtype=torch.float64)

    def shifted() -> Iterator[Scene]:
        for batch, mask in scenes:
            pieces = list(zip(batch.drive, batch.t_start.tolist()))
            drawn.append(torch.stack([bias(piece) for piece in pieces]))
            seen.update(pieces)
            yield injected(batch, drawn[-1]), mask

    scores = score_scenes(filters, shifted(), total=total, progress=progress)
    followed = {
        name: last_known(run.imu_error) - last_known(base.filters[name].imu_error)
        for name, run in scores.filters.items()
    }
    return torch.cat(drawn).numpy(), followed
