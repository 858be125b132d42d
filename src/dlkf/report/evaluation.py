"""What an evaluation leaves behind: metrics.json, table.md, table.csv, report.html; on request figures for print."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.colours import SHADE, TRUTH, filter_colour
from dlkf.base.files import write_into
from dlkf.evaluation.metrics import Mask, magnitudes, outage_at, outage_end, rms_over_segments
from dlkf.evaluation.outages import UNUSED
from dlkf.evaluation.results import Results
from dlkf.evaluation.scores import OFF_SCALE, Scores, representative, settled_limits
from dlkf.evaluation.sensors import TITLE as SENSORS_TITLE
from dlkf.evaluation.summary import END, describe_verdict, headline, sigma_warnings
from dlkf.evaluation.table import (
    ERROR_PANELS,
    IMU_PANELS,
    ResultTable,
    all_tables,
    as_csv,
    as_json,
    as_markdown,
    format_number,
)
from dlkf.report.drawing import Figure
from dlkf.report.maps import add_track, chart, join_tracks
from dlkf.report.navigation import mark_outages
from dlkf.report.page import Page
from dlkf.report.plots import Array, band, line, shade, spans, stack_panels
from dlkf.report.training import ABOUT, learning_curve

MAP = (
    "The {truth}, the outages, and the track of each filter in them; a click on a grey name shows a filter that is far "
    "off. A click on a row of the table of outages goes there."
)
MOST_OUTAGES = 300  # rows of the table of outages: the worst of them
SEEN_AT_ONCE = 11  # of them, in the box of the page


def write_report(
    out: str | Path,
    dataset: str,
    scores: Scores,
    results: Sequence[Results],
    *,
    protocol: Mapping[str, Any],
    by_time: bool,
    baseline: str | None,
    more: Sequence[ResultTable] = (),
    figures: bool,
    trained: str | None = None,
    warnings: Sequence[str] = (),
    losses: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> None:
    """Write the whole report into ``out``, all files or none.

    ``results`` has one entry per kind of data (of scores.of_kind); ``protocol`` is how the
    scores were made, in plain values; ``more`` tables follow those of the results; ``figures``: figures for print as
    well, figures/*.png; ``trained``: the filter with which the answer begins, ``losses``: of its training
    (:func:`dlkf.report.training.learning_curve`); ``warnings`` stand beside those on filters that are too sure of
    themselves. Raises InputError if ``out`` cannot be written to.
    """
    parts = [*all_tables(dataset, results), *more]
    pictures = print_figures(scores, by_time, baseline, protocol.get("reference")) if figures else []
    files: dict[str, bytes] = {
        "metrics.json": as_json(
            {
                "dataset": dataset,
                "protocol": protocol,
                "results": [r.as_dict() for r in results],
                "tables": [t._asdict() for t in more],
                "warnings": [*warnings, *sigma_warnings(scores)],
            }
        ).encode(),
        "table.md": "\n".join([*map(as_markdown, parts), *(f"**Warning:** {line}\n" for line in warnings)]).encode(),
        "table.csv": as_csv(dataset, results).encode(),
        "report.html": evaluation_page(
            dataset, parts, scores, results, protocol, baseline, trained, losses, warnings
        ).encode(),
        **{f"figures/{name}.png": data for name, data in pictures},
    }
    with write_into(out) as folder:
        if pictures:
            (folder / "figures").mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data)


def print_figures(
    scores: Scores, by_time: bool, baseline: str | None, own: str | None = None
) -> list[tuple[str, bytes]]:
    """(file name, PNG) of every kind of data; ``own``: a reference that was made."""
    from dlkf.evaluation.figures import all_figures, png  # matplotlib takes a second to load

    pictures = []
    for kind in scores.kinds:
        suffix = "" if len(scores.kinds) == 1 else f"_{kind}"
        drawn = all_figures(scores.of_kind(kind), by_time=by_time, baseline=baseline, named=name_truth(kind, own))
        pictures += [(f"{name}{suffix}", png(figure, 110)) for name, figure in drawn]
    return pictures


def name_truth(kind: str, own: str | None) -> str:
    """What errors are against: only simulated drives have a truth, if no reference of their ``own`` was made."""
    return "truth" if kind == "simulated" and not own else "reference"


def evaluation_page(
    dataset: str,
    parts: Sequence[ResultTable],
    scores: Scores,
    results: Sequence[Results],
    protocol: Mapping[str, Any],
    baseline: str | None,
    trained: str | None = None,
    losses: Mapping[str, Sequence[float]] = MappingProxyType({}),
    warnings: Sequence[str] = (),
) -> str:
    """The page: answer, of a training what was ``trained`` first; for every kind of data the table of the outages, map,
    growth, further sensors, every outage; then what is for research: the ``losses`` of the training, errors over time,
    IMU errors, the other tables."""
    many = len(results) > 1
    verdicts = [(r, v) for r in results if trained is not None and (v := describe_verdict(r, trained))]
    said = [*verdicts, *((r, headline(r)) for r in results)]
    answers = [f"{r.kind.capitalize()} data. {line}" if many else line for r, line in said]
    own = protocol.get("reference")
    answers += [f"No truth: errors are against the {own}."] if own else []
    unused = protocol.get(UNUSED)
    answers += [f"{unused[0].upper()}{unused[1:]}."] if unused else []
    title = f"Training of {trained} and evaluation on {dataset}" if trained else f"Evaluation on {dataset}"
    page = Page(title, answers, warnings=[*warnings, *sigma_warnings(scores)])
    first = [t for t in parts if "outage" in t.title or t.title == SENSORS_TITLE]
    for result in results:
        kind = f"{result.kind}: " if many else ""
        tables = [t for t in first if not many or f"({result.kind})" in t.title]
        _answer(page, scores.of_kind(result.kind), result, kind, baseline, name_truth(result.kind, own), tables)
    _add_tables(page, [t for t in first if many and not any(f"({r.kind})" in t.title for r in results)])
    if losses:
        page.heading("Training", ABOUT)
        page.figure("training", learning_curve(losses))
    for result in results:
        _research(page, scores.of_kind(result.kind), result, f"{result.kind}: " if many else "", baseline)
    _add_tables(page, [t for t in parts if t not in first])
    page.protocol(protocol)
    return page.html()


def _add_tables(page: Page, tables: Sequence[ResultTable]) -> None:
    for table in tables:
        page.heading(table.title)
        page.table(table.columns, table.rows, marks=mark_best(table.columns, table.rows))
        page.note(table.note)


def mark_best(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Marks the row with the least median, where there is one."""
    column = next((i for i, c in enumerate(columns) if c.startswith("median")), None)
    cells = [] if column is None else [row[column] for row in rows]
    values = pd.to_numeric(pd.Series(cells, dtype=object), errors="coerce").to_numpy(float)
    if not np.isfinite(values).any():
        return []
    least = int(np.nanargmin(values))
    return ["class=best" if k == least else "" for k in range(len(rows))]


def _answer(
    page: Page, scores: Scores, result: Results, kind: str, baseline: str | None, truth: str,
    tables: Sequence[ResultTable],
) -> None:  # fmt: skip
    """Table, map, growth, further sensors, every outage."""
    name = kind.strip(": ") or "all"
    if scores.outage.any():
        _add_tables(page, [t for t in tables if t.title != SENSORS_TITLE])
        page.heading(f"{kind}Map", MAP.format(truth=truth))
        page.figure(f"map-{name}", outage_map(scores, truth))
        page.heading(f"{kind}Error against the time without GNSS", "Median and 95 % of the outages that last so long.")
        page.figure(f"growth-{name}", growth_chart(scores))
        _add_tables(page, [t for t in tables if t.title == SENSORS_TITLE])
        best = least_error(scores, result)
        columns, rows, marks = outage_rows(scores, result, f"map-{name}", best)
        about = f"Horizontal error at the end [m], the worst of {best} first; a click shows it on the map."
        scrolled = f" {len(rows)} rows: scroll in the box." if len(rows) > SEEN_AT_ONCE else ""
        page.heading(f"{kind}Outages ({len(result.per_outage)})", about + scrolled)
        page.table(columns, rows, marks=marks, tall=True)
        if len(result.per_outage) > len(rows):
            page.note(f"The worst {len(rows)} of {len(result.per_outage)}; all are in metrics.json.")
    else:
        page.heading(f"{kind}Map", f"The {truth} and the track of each filter.")
        page.figure(f"map-{name}", segment_map(scores, baseline, truth))
        _add_tables(page, tables)


def _research(page: Page, scores: Scores, result: Results, kind: str, baseline: str | None) -> None:
    """Errors over time, IMU errors."""
    name = kind.strip(": ") or "all"
    page.heading(f"{kind}Errors over time", describe_average(scores))
    page.figure(f"errors-{name}", error_charts(scores))
    chosen = representative(scores, 3, baseline)
    if chosen:
        i = chosen[len(chosen) // 2]
        best = least_error(scores, result)
        about = f"{scores.describe_segment(i)}, an average segment; band: ±3σ of {best}"
        about += "; black: truth." if np.isfinite(scores.true_imu_error[i]).any() else "."
        page.heading(f"{kind}IMU errors", about)
        page.figure(f"imu-{name}", imu_error_charts(scores, i, best))


def describe_average(scores: Scores) -> str:
    """What the errors over time are averaged over, and what is grey in them."""
    count, sources = len(scores.segments), len({(s.drive, s.t_start) for s in scores.segments})
    text = f"RMS over {count} segments"
    if sources < count:
        what = "drive" if sources == len({s.drive for s in scores.segments}) else "segment"
        each = f"{sources} {what}{'s, each' if sources > 1 else ''} with outages at {count / sources:.2g} offsets"
        text = f"RMS over {count} runs ({each})"
    if not scores.outage.any():
        return f"{text}."
    return f"{text}; grey where most of them have an outage{'' if _mostly_hidden(scores).any() else ' (here nowhere)'}."


def _mostly_hidden(scores: Scores) -> Mask:
    """Epochs in which most segments have an outage."""
    return scores.outage.mean(0) > 0.5


def colours(scores: Scores) -> dict[str, str]:
    """Filter → colour."""
    return {n: filter_colour(k) for k, n in enumerate(scores.filters)}


def growth_chart(scores: Scores) -> Figure:
    """Median and 95 % of the horizontal error against the time since the last fix, and how many outages reach it where
    they are not all as long."""
    w = scores.windows
    seconds = scores.epoch_s * np.arange(1, int(w.length.max()) + 1)
    counted = ["Outages that last so long"] if np.ptp(w.length) else []
    figure = stack_panels(["Median [m]", "95 % [m]", *counted], height=230)
    for name, shade_of in colours(scores).items():
        x = outage_at(magnitudes(scores.filters[name].error)["horizontal"], w, seconds, scores.epoch_s)
        x = np.where(np.isinf(x), 1e9, x)  # a filter that broke counts
        known = np.isfinite(x).any(0)
        for row, q in ((1, 50), (2, 95)):
            y = np.full(len(seconds), np.nan)
            y[known] = np.nanpercentile(x[:, known], q, axis=0)
            y[y > 1e8] = np.nan
            figure.add_trace(line(seconds, y, name, shade_of, legend=row == 1, width=2), row)
    if counted:
        count = (w.length[:, None] * scores.epoch_s >= seconds[None]).sum(0)
        bars = {"type": "bar", "x": seconds, "y": count, "marker": {"color": SHADE}, "name": "outages"}
        figure.add_trace(bars | {"showlegend": False}, 3)
    figure.set_log_scale(1)
    figure.set_log_scale(2)
    figure.update_xaxis(2 + len(counted), title={"text": "Time without GNSS [s]"})
    return figure


def outage_map(scores: Scores, named: str) -> Figure:
    """Truth of all segments (a reference is ``named`` so), outages, every filter's way in them from the last fix on."""
    w = scores.windows
    known = ~np.isnan(scores.truth_p_n[..., 0])
    segments = np.flatnonzero(known.any(1)).tolist()
    truth = [scores.geodetic(i, scores.truth_p_n[i, known[i]]) for i in segments]
    windows, far = list(zip(w.segment, np.maximum(w.first - 1, 0), w.last)), far_off(scores)
    hidden = [scores.geodetic(i, scores.truth_p_n[i, a : b + 1]) for i, a, b in windows]
    traces = [
        add_track(join_tracks(hidden, 8000), "outage", SHADE, width=9),
        add_track(join_tracks(truth, 12_000), named, TRUTH, width=1.5),
    ]
    for name, c in colours(scores).items():
        p = scores.filters[name].p_n
        ways = [scores.geodetic(i, p[i, a : b + 1]) for i, a, b in windows]
        more = {"visible": "legendonly"} if name in far else {}
        traces.append(add_track(join_tracks(ways, 8000), name, c, width=2, **more))
    return chart(traces, places_of_drives(scores, segments, truth))


def far_off(scores: Scores) -> list[str]:
    """Filters whose median error at the end of the outages is twenty times that of the best: their ways would cover the
    map, so that they are shown where somebody asks for them."""
    end = {n: outage_end(magnitudes(r.error)["horizontal"], scores.windows) for n, r in scores.filters.items()}
    median = {n: float(np.nanmedian(x)) if np.isfinite(x).any() else math.inf for n, x in end.items()}
    return [n for n, m in median.items() if m > OFF_SCALE * min(median.values())]


def segment_map(scores: Scores, baseline: str | None, named: str) -> Figure:
    """Truth and every filter of up to eight segments from good to bad."""
    chosen = representative(scores, 8, baseline)
    truth = [scores.geodetic(i, scores.truth_p_n[i]) for i in chosen]
    traces = [add_track(join_tracks(truth), named, TRUTH, width=2)]
    for name, c in colours(scores).items():
        p = scores.filters[name].p_n
        traces.append(add_track(join_tracks([scores.geodetic(i, p[i]) for i in chosen]), name, c, width=2))
    return chart(traces, places_of_drives(scores, chosen, truth))


def places_of_drives(scores: Scores, segments: Sequence[int], places: Sequence[Array]) -> dict[str, Array]:
    """Drive → what ``places`` has of its segments."""
    parts: dict[str, list[Array]] = {}
    for i, place in zip(segments, places):
        parts.setdefault(scores.segments[i].drive, []).append(place)
    return {drive: np.concatenate(of_drive) for drive, of_drive in parts.items()}


def least_error(scores: Scores, result: Results) -> str:
    """The filter of the least median at the end of the outages."""
    medians = {name: result.value(name, *END, "median") for name in scores.filters}
    return min(medians, key=lambda name: math.inf if math.isnan(medians[name]) else medians[name])


def outage_rows(
    scores: Scores, result: Results, figure: str, best: str
) -> tuple[list[str], list[list[str]], list[str]]:
    """Columns, rows and marks of the table of outages, the worst of the ``best`` filter first."""
    w, names = scores.windows, list(scores.filters)
    ends = np.array([[o["end"][n]["horizontal"] for n in names] for o in result.per_outage], float)
    of_best = ends[:, names.index(best)]
    order = np.argsort(-np.nan_to_num(of_best, nan=-1.0), kind="stable")[:MOST_OUTAGES]
    rows, marks = [], []
    for k in order:
        o, i = result.per_outage[k], int(w.segment[k])
        rows.append(
            [o["drive"], f"{o['t_start']:.0f}", f"{o['length_s']:g}", format_number(o["distance_m"])]
            + [format_number(x) for x in ends[k]]
        )
        part = scores.truth_p_n[i, max(w.first[k] - 1, 0) : w.last[k] + 1]
        lat, lon = scores.geodetic(i, np.nanmean(part, 0))
        half = 0.7 * max(float(np.ptp(part[:, 0])), float(np.ptp(part[:, 1])), 20.0)
        marks.append(mark_outages(figure, lat, lon, half))
    return ["Drive", "from t\n[s]", "Length\n[s]", "Distance\n[m]", *names], rows, marks


def error_charts(scores: Scores) -> Figure:
    """RMS over the segments of the horizontal, velocity and attitude error at each time, of those that the reference
    has."""
    sizes = {name: magnitudes(scores.filters[name].error) for name in scores.filters}
    known = [q for q in ERROR_PANELS if q == "horizontal" or any(np.isfinite(size[q]).any() for size in sizes.values())]
    figure = stack_panels([ERROR_PANELS[quantity][0] for quantity in known], height=180)
    for name, c in colours(scores).items():
        for row, quantity in enumerate(known, 1):
            size = sizes[name][quantity]
            y = rms_over_segments(np.where(np.isinf(size), np.nan, size)) * ERROR_PANELS[quantity][1]
            if np.isfinite(y).any():
                figure.add_trace(line(scores.t, y, name, c, legend=row == 1), row)
    for row in range(1, len(known) + 1):
        figure.set_log_scale(row)
    figure.update_xaxis(len(known), title={"text": "Time since the start of a segment [s]"})
    shade(figure, spans(scores.t, _mostly_hidden(scores)), len(known))
    return figure


def imu_error_charts(scores: Scores, i: int, banded: str) -> Figure:
    """Estimates of one segment, with the ±3σ of the filter ``banded``, and the truth where it is known."""
    figure, late = stack_panels([title for title, _ in IMU_PANELS], height=120), scores.t > 0.2 * scores.t[-1]
    for k, (_, scale) in enumerate(IMU_PANELS):
        truth = scores.true_imu_error[i, :, k] * scale
        for name, c in colours(scores).items():
            run = scores.filters[name]
            y, sigma = run.imu_error[i, :, k] * scale, 3 * run.imu_std[i, :, k] * scale
            if not np.nan_to_num(run.imu_error[i]).any():
                continue
            if name == banded and np.isfinite(sigma).any():
                figure.add_trace(band(scores.t, y - sigma, y + sigma, name, c), k + 1)
            figure.add_trace(line(scores.t, y, name, c, legend=k == 0), k + 1)
        if np.isfinite(truth).any():
            figure.add_trace(line(scores.t, truth, "truth", TRUTH, legend=k == 0), k + 1)
        settled = [
            scale * x[i, late, k] for x in (scores.true_imu_error, *(r.imu_error for r in scores.filters.values()))
        ]
        if limits := settled_limits(settled):
            figure.update_yaxis(k + 1, range=list(limits))
    figure.update_xaxis(6, title={"text": "Time since the start of the segment [s]"})
    shade(figure, spans(scores.t, scores.outage[i]), 6)
    return figure
