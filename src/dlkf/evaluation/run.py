"""Score filters: every one runs over the same batches, with the same masks, through the same loop."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress
from dlkf.base.errors import InputError
from dlkf.data.drive import Batch
from dlkf.data.masks import withhold_fixes
from dlkf.evaluation.metrics import Array, error_series
from dlkf.evaluation.scores import FilterRun, Scores, SegmentSource, join_scores
from dlkf.filters.aids.attach import aid_columns
from dlkf.filters.smoother import Filter
from dlkf.navigation.state import IMU
from dlkf.running.batched import CHUNK_SAMPLES, chunks, run_filter
from dlkf.running.innovations import Innovation

Scene = tuple[Batch, Tensor]


def score_scenes(
    filters: Mapping[str, Filter],
    scenes: Iterable[Scene],
    *,
    total: int | None = None,
    groups: Mapping[str, str] | None = None,
    kinds: Mapping[str, str] | str = "unknown",
    chunk_samples: int = CHUNK_SAMPLES,
    progress: ProgressCallback = no_progress,
) -> Scores:
    """Run every filter over the same scenes: batches, each with the mask (B, T) of its withheld fixes.

    ``groups`` and ``kinds`` map a drive's name to its recording and its kind. ``progress(done, of all)`` counts
    a segment once per filter; ``total`` is the number of segments where it is known. A filter with parameters of
    its own runs on their device. Scenes are consumed one by one, so they may be cut as they are needed.
    Raises InputError if there is nothing to score or the epochs differ in length.
    """
    for estimator in filters.values():
        if isinstance(estimator, torch.nn.Module):
            estimator.eval()
    parts: list[Scores] = []
    done = 0
    for batch, mask in scenes:
        if parts and abs(batch.epoch_s - parts[0].epoch_s) > 1e-9:
            raise InputError("the batches to be scored have different epoch lengths; score them one by one")
        masked = withhold_fixes(batch, mask)
        parts.append(_blank_scores(masked, mask, groups or {}, kinds))
        for name, estimator in filters.items():
            parts[-1].filters[name] = _blank(batch, len(aid_columns(estimator)))
            for index in chunks(batch, chunk_samples):
                _fill(parts[-1].filters[name], index, masked.select(index).trim(), estimator)
                done += len(index)
                progress(done, total and total * len(filters))
    if not filters or not parts:
        raise InputError("nothing to score: give at least one filter and one segment of a drive")
    return join_scores(parts)


def _blank_scores(batch: Batch, mask: Tensor, groups: Mapping[str, str], kinds: Mapping[str, str] | str) -> Scores:
    """The segments of a scene, the fixes that are left of it and its truth, before any filter ran."""
    known = (batch.truth_valid & batch.present).unsqueeze(-1)
    p, v = (torch.where(known, x.double(), torch.nan).cpu().numpy() for x in batch.truth[:2])
    kind_of = (lambda d: kinds) if isinstance(kinds, str) else (lambda d: kinds.get(d, "unknown"))
    return Scores(
        epoch_s=batch.epoch_s,
        segments=[
            SegmentSource(d, groups.get(d, d), kind_of(d), t) for d, t in zip(batch.drive, batch.t_start.tolist())
        ],
        outage=mask.cpu().numpy(),
        fix=(batch.gnss_valid[..., :3].all(-1) & batch.available).cpu().numpy(),
        truth_p_n=p,
        truth_v_n=v,
        true_imu_error=batch.true_imu_error.double().cpu().numpy(),
        origin_e=batch.frame.origin_e.cpu().numpy(),
        injected_bias=np.full((batch.size[0], 6), np.nan),
    )


def _blank(batch: Batch, aids: int) -> FilterRun:
    B, T, _ = batch.size
    sizes = [(B, T, n) for n in (9, 3, 6, 6, 3, 6, aids)]
    return FilterRun(*(np.full(size, np.nan) for size in (*sizes, (B, 6))))


def _fill(run: FilterRun, index: Tensor, batch: Batch, estimator: Filter) -> None:
    solution = run_filter(batch, estimator, keep_innovations=True)
    rows, T = index.numpy(), batch.size[1]
    here = batch.present.cpu().numpy()[..., None]

    def mask(x: Tensor) -> Array:
        return np.where(here, x.double().cpu().numpy(), np.nan)

    run.error[rows, :T] = error_series(batch, solution.posterior)
    run.p_n[rows, :T] = mask(solution.posterior.p_n)
    run.imu_error[rows, :T] = mask(solution.imu_error)
    if solution.std is not None:
        run.imu_std[rows, :T] = mask(solution.std[..., IMU])
        run.position_std[rows, :T] = mask(solution.std[..., :3])
    innovation = Innovation.of(solution.innovation, solution.used, solution.innovation_covariance)
    run.innovation[rows, :T] = np.where(here, innovation.ratio, np.nan)
    if solution.aids is not None:
        run.aids[rows, :T] = mask(solution.aids)
