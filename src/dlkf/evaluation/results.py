"""From scores to the numbers that are printed, written and compared: plain values, ready for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np

from dlkf.evaluation.bootstrap import compare
from dlkf.evaluation.metrics import (
    QUANTITIES,
    Array,
    magnitudes,
    outage_at,
    outage_distance,
    outage_end,
    outage_rms,
    piece_rms,
    slope,
    summary,
)
from dlkf.evaluation.scores import Scores

SETTLE_S = 10.0  # "settled" leaves out this much of every piece, where the initial error dominates
INTO_OUTAGE_S = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
BASELINE = "mbkf15"
COMPARED = ("rms", "mean", "geomean")  # statistics of which ratios to the baseline are given


def results(
    scores: Scores,
    *,
    settle_s: float = SETTLE_S,
    into_outage_s: Sequence[float] = INTO_OUTAGE_S,
    baseline: str = BASELINE,
    resamples: int = 2000,
    seed: int = 0,
) -> dict[str, Any]:
    """Every number of one kind of data: per filter, per filter against the baseline, per piece, per outage.

    Phases of a piece: ``all``; ``settled`` = without the first ``settle_s`` seconds; ``with_gnss`` = settled
    and outside the outages. Values over pieces are of the pieces' RMS. Outages: error at the ``end``, RMS
    over the outage, error ``at`` so many seconds after the last fix, ``drift`` = horizontal error at the end
    per distance driven in the outage. Raises ValueError for scores of several kinds (split them first).
    """
    if len(scores.kinds) > 1:
        raise ValueError(f"results of {' and '.join(scores.kinds)} data must not be mixed: use of_kind")
    w = scores.windows
    phases = _phases(scores, settle_s)
    seconds = np.asarray(into_outage_s, float)
    lengths = w.length * scores.epoch_s
    if len(lengths):
        seconds = seconds[seconds <= lengths.max() + 1e-9]
    distance = outage_distance(scores.truth_v_n, w, scores.epoch_s)
    piece_groups = np.array([p.group for p in scores.pieces])
    outage_groups = piece_groups[w.piece]
    pieces: dict[str, dict[str, dict[str, Array]]] = {}
    ends: dict[str, dict[str, Array]] = {}
    filters: dict[str, Any] = {}
    for name, run in scores.filters.items():
        size = magnitudes(run.error)
        pieces[name] = {q: {k: piece_rms(size[q], m) for k, m in phases.items()} for q in QUANTITIES}
        filters[name] = {
            "pieces": {q: {k: summary(x) for k, x in by.items()} for q, by in pieces[name].items()},
            "imu_error": imu_error_quality(scores, name),
        }
        if not len(w.piece):
            continue
        ends[name] = {q: outage_end(size[q], w) for q in QUANTITIES}
        at = {q: outage_at(size[q], w, seconds, scores.epoch_s) for q in QUANTITIES}
        with np.errstate(divide="ignore", invalid="ignore"):
            ends[name]["drift"] = np.where(distance > 1.0, ends[name]["horizontal"] / distance, np.nan)
        filters[name]["outages"] = {
            "end": {q: summary(x) for q, x in ends[name].items() if q != "drift"},
            "rms": {q: summary(outage_rms(size[q], w)) for q in QUANTITIES},
            "at": {f"{s:g}": {q: summary(at[q][:, i]) for q in QUANTITIES} for i, s in enumerate(seconds)},
            "drift": summary(ends[name]["drift"]),
        }
    units = {("pieces", "all"): ({n: {q: v["all"] for q, v in by.items()} for n, by in pieces.items()}, piece_groups)}
    if ends:
        units["outages", "end"] = (ends, outage_groups)
    options: dict[str, Any] = {"resamples": resamples, "seed": seed}
    comparisons = [
        {"filter": name, "baseline": baseline, "over": over, "part": part, "quantity": q}
        | compare(values[name][q], values[baseline][q], statistic=s, groups=groups, **options).as_dict()
        for name in scores.filters
        if baseline in scores.filters and name != baseline
        for (over, part), (values, groups) in units.items()
        for q, s in product(QUANTITIES, COMPARED)
    ]
    return {
        "kind": scores.kinds[0],
        "count": {
            "pieces": len(scores.pieces),
            "drives": len({p.drive for p in scores.pieces}),
            "groups": len(set(piece_groups)),
            "repeated": len({(p.drive, p.t_start) for p in scores.pieces}) < len(scores.pieces),
            "outages": len(w.piece),
            "outage_drives": len({scores.pieces[i].drive for i in w.piece}),
            "outage_s": [float(lengths.min()), float(lengths.max())] if len(lengths) else None,
            "scored_s": float((~np.isnan(scores.truth_p_n[..., 0])).sum() * scores.epoch_s),
        },
        "settle_s": settle_s,
        "filters": filters,
        "comparisons": comparisons,
        "per_piece": [
            {
                "drive": p.drive,
                "group": p.group,
                "t_start": p.t_start,
                "rms": {n: {q: float(by["all"][i]) for q, by in pieces[n].items()} for n in pieces},
            }
            for i, p in enumerate(scores.pieces)
        ],
        "per_outage": [
            {
                "drive": scores.pieces[i].drive,
                "group": scores.pieces[i].group,
                "t_start": scores.pieces[i].t_start + float(w.first[k]) * scores.epoch_s,
                "length_s": float(lengths[k]),
                "distance_m": float(distance[k]),
                "end": {n: {q: float(x[k]) for q, x in by.items()} for n, by in ends.items()},
            }
            for k, i in enumerate(w.piece)
        ],
    }


def imu_error_quality(scores: Scores, name: str) -> dict[str, list[float]]:
    """Slope over the pieces of the last estimate against the true IMU error, and its RMS error; 6 values.

    NaN where the truth is unknown (a real drive), or the same in every piece (slope).
    """
    truth = last_known(scores.true_imu_error)
    estimate = last_known(scores.filters[name].imu_error)
    return {
        "slope": slope(estimate, truth, intercept=True).tolist(),
        "rms": piece_rms((estimate - truth).T).tolist(),
    }


def last_known(x: Array) -> Array:
    """The last value of each piece and axis that is not NaN: (P, T, n) → (P, n)."""
    known = ~np.isnan(x)
    last = x.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    return np.take_along_axis(x, last[:, None], axis=1)[:, 0]


def _phases(scores: Scores, settle_s: float) -> dict[str, Array]:
    settled = np.broadcast_to(scores.t > settle_s + 1e-9, scores.outage.shape)
    phases = {"all": np.ones_like(scores.outage), "settled": settled}
    if scores.outage.any():
        phases["with_gnss"] = settled & ~scores.outage
    return phases
