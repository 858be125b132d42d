"""Run a filter over a large batch a few pieces at a time, without gradients."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace

import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.filters.integration import Estimator, Solution, integrate
from dlkf.filters.smoother import Smoothed, smooth
from dlkf.navigation.earth import TangentFrame
from dlkf.navigation.state import NavState

CHUNK_SAMPLES = 1_500_000  # IMU samples integrated at a time: bounds the memory


def take(batch: Batch, index: Tensor) -> Batch:
    """Some pieces of a batch, without the padding that none of them needs; ``index`` (b,) int64."""
    T = max(1, int(batch.present[index].sum(-1).max()))
    epochwise = {"imu", "gnss", "gnss_std", "gnss_valid", "gnss_lag", "available", "truth", "truth_valid"}
    epochwise |= {"attitude_valid", "true_imu_error", "present"}
    part = {}
    for f in fields(batch):
        value = getattr(batch, f.name)
        if isinstance(value, NavState):
            value = NavState(*(x[index] for x in value))
            part[f.name] = NavState(*(x[:, :T] for x in value)) if f.name in epochwise else value
        elif isinstance(value, (Tensor, TangentFrame)):
            part[f.name] = value[index][:, :T] if f.name in epochwise else value[index]
        elif isinstance(value, tuple):
            part[f.name] = tuple(value[i] for i in index.tolist())
    return replace(batch, **part)


def chunks(batch: Batch, samples: int = CHUNK_SAMPLES) -> Iterator[Tensor]:
    """Indices of pieces of like length, as many at a time as ``samples`` IMU samples allow (at least one)."""
    length = batch.present.sum(-1).cpu()
    order = torch.argsort(length, descending=True, stable=True)
    start = 0
    while start < len(order):
        size = max(1, samples // (int(length[order[start]]) * batch.size[2] or 1))
        yield order[start : start + size]
        start += size


def run_filter(batch: Batch, estimator: Estimator | Smoothed, *, keep_covariances: bool = False) -> Solution:
    """The filter loop, smoothed where asked for, without gradients, on the device of the estimator's parameters.

    ``keep_covariances`` where the filter has some and is not smoothed.
    """
    parameter = next(estimator.parameters(), None) if isinstance(estimator, torch.nn.Module) else None
    if parameter is not None:
        batch = batch.to(parameter.device)
    with torch.inference_mode():
        if isinstance(estimator, Smoothed):
            return smooth(batch, estimator.filter)
        return integrate(batch, estimator, keep_covariances=keep_covariances)
