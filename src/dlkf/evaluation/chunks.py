"""An evaluation in chunks of drives, each loaded, scored and released, here or in other processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dlkf.base.console import ProgressCallback, no_progress, show_progress
from dlkf.base.errors import InputError, no_drives
from dlkf.base.parallel import parallel_map
from dlkf.data.alignment import ALIGN, AlignConfig
from dlkf.data.drive import Drive
from dlkf.data.masks import BiasLaw
from dlkf.data.store import load_dataset
from dlkf.evaluation.metrics import outage_intervals
from dlkf.evaluation.protocol import REFUSED, NoSegment, Protocol, Scenes, describe_short
from dlkf.evaluation.scores import Scores, join_scores
from dlkf.evaluation.study import run_scenes
from dlkf.filters.model_based import Mbkf
from dlkf.filters.smoother import Filter
from dlkf.running.references import describe_reference, make_reference

SHORT = "too short"  # of the rules: drives of which no segment could be cut


@dataclass(frozen=True)
class EvaluationJob:
    """What is done to a chunk: the filters, the rules, and whose truth the errors are against."""

    dataset: str
    filters: Mapping[str, Filter]
    protocol: Protocol
    grid: Mapping[str, Any]
    kinds: Mapping[str, str]
    groups: Mapping[str, str]
    reference: str = "file"
    smoother: Filter | None = None
    align: AlignConfig = ALIGN
    law: BiasLaw | None = None
    seed: int = 0
    shown: bool = True  # bars on stderr


class ChunkResult(NamedTuple):
    """What became of a chunk: its scores and the rules of its scenes, or why nothing of it can be scored."""

    names: tuple[str, ...]
    scores: Scores | None = None
    rules: Mapping[str, Any] = {}
    skipped: Mapping[str, str] = {}
    sigma: Tensor | None = None  # (n, 3) of a made reference [m]
    short: Sequence[str] = ()  # drives of which no segment could be cut
    refused: InputError | None = None


class Evaluated(NamedTuple):
    """All chunks together, the rules with ``skipped`` and, of drives without a segment, ``too short``; ``truth``
    describes a made reference."""

    scores: Scores
    rules: dict[str, Any]
    truth: dict[str, str]


def evaluate_chunks(
    work: EvaluationJob, chunks: Sequence[tuple[str, ...]], parallel: int | str | None = None
) -> Evaluated:
    """Every filter over every chunk. InputError where none has anything to score.

    What is drawn for a segment depends on it alone (:mod:`dlkf.data.draws`), so it is the same however the drives are
    divided. Where one chunk has segments, ``mode=auto`` means segments for all.
    """
    done = list(parallel_map(partial(score_chunk, work), chunks, parallel))
    skipped = {drive: why for one in done for drive, why in one.skipped.items()}
    scorable = [one for one in done if one.scores is not None]
    if not scorable:
        raise done[0].refused or no_drives()
    mode = "segments" if any(one.rules["mode"] == "segments" for one in scorable) else "drives"
    kept = [one for one in scorable if one.rules["mode"] == mode]
    scores = join_scores([one.scores for one in kept if one.scores is not None])
    of_other_mode = [one for one in scorable if one.rules["mode"] != mode]  # no segment, where others have some
    lost = {name for one in done for name in one.short} | {name for one in of_other_mode for name in one.names}
    names = [name for one in done for name in one.names]
    unused = [name for name in names if name in lost - set(skipped)]
    rules = {**kept[0].rules, "runs": sum(one.rules["runs"] for one in kept), "skipped": skipped}
    rules |= {SHORT: describe_short(unused, len(names), work.protocol)} if unused else {}
    refused = {drive: said for one in kept for drive, said in one.rules.get(REFUSED, {}).items()}
    rules |= {REFUSED: refused} if refused else {}
    sigmas = [one.sigma for one in kept if one.sigma is not None]
    truth = {"reference": describe_reference(work.reference, torch.cat(sigmas))} if sigmas else {}
    return Evaluated(scores, rules, truth)


def suggest_more_outages(
    work: EvaluationJob, chunks: Sequence[tuple[str, ...]], count: int, parallel: int | str | None = None
) -> str:
    """A line for few outages, ``count`` of them in segments: how many the same drives have with ``mode=drives``."""
    whole = replace(work, protocol=replace(work.protocol, mode="drives"))
    drives = sum(parallel_map(partial(count_outages, whole), chunks, parallel))
    if drives > count:
        return f"Few outages ({count}); mode=drives scores whole drives and has {drives}."
    smaller = "a smaller outage.duration_s or outage.first_s gives more"
    return f"Few outages: {count}, and {drives} with mode=drives; {smaller}."


def count_outages(work: EvaluationJob, names: tuple[str, ...]) -> int:
    """How many outages a chunk has; no filter runs over them."""
    try:
        scenes = Scenes(_with_reference(work, _load(work, names))[0], work.protocol)
    except InputError:
        return 0
    return sum(len(outage_intervals(mask.numpy()).segment) for _, mask in scenes)


def _load(work: EvaluationJob, names: tuple[str, ...]) -> list[Drive]:
    wanted = {"dtype": torch.float64, "reference": work.reference == "file", "drives": names}
    with _bar(work, "Loading drives") as progress:
        return load_dataset(work.dataset, progress=progress, **wanted, **work.grid)


def _with_reference(work: EvaluationJob, drives: list[Drive]) -> tuple[list[Drive], Tensor | None, Mapping[str, str]]:
    """The drives, of a reference that is made its 1σ, and the drives that have none."""
    if work.reference == "file":
        return drives, None, {}
    assert isinstance(work.smoother, Mbkf)
    with _bar(work, "Making the reference") as progress:
        return make_reference(drives, work.reference, work.smoother, work.align, progress)


def score_chunk(work: EvaluationJob, names: tuple[str, ...]) -> ChunkResult:
    """One chunk."""
    drives = _load(work, names)
    try:
        drives, sigma, left_out = _with_reference(work, drives)
        scenes = Scenes(drives, work.protocol)
    except NoSegment as error:
        return ChunkResult(names, short=names, refused=error)
    except InputError as error:
        return ChunkResult(names, skipped={names[0]: str(error)}, refused=error)
    bar: Callable[[str], Any] = partial(_bar, work)
    scores = run_scenes(
        work.filters, scenes, kinds=work.kinds, groups=work.groups, law=work.law, seed=work.seed, counting=bar
    )
    return ChunkResult(names, scores, scenes.describe(), {**left_out, **scenes.skipped}, sigma, scenes.short)


def _bar(work: EvaluationJob, title: str) -> AbstractContextManager[ProgressCallback]:
    return show_progress(title) if work.shown else nullcontext(no_progress)
