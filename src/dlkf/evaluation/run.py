"""Score filters: every one runs over the same batches, with the same masks, through the same loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.errors import InputError
from dlkf.evaluation.chunks import CHUNK_SAMPLES, chunks, run_filter, take
from dlkf.evaluation.metrics import Array, error_series
from dlkf.evaluation.outages import with_outage
from dlkf.evaluation.scores import FilterRun, Piece, Scores
from dlkf.filters.integration import Estimator
from dlkf.navigation.state import IMU, NavState


def score(
    filters: Mapping[str, Estimator],
    batches: Sequence[Batch],
    *,
    outages: Sequence[Tensor] | None = None,
    groups: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | str = "unknown",
    state: str = "posterior",
    chunk_samples: int = CHUNK_SAMPLES,
    progress: Callable[[str, int, int], None] | None = None,
) -> Scores:
    """Run every filter over the same batches and keep the errors.

    ``outages`` has one mask (B, T) per batch, whose fixes are withheld from every filter; ``groups`` and
    ``kinds`` map a drive's name to its recording and its kind. ``state`` is the one that is scored, after
    (``posterior``) or before (``prior``) the update. ``progress(filter, pieces done, pieces in all)`` is
    called after each chunk. A filter with parameters of its own runs on their device.
    """
    if not filters or not batches:
        raise InputError("nothing to score: give at least one filter and one piece of a drive")
    epoch_s = batches[0].epoch_s
    if any(abs(b.epoch_s - epoch_s) > 1e-9 for b in batches):
        raise InputError("the batches to be scored have different epoch lengths; score them one by one")
    masks = [torch.zeros(b.size[:2], dtype=torch.bool) for b in batches] if outages is None else outages
    runs: dict[str, list[FilterRun]] = {}
    total = sum(b.size[0] for b in batches)
    for name, estimator in filters.items():
        if isinstance(estimator, torch.nn.Module):
            estimator.eval()
        done, rows = 0, []
        for batch, mask in zip(batches, masks, strict=True):
            blank = _blank(batch)
            for index in chunks(batch, chunk_samples):
                _fill(blank, index, take(with_outage(batch, mask), index), estimator, state)
                done += len(index)
                if progress is not None:
                    progress(name, done, total)
            rows.append(blank)
        runs[name] = rows
    T = max(b.size[1] for b in batches)

    def joined(parts: Sequence[Array]) -> Array:
        return np.concatenate([_padded(x, T) for x in parts])

    def truth(x: Tensor, b: Batch) -> Array:
        known = (b.truth_valid & b.present).unsqueeze(-1)
        return torch.where(known, x.double(), torch.nan).cpu().numpy()

    kind_of = (lambda d: kinds) if isinstance(kinds, str) else (lambda d: kinds.get(d, "unknown"))
    return Scores(
        epoch_s=epoch_s,
        pieces=[
            Piece(d, (groups or {}).get(d, d), kind_of(d), float(t))
            for b in batches
            for d, t in zip(b.drive, b.t_start)
        ],
        outage=joined([m.cpu().numpy().astype(float) for m in masks]) == 1,
        truth_p_n=joined([truth(b.truth.p_n, b) for b in batches]),
        truth_v_n=joined([truth(b.truth.v_n, b) for b in batches]),
        true_imu_error=joined([b.true_imu_error.double().cpu().numpy() for b in batches]),
        filters={
            name: FilterRun(**{f.name: joined([getattr(r, f.name) for r in rows]) for f in fields(FilterRun)})
            for name, rows in runs.items()
        },
    )


def _blank(batch: Batch) -> FilterRun:
    B, T, _ = batch.size
    return FilterRun(*(np.full((B, T, n), np.nan) for n in (9, 3, 6, 6)))


def _fill(run: FilterRun, index: Tensor, batch: Batch, estimator: Estimator, state: str) -> None:
    solution = run_filter(batch, estimator)
    scored: NavState = getattr(solution, state)
    rows, T = index.numpy(), batch.size[1]
    here = batch.present.cpu().numpy()[..., None]

    def kept(x: Tensor) -> Array:
        return np.where(here, x.double().cpu().numpy(), np.nan)

    run.error[rows, :T] = error_series(batch, scored)
    run.p_n[rows, :T] = kept(scored.p_n)
    run.imu_error[rows, :T] = kept(solution.imu_error)
    if solution.std is not None:
        run.imu_std[rows, :T] = kept(solution.std[..., IMU])


def _padded(x: Array, T: int) -> Array:
    extra = [(0, 0)] * x.ndim
    extra[1] = (0, T - x.shape[1])
    return np.pad(x, extra, constant_values=np.nan)
