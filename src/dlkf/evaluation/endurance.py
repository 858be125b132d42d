"""Does a filter that wins after a cold start still win after minutes of GNSS, and does it hold for an hour?

The paper scores outages in segments of a minute, where a Kalman filter is still converging when GNSS goes. Here the
same outage comes after so many seconds with GNSS, and whole long segments run without any outage (R124, R161).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dlkf.base.errors import InputError
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Drive
from dlkf.data.segments import StartLaw, cut_segments
from dlkf.evaluation.bootstrap import Comparison, compare
from dlkf.evaluation.metrics import magnitudes, outage_end, summarise_errors
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol, Scenes
from dlkf.evaluation.run import score_scenes
from dlkf.evaluation.table import ResultTable, format_interval, format_number
from dlkf.filters.smoother import Filter

OUTAGE_S, HOUR_S = 40.0, 3600.0
MOST_SEGMENTS = 100  # of a length, spread evenly
REST_S = 5.0  # of a segment behind its outage
MINUTES = ((1, 10), (10, 30), (30, 60))


@dataclass(frozen=True)
class OutageErrors:
    """Errors at the end of an outage after ``seconds`` with GNSS, RMS and geometric mean; of heading at its start."""

    seconds: float
    segments: int
    groups: int
    filters: dict[str, dict[str, float]]
    ratios: dict[str, Comparison]  # geometric means against the baseline, with intervals


def scenes_after_gnss(data: DriveDataModule, side: str, first_s: float, seed: int, limit: int | None) -> Scenes | None:
    """Segments of a side with an outage of 40 s after ``first_s`` with GNSS, at most ``limit`` (None: all); None where
    no drive has room for one."""
    length = first_s + OUTAGE_S + REST_S
    if not (segments := cut_segments(data.stack, length, span=data.spans[side])):
        return None
    plan = OutagePlan(float(first_s), OUTAGE_S, offsets_s=(0.0,))
    protocol = Protocol("segments", length, length, data.start, outage=plan, seed=seed)
    return Scenes(data.stack, protocol, segments=segments, limit=limit)


def score_after_gnss(
    filters: Mapping[str, Filter], data: DriveDataModule, seconds: Sequence[float], *, baseline: str, seed: int
) -> list[OutageErrors]:
    """The same outage of 40 s after so many seconds with GNSS, over the test side's drives; a length that no drive
    has room for is left out."""
    out = []
    for first in seconds:
        if (scenes := scenes_after_gnss(data, "test", first, seed, MOST_SEGMENTS)) is None:
            continue
        scores = score_scenes(filters, scenes, groups={d.name: d.group for d in data.stack})
        w = scores.windows
        groups = [scores.segments[i].group for i in w.segment]
        ends, rows = {}, {}
        for name, run in scores.filters.items():
            size = magnitudes(run.error)
            ends[name] = outage_end(size["horizontal"], w)
            before = size["heading"][w.segment, np.maximum(w.first - 1, 0)]
            stats = summarise_errors(ends[name])
            rows[name] = {
                "rms_m": stats["rms"],
                "geometric_m": stats["geomean"],
                "heading_deg": math.degrees(summarise_errors(before)["rms"]),
            }
        ratios = {
            name: compare(x, ends[baseline], statistic="geomean", groups=groups, seed=seed)
            for name, x in ends.items()
            if baseline in ends and name != baseline
        }
        out.append(OutageErrors(float(first), len(w.segment), len(set(groups)), rows, ratios))
    return out


def score_without_outage(
    filters: Mapping[str, Filter], drives: Sequence[Drive], start: StartLaw, *, seed: int
) -> dict[str, dict[str, float]]:
    """RMS of position [m] and heading [°] over parts of a segment of an hour with GNSS throughout, per filter.

    Raises InputError where no drive is that long.
    """
    segments = cut_segments(drives, HOUR_S)
    if not segments:
        raise InputError("no drive has 60 min of valid truth; simulate longer ones, dataset.drive_minutes=63")
    scores = score_scenes(
        filters, Scenes(drives, Protocol("segments", HOUR_S, HOUR_S, start, seed=seed), segments=segments)
    )
    out = {}
    for name, run in scores.filters.items():
        size = magnitudes(run.error)
        row: dict[str, float] = {}
        for low, high in MINUTES:
            part = (scores.t > 60 * low) & (scores.t <= 60 * high)
            if part.any():
                row[f"heading_deg_{low}_{high}_min"] = math.degrees(
                    summarise_errors(size["heading"][:, part].ravel())["rms"]
                )
                row[f"position_m_{low}_{high}_min"] = summarise_errors(size["position"][:, part].ravel())["rms"]
        out[name] = row
    return out


def after_tables(dataset: str, rows: Sequence[OutageErrors], baseline: str) -> list[ResultTable]:
    """Errors at the end after each time with GNSS with the ratio of geometric means, and the heading when it goes."""
    names, columns = list(rows[0].filters), ["Filter"]
    for r in rows:
        columns += [f"{r.seconds:g} s\ngeo / RMS [m]", f"ratio to\n{baseline}"]
    errors, headings = [], []
    for name in names:
        cells = [name]
        for r in rows:
            f = r.filters[name]
            ratio = format_interval(r.ratios.get(name)) if baseline in r.filters else ""
            cells += [f"{format_number(f['geometric_m'], digits=2)} / {format_number(f['rms_m'], digits=2)}", ratio]
        errors.append(cells)
        headings.append([name, *(format_number(r.filters[name]["heading_deg"], digits=2) for r in rows)])
    counts = ", ".join(f"{r.segments} outages of {r.groups} recordings after {r.seconds:g} s" for r in rows)
    return [
        ResultTable(
            title=f"{dataset}: outages of {OUTAGE_S:g} s after longer and longer GNSS",
            note=f"{counts}. Horizontal error at the end, geometric mean and RMS; ratio of geometric means. A filter "
            "that wins in the first column alone has won a cold start.",
            columns=columns,
            rows=errors,
        ),
        ResultTable(
            title=f"{dataset}: heading when GNSS goes",
            note="RMS error [°] after so many seconds with GNSS.",
            columns=["Filter", *(f"{r.seconds:g} s" for r in rows)],
            rows=headings,
        ),
    ]


def hour_table(dataset: str, rows: Mapping[str, Mapping[str, float]]) -> ResultTable:
    """Heading and position by part of the hour."""
    keys = list(next(iter(rows.values())))

    def heading(key: str) -> str:
        what, unit, low, high, _ = key.split("_")
        return f"{what}\n{low}–{high} min [{'°' if unit == 'deg' else unit}]"

    return ResultTable(
        title=f"{dataset}: an hour with GNSS and no outage",
        note="RMS over the part of the hour.",
        columns=["Filter", *map(heading, keys)],
        rows=[[name, *(format_number(row[k]) for k in keys)] for name, row in rows.items()],
    )
