"""Score filters: every one runs over the same batches, with the same masks, through the same loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dlkf.console import Counted
from dlkf.data.drive import Batch
from dlkf.data.masks import withhold
from dlkf.errors import InputError
from dlkf.evaluation.metrics import Array, error_series
from dlkf.evaluation.scores import FilterRun, Piece, Scores
from dlkf.filters.smoother import Filter
from dlkf.navigation.state import IMU, NavState
from dlkf.running.batched import CHUNK_SAMPLES, chunks, run_filter

Scene = tuple[Batch, Tensor]


def score(
    filters: Mapping[str, Filter],
    batches: Sequence[Batch],
    *,
    outages: Sequence[Tensor] | None = None,
    **options: Any,
) -> Scores:
    """Run every filter over the same batches and keep the errors.

    ``outages`` has one mask (B, T) per batch, whose fixes are withheld from every filter. Options as in
    :func:`score_scenes`.
    """
    masks = [torch.zeros(b.size[:2], dtype=torch.bool) for b in batches] if outages is None else outages
    total = sum(b.size[0] for b in batches)
    return score_scenes(filters, zip(batches, masks, strict=True), total=total, **options)


def score_scenes(
    filters: Mapping[str, Filter],
    scenes: Iterable[Scene],
    *,
    total: int | None = None,
    groups: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | str = "unknown",
    state: str = "posterior",
    chunk_samples: int = CHUNK_SAMPLES,
    progress: Counted | None = None,
) -> Scores:
    """Run every filter over the same scenes: batches, each with the mask (B, T) of its withheld fixes.

    ``groups`` and ``kinds`` map a drive's name to its recording and its kind. ``state`` is the one that is
    scored, after (``posterior``) or before (``prior``) the update. ``progress(done, of all)`` counts
    a piece once per filter; ``total`` is the number of pieces where it is known. A filter with parameters of
    its own runs on their device. Scenes are consumed one by one, so they may be cut as they are needed.
    Raises InputError if there is nothing to score or the epochs differ in length.
    """
    for estimator in filters.values():
        if isinstance(estimator, torch.nn.Module):
            estimator.eval()
    runs: dict[str, list[FilterRun]] = {name: [] for name in filters}
    truths: list[_Truth] = []
    done = 0
    for batch, mask in scenes:
        truths.append(_Truth.of(batch, mask))
        if abs(batch.epoch_s - truths[0].epoch_s) > 1e-9:
            raise InputError("the batches to be scored have different epoch lengths; score them one by one")
        masked = withhold(batch, mask)
        for name, estimator in filters.items():
            runs[name].append(_blank(batch))
            for index in chunks(batch, chunk_samples):
                _fill(runs[name][-1], index, masked.select(index).trimmed(), estimator, state)
                done += len(index)
                if progress is not None:
                    progress(done, total and total * len(filters))
    if not filters or not truths:
        raise InputError("nothing to score: give at least one filter and one piece of a drive")
    T = max(x.outage.shape[1] for x in truths)

    def joined(rows: Sequence[object], name: str) -> Array:
        return np.concatenate([_padded(getattr(r, name), T) for r in rows])

    kind_of = (lambda d: kinds) if isinstance(kinds, str) else (lambda d: kinds.get(d, "unknown"))
    origin = [(d, t) for x in truths for d, t in zip(x.drive, x.t_start)]
    return Scores(
        epoch_s=truths[0].epoch_s,
        pieces=[Piece(d, (groups or {}).get(d, d), kind_of(d), t) for d, t in origin],
        outage=joined(truths, "outage") == 1,
        truth_p_n=joined(truths, "p_n"),
        truth_v_n=joined(truths, "v_n"),
        true_imu_error=joined(truths, "imu_error"),
        origin_e=np.concatenate([x.origin_e for x in truths]),
        filters={
            name: FilterRun(**{f.name: joined(rows, f.name) for f in fields(FilterRun)})
            for name, rows in runs.items()
        },
    )


class _Truth(NamedTuple):
    """What stays of a scene after its filters ran."""

    epoch_s: float
    drive: tuple[str, ...]
    t_start: list[float]
    outage: Array
    p_n: Array
    v_n: Array
    imu_error: Array
    origin_e: Array

    @staticmethod
    def of(batch: Batch, mask: Tensor) -> _Truth:
        known = (batch.truth_valid & batch.present).unsqueeze(-1)
        p, v = (torch.where(known, x.double(), torch.nan).cpu().numpy() for x in batch.truth[:2])
        error = batch.true_imu_error.double().cpu().numpy()
        outage = mask.cpu().numpy().astype(float)
        origin = batch.frame.origin_e.cpu().numpy()
        return _Truth(batch.epoch_s, batch.drive, batch.t_start.tolist(), outage, p, v, error, origin)


def _blank(batch: Batch) -> FilterRun:
    B, T, _ = batch.size
    return FilterRun(*(np.full((B, T, n), np.nan) for n in (9, 3, 6, 6)))


def _fill(run: FilterRun, index: Tensor, batch: Batch, estimator: Filter, state: str) -> None:
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
