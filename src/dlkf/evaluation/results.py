"""From scores to the numbers that are printed, written and compared: one tidy frame.

Every number is a row (:class:`Value`): of which filter, on which kind of data, over segments or outages, which part of
them, which quantity and statistic. Tables, CSV, ``metrics.json``, MLflow's keys and sentences are selections from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlkf.evaluation.bootstrap import Comparison, compare
from dlkf.evaluation.metrics import (
    QUANTITIES,
    Array,
    Mask,
    magnitudes,
    outage_at,
    outage_distance,
    outage_end,
    outage_rms,
    segment_rms,
    slope,
    summarise_errors,
)
from dlkf.evaluation.scores import Scores
from dlkf.running.innovations import rms

SETTLE_S = 10.0  # "settled" leaves out this much of every segment, where the initial error dominates
INTO_OUTAGE_S = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
LEAST_M = 1.0  # an outage in which a car drives less has no error per distance
BASELINE = "mbkf15"
COMPARED = ("rms", "mean", "geomean")  # statistics of which ratios to the baseline are given
IMU_AXES = {f"{sensor}_{axis}": unit for sensor, unit in (("accel", "m/s²"), ("gyro", "rad/s")) for axis in "xyz"}
UNITS = {**QUANTITIES, "drift": "1", "sigma": "m", "innovation": "1", **IMU_AXES}
COUNTS = ("n", "nonfinite", "slope", "injected_slope")  # statistics without a unit
TEXT = ("kind", "filter", "baseline", "over", "part", "quantity", "statistic")  # columns that are no numbers


class Value(NamedTuple):
    """One number. ``over``: segments or outages.

    ``part`` of segments: ``all``; ``settled`` = without the first ``settle_s`` seconds; ``with_gnss`` = settled and
    outside the outages (each the RMS over that part); ``last`` = the last estimate, of the IMU error. Of outages:
    the error at their ``end``, the ``rms`` over them, or the error ``at 10 s`` after the last fix.
    ``quantity``: those of :data:`dlkf.evaluation.metrics.QUANTITIES`, ``drift`` = horizontal error at the end per
    distance driven in the outage, ``sigma`` = the filter's own horizontal 1σ at the end, ``innovation`` = innovations
    over their 1σ, ``accel_x`` … ``gyro_z`` = the IMU-error estimate.
    """

    kind: str
    filter: str
    over: str
    part: str
    quantity: str
    statistic: str
    value: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class PairedRatio(Comparison):
    """A filter against the baseline in one quantity; ``over`` and ``part`` as in :class:`Value`."""

    kind: str
    filter: str
    baseline: str
    over: str
    part: str
    quantity: str


@dataclass(frozen=True)
class Results:
    """The results of one kind of data: values, comparisons with the baseline, and how much they rest on.

    ``per_segment`` and ``per_outage`` have one row each per segment and outage, with the error of every filter.
    """

    kind: str
    count: Mapping[str, Any]
    settle_s: float
    values: tuple[Value, ...]
    comparisons: tuple[PairedRatio, ...]
    per_segment: tuple[Mapping[str, Any], ...] = ()
    per_outage: tuple[Mapping[str, Any], ...] = ()

    @cached_property
    def _at(self) -> dict[tuple[str, ...], float]:
        return {v[1:6]: v.value for v in self.values}

    @cached_property
    def filters(self) -> list[str]:
        """Names in the order in which they were scored."""
        return list(dict.fromkeys(v.filter for v in self.values))

    @property
    def baseline(self) -> str | None:
        """What the others are compared with."""
        return next((c.baseline for c in self.comparisons), None)

    def value(self, filter: str, over: str, part: str, quantity: str, statistic: str = "rms") -> float:
        """One number, NaN where there is none."""
        return self._at.get((filter, over, part, quantity, statistic), float("nan"))

    def versus(self, filter: str, over: str, part: str, quantity: str, statistic: str = "rms") -> Comparison | None:
        """One comparison; None for the baseline itself, or what is not compared."""
        wanted = (filter, over, part, quantity, statistic)
        same = (c for c in self.comparisons if (c.filter, c.over, c.part, c.quantity, c.statistic) == wanted)
        return next(same, None)

    def seconds_into_outage(self) -> list[str]:
        """Times since the last fix at which there are errors, as ``part`` names them without ``at`` and ``s``."""
        found = dict.fromkeys(v.part for v in self.values if v.part.startswith("at "))
        return [part.removeprefix("at ").removesuffix(" s") for part in found]

    def as_dict(self) -> dict[str, Any]:
        """For ``metrics.json``; ``pandas.DataFrame(**result["values"])`` is the frame, and so for ``comparisons``."""
        rows = [asdict(c) for c in self.comparisons]
        return {
            "kind": self.kind,
            "count": dict(self.count),
            "settle_s": self.settle_s,
            "values": {"columns": Value._fields, "data": [list(v) for v in self.values]},
            "comparisons": {"columns": list(rows[0]) if rows else [], "data": [list(r.values()) for r in rows]},
            "per_segment": list(self.per_segment),
            "per_outage": list(self.per_outage),
        }

    @staticmethod
    def of(content: Mapping[str, Any]) -> Results:
        """Results as ``metrics.json`` has them: the inverse of :meth:`as_dict`."""
        columns, comparisons = content["comparisons"]["columns"], []
        for row in content["comparisons"]["data"]:
            named: dict[str, Any] = {k: x if k in TEXT else _real(x) for k, x in zip(columns, row)}
            comparisons.append(PairedRatio(**named))
        values = (Value(*row[:-2], value=_real(row[-2]), unit=row[-1]) for row in content["values"]["data"])
        kept = {k: content[k] for k in ("kind", "count", "settle_s")}
        lists: dict[str, Any] = {k: tuple(content[k]) for k in ("per_segment", "per_outage")}
        return Results(**kept, values=tuple(values), comparisons=tuple(comparisons), **lists)


def _real(x: float | str | None) -> float:
    return float("nan") if x is None else x if isinstance(x, int) else float(x)


def summarise_scores(
    scores: Scores, *, settle_s: float = SETTLE_S, baseline: str = BASELINE, resamples: int = 2000, seed: int = 0
) -> Results:
    """The results of one kind of data. Raises ValueError for scores of several kinds (split them first)."""
    if len(scores.kinds) > 1:
        raise ValueError(f"results of {' and '.join(scores.kinds)} data must not be mixed: use of_kind")
    w, groups = scores.windows, np.array([p.group for p in scores.segments])
    lengths = w.length * scores.epoch_s
    distance = outage_distance(scores.truth_v_n, w, scores.epoch_s)
    samples: dict[str, dict[tuple[str, str, str], Array]] = {}  # filter → (over, part, quantity) → one per unit
    values: list[Value] = []
    for name in scores.filters:
        size, phases = magnitudes(scores.filters[name].error), _phases(scores, settle_s)
        samples[name] = {
            ("segments", k, q): segment_rms(size[q], mask) for q in QUANTITIES for k, mask in phases.items()
        }
        if len(w.segment):
            samples[name] |= _outage_samples(scores, name, distance)
        for (over, part, quantity), x in samples[name].items():
            values += make_values(scores.kinds[0], name, over, part, quantity, summarise_errors(x))
        spread = {"rms": rms(scores.filters[name].innovation)}  # over their 1σ; NaN of a filter without covariance
        values += make_values(scores.kinds[0], name, "segments", "with_gnss", "innovation", spread)
        values += _imu_error_quality(scores, name)
    values += _bias_response(scores)
    return Results(
        kind=scores.kinds[0],
        count={
            "segments": len(scores.segments),
            "drives": len({p.drive for p in scores.segments}),
            "groups": len(set(groups)),
            "repeated": len({(p.drive, p.t_start) for p in scores.segments}) < len(scores.segments),
            "outages": len(w.segment),
            "outage_drives": len({scores.segments[i].drive for i in w.segment}),
            "outage_s": [float(lengths.min()), float(lengths.max())] if len(lengths) else None,
            "longest_without_fix_s": scores.longest_without_fix_s,
            "scored_s": float((~np.isnan(scores.truth_p_n[..., 0])).sum() * scores.epoch_s),
        },
        settle_s=settle_s,
        values=tuple(values),
        comparisons=tuple(_comparisons(scores, samples, baseline, groups, resamples=resamples, seed=seed)),
        per_segment=tuple(
            {
                "drive": p.drive,
                "group": p.group,
                "t_start": p.t_start,
                "rms": {n: {q: float(x["segments", "all", q][i]) for q in QUANTITIES} for n, x in samples.items()},
            }
            for i, p in enumerate(scores.segments)
        ),
        per_outage=tuple(
            {
                "drive": scores.segments[i].drive,
                "group": scores.segments[i].group,
                "t_start": scores.segments[i].t_start + float(w.first[k]) * scores.epoch_s,
                "length_s": float(lengths[k]),
                "distance_m": float(distance[k]),
                "end": {
                    n: {q: float(x["outages", "end", q][k]) for q in (*QUANTITIES, "drift")} for n, x in samples.items()
                },
            }
            for k, i in enumerate(w.segment)
        ),
    )


def make_values(
    kind: str, filter: str, over: str, part: str, quantity: str, statistics: Mapping[str, float]
) -> list[Value]:
    """Rows of several statistics of one thing, with their unit."""
    unit = UNITS[quantity]
    return [
        Value(kind, filter, over, part, quantity, s, x, "1" if s in COUNTS else unit) for s, x in statistics.items()
    ]


def imu_error_values(kind: str, filter: str, statistic: str, six: Array) -> list[Value]:
    """Rows of one statistic of the six axes of the IMU-error estimate at the end of a segment."""
    rows = (make_values(kind, filter, "segments", "last", q, {statistic: float(x)}) for q, x in zip(IMU_AXES, six))
    return [row for one in rows for row in one]


def last_finite(x: Array) -> Array:
    """The last value of each segment and axis that is not NaN: (P, T, n) → (P, n)."""
    known = ~np.isnan(x)
    last = x.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    return np.take_along_axis(x, last[:, None], axis=1)[:, 0]


def _outage_samples(scores: Scores, name: str, distance: Array) -> dict[tuple[str, str, str], Array]:
    w, size = scores.windows, magnitudes(scores.filters[name].error)
    seconds = np.asarray(INTO_OUTAGE_S)
    seconds = seconds[seconds <= w.length.max() * scores.epoch_s + 1e-9]
    at = {q: outage_at(size[q], w, seconds, scores.epoch_s) for q in QUANTITIES}
    std = scores.filters[name].position_std
    end = {q: outage_end(size[q], w) for q in QUANTITIES}
    with np.errstate(divide="ignore", invalid="ignore"):
        end["drift"] = np.where(distance > LEAST_M, end["horizontal"] / distance, np.nan)
    found = {("outages", "end", q): x for q, x in end.items()}
    found |= {("outages", "rms", q): outage_rms(size[q], w) for q in QUANTITIES}
    found |= {("outages", f"at {s:g} s", q): at[q][:, i] for i, s in enumerate(seconds) for q in QUANTITIES}
    return found | {("outages", "end", "sigma"): outage_end(np.hypot(std[..., 0], std[..., 1]), w)}  # the filter's own


def _comparisons(
    scores: Scores,
    samples: Mapping[str, Mapping[tuple[str, str, str], Array]],
    baseline: str,
    groups: NDArray[np.str_],
    **options: Any,
) -> Iterator[PairedRatio]:
    if baseline not in scores.filters:
        return
    units = {("segments", "all"): groups}
    if len(scores.windows.segment):
        units["outages", "end"] = groups[scores.windows.segment]
    for name in samples:
        for ((over, part), g), q, s in product(units.items(), QUANTITIES, COMPARED):
            if name != baseline:
                a, b = (samples[n][over, part, q] for n in (name, baseline))
                yield PairedRatio(
                    kind=scores.kinds[0], filter=name, baseline=baseline, over=over, part=part, quantity=q,
                    **vars(compare(a, b, statistic=s, groups=g, **options)),
                )  # fmt: skip


def _imu_error_quality(scores: Scores, name: str) -> list[Value]:
    """Slope over the segments of the last estimate against the true IMU error, and its RMS error; six axes.

    NaN where the truth is unknown (a real drive), or the same in every segment (slope).
    """
    truth = last_finite(scores.true_imu_error)
    estimate = last_finite(scores.filters[name].imu_error)
    slopes, rms = slope(estimate, truth, intercept=True), segment_rms((estimate - truth).T)
    kind = scores.kinds[0]
    return imu_error_values(kind, name, "slope", slopes) + imu_error_values(kind, name, "rms", rms)


def _bias_response(scores: Scores) -> list[Value]:
    """Slope over the segments of what each filter's last estimate made of an injected bias; six axes.

    1 for an estimator, 0 for a memoriser (paper.md 4.7). Empty where no bias was injected.
    """
    cause = scores.injected_bias
    if np.isnan(cause).all():
        return []
    slopes = {name: slope(run.bias_response, cause, intercept=False) for name, run in scores.filters.items()}
    rows = (imu_error_values(scores.kinds[0], name, "injected_slope", six) for name, six in slopes.items())
    return [value for row in rows for value in row]


def _phases(scores: Scores, settle_s: float) -> dict[str, Mask]:
    settled = np.broadcast_to(scores.t > settle_s + 1e-9, scores.outage.shape)
    phases = {"all": np.ones_like(scores.outage), "settled": settled}
    if scores.outage.any():
        phases["with_gnss"] = settled & ~scores.outage
    return phases
