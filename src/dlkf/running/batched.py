"""Run a filter over a large batch a few segments at a time, without gradients."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import BatchSolution, integrate
from dlkf.filters.smoother import Filter, SmoothedSolution, smooth

CHUNK_SAMPLES = 1_500_000  # IMU samples integrated at a time: bounds the memory


def pack(sizes: Sequence[int], most: int) -> list[list[int]]:
    """Indices in order, as many together as hold ``most`` when padded to the largest of them (at least one)."""
    parts: list[list[int]] = []
    largest = 0
    for k, size in enumerate(sizes):
        largest = max(largest, size)
        if not parts or (len(parts[-1]) + 1) * largest > most:
            parts.append([])
            largest = size
        parts[-1].append(k)
    return parts


def chunks(batch: Batch, samples: int = CHUNK_SAMPLES) -> Iterator[Tensor]:
    """Indices of segments of like length, as many at a time as ``samples`` IMU samples allow (at least one)."""
    length = batch.present.sum(-1).cpu()
    order = torch.argsort(length, descending=True, stable=True)
    yield from (order[part] for part in pack((length[order] * batch.size[2]).tolist(), samples))


def run_filter(
    batch: Batch, estimator: Filter, *, keep_covariances: bool = False, keep_innovations: bool = False
) -> BatchSolution:
    """The filter loop, smoothed where asked for, without gradients, on the device of the estimator's parameters.

    ``keep_covariances``, or with ``keep_innovations`` those of innovation and horizontal position alone, where the
    filter has some and is not smoothed.
    """
    parameter = next(estimator.parameters(), None) if isinstance(estimator, torch.nn.Module) else None
    if parameter is not None:
        batch = batch.to(parameter.device)
    with torch.inference_mode():
        if isinstance(estimator, SmoothedSolution):
            return smooth(batch, estimator.filter)
        return integrate(batch, estimator, keep_covariances=keep_covariances, keep_innovations=keep_innovations)
