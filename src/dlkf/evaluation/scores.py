"""Errors and estimates of every filter on the same segments, from which tables and figures are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from dlkf.evaluation.metrics import Array, Mask, OutageIntervals, magnitudes, outage_intervals
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef

OF_SEGMENTS = ("origin_e", "injected_bias", "bias_response")  # without an axis of time
OFF_SCALE = 20.0  # a filter this many times worse than the best does not set the scale of a figure


@dataclass(frozen=True)
class SegmentSource:
    """Where a row of the scores comes from. ``kind``: simulated, semi-real or real."""

    drive: str
    group: str
    kind: str
    t_start: float  # s, the drive's own clock


@dataclass
class FilterRun:
    """One filter over all P segments; rows as in :class:`Scores`."""

    error: Array  # (P, T, 9) truth − estimate, see metrics.error_series
    p_n: Array  # (P, T, 3) estimated position in the segment's tangent frame
    imu_error: Array  # (P, T, 6) estimate
    imu_std: Array  # (P, T, 6) its 1σ, NaN where the filter has none
    position_std: Array  # (P, T, 3) 1σ of the position, likewise
    innovation: Array  # (P, T, 6) innovation over its 1σ, NaN where no fix was used or the filter has no covariance
    aids: Array  # (P, T, A) of further sensors, columns of dlkf.filters.aids.attach.aid_columns
    bias_response: Array  # (P, 6) how far the last estimate of the IMU error followed an injected bias, NaN without


@dataclass
class Scores:
    """P segments of up to T epochs (NaN-padded) and what each filter made of them."""

    epoch_s: float
    segments: list[SegmentSource]
    outage: Mask  # (P, T) fix withheld
    fix: Mask  # (P, T) position that the filters were given
    truth_p_n: Array  # (P, T, 3)
    truth_v_n: Array  # (P, T, 3)
    true_imu_error: Array  # (P, T, 6)
    origin_e: Array  # (P, 3) ECEF of the tangent frames' origins
    injected_bias: Array  # (P, 6) that was added to the IMU in runs of their own, NaN without
    filters: dict[str, FilterRun] = field(default_factory=dict)

    @property
    def t(self) -> Array:
        """Time since the start of a segment at the end of each epoch [s], (T,)."""
        return self.epoch_s * np.arange(1, self.outage.shape[1] + 1)

    @property
    def ends(self) -> tuple[Array, list[str]]:
        """Time of the last truth of each segment [s since its start], (P,), and their drives."""
        last = np.where(np.isfinite(self.truth_p_n[..., 0]), self.t, 0.0).max(1)
        return last, [segment.drive for segment in self.segments]

    @property
    def longest_without_fix_s(self) -> float:
        """Longest time without a fix [s] before the last truth of a segment, outages included."""
        without = ~self.fix & (self.t <= self.ends[0][:, None])
        return self.epoch_s * float(outage_intervals(without).length.max(initial=0))

    def geodetic(self, segment: int, p_n: Array) -> Array:
        """Latitude and longitude [°] (…, 2) of positions (…, 3) in the tangent frame of a segment."""
        origin = torch.from_numpy(self.origin_e[segment])
        lat, lon, _ = geodetic_from_ecef(origin)
        r_e = origin + torch.from_numpy(np.asarray(p_n, float)) @ ned_axes(lat, lon).mT
        return np.degrees(np.stack([x.numpy() for x in geodetic_from_ecef(r_e)[:2]], -1))

    @property
    def windows(self) -> OutageIntervals:
        """All outages."""
        return outage_intervals(self.outage)

    def describe_segment(self, segment: int) -> str:
        """Drive, start and the outages, which tell the runs over one drive apart."""
        source = self.segments[segment]
        text = f"{source.drive} from t = {source.t_start:.0f} s"
        starts = outage_intervals(self.outage[[segment]]).first * self.epoch_s + source.t_start
        if not len(starts):
            return text
        return f"{text}, {'outages' if len(starts) > 1 else 'outage'} from t = {starts[0]:.0f} s"

    @property
    def kinds(self) -> list[str]:
        """Kinds of data among the segments, sorted."""
        return sorted({p.kind for p in self.segments})

    def of_kind(self, kind: str) -> Scores:
        """The segments of one kind: simulated and real results are never mixed."""
        keep = [i for i, p in enumerate(self.segments) if p.kind == kind]
        part = {k: x[keep] for k, x in vars(self).items() if isinstance(x, np.ndarray)}
        runs = {n: FilterRun(*(x[keep] for x in vars(r).values())) for n, r in self.filters.items()}
        return replace(self, segments=[self.segments[i] for i in keep], filters=runs, **part)


def join_scores(parts: Sequence[Scores]) -> Scores:
    """The segments of several scores of the same filters in their order, padded to the longest."""
    if len(parts) == 1:
        return parts[0]
    T = max(s.outage.shape[1] for s in parts)

    def rows(things: Sequence[Any], name: str) -> Array:
        values = [getattr(x, name) for x in things]
        return np.concatenate(values if name in OF_SEGMENTS else [_pad(x, T) for x in values])

    def join(things: Sequence[Any]) -> dict[str, Any]:
        return {name: rows(things, name) for name, x in vars(things[0]).items() if isinstance(x, np.ndarray)}

    filters = {name: FilterRun(**join([s.filters[name] for s in parts])) for name in parts[0].filters}
    segments = [segment for s in parts for segment in s.segments]
    return Scores(epoch_s=parts[0].epoch_s, segments=segments, filters=filters, **join(parts))


def _pad(x: Array, T: int) -> Array:
    """(P, t, …) to (P, T, …): no outage, NaN elsewhere."""
    extra = [(0, 0)] * x.ndim
    extra[1] = (0, T - x.shape[1])
    return np.pad(x, extra, constant_values=False if x.dtype == bool else np.nan)


def settled_limits(parts: Sequence[Array]) -> tuple[float, float] | None:
    """Limits of an axis by the settled parts of its lines, with room to see them converge; the first swings may leave.

    None where nothing is finite.
    """
    values = np.concatenate([*parts, np.empty(0)])
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    margin = 0.6 * float(np.ptp(values)) or 1e-6
    return float(values.min()) - margin, float(values.max()) + margin


def representative(scores: Scores, n: int, filter_name: str | None) -> list[int]:
    """Up to n segments from good to bad: even quantiles of a filter's horizontal error in outages (or anywhere), of the
    first filter where that is not among them."""
    run = scores.filters.get(filter_name or "") or next(iter(scores.filters.values()))
    size = magnitudes(run.error)["horizontal"]
    if scores.outage.any():
        size = np.where(scores.outage, size, np.nan)
    worst = np.nanmax(np.where(np.isnan(size), -1.0, size), axis=-1)
    order = [int(i) for i in np.argsort(worst, kind="stable") if worst[i] >= 0]
    if len(order) <= n:
        return order
    return [order[int(q * len(order))] for q in (np.arange(n) + 0.5) / n]
