"""Everything an evaluation leaves behind: metrics.json, table.md, table.csv, figures/*.png, report.html."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from dlkf.colours import SHADE, TRUTH, colour
from dlkf.evaluation.figures import all_figures, png, representative
from dlkf.evaluation.metrics import magnitudes, outage_at, rms_over_pieces
from dlkf.evaluation.results import Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.summary import END, answer
from dlkf.evaluation.table import DEGREES, Table, all_tables, as_csv, as_json, as_markdown, number
from dlkf.files import placed, staged
from dlkf.report.maps import chart, joined, track
from dlkf.report.navigation import mark
from dlkf.report.page import Page, embedded
from dlkf.report.plots import Array, band, line, shade, spans, stacked

MOST_OUTAGES = 300  # rows of the table of outages: the worst of them
SENSORS = (("Accelerometer", "m/s²", 1.0), ("Gyroscope", "°/s", DEGREES))
IMU = [(f"{name} {axis} error [{unit}]", scale) for name, unit, scale in SENSORS for axis in "xyz"]
OVER_TIME = {
    "horizontal": ("Horizontal [m]", 1.0),
    "velocity": ("Velocity [m/s]", 1.0),
    "attitude": ("Attitude [°]", DEGREES),
}


def write_report(
    out: str | Path,
    dataset: str,
    scores: Scores,
    results: Sequence[Results],
    *,
    protocol: Mapping[str, Any],
    by_time: bool,
    baseline: str | None,
    more: Sequence[Table] = (),
    dpi: int = 110,
) -> list[Path]:
    """Write the whole report into ``out``, all files or none; returns their paths.

    ``results`` has one entry per kind of data (of scores.of_kind); ``protocol`` is how the
    scores were made, in plain values; ``more`` tables follow those of the results. Raises InputError if
    ``out`` cannot be written to.
    """
    parts = [*all_tables(dataset, results), *more]
    pictures: list[tuple[str, str, bytes]] = []
    for kind in scores.kinds:
        suffix = "" if len(scores.kinds) == 1 else f"_{kind}"
        for name, caption, figure in all_figures(scores.of_kind(kind), by_time=by_time, baseline=baseline):
            pictures.append((f"{name}{suffix}.png", f"{kind.capitalize()} data: {caption}", png(figure, dpi)))
    files: dict[str, bytes] = {
        "metrics.json": as_json(
            {
                "dataset": dataset,
                "protocol": protocol,
                "results": [r.as_dict() for r in results],
                "tables": [t._asdict() for t in more],
            }
        ).encode(),
        "table.md": "\n".join(map(as_markdown, parts)).encode(),
        "table.csv": as_csv(dataset, results).encode(),
        "report.html": evaluation_page(dataset, parts, scores, results, pictures, protocol, baseline).encode(),
        **{f"figures/{name}": data for name, _, data in pictures},
    }
    with staged(out) as folder:
        (folder / "figures").mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data)
    return [placed(out) / name for name in files]


def evaluation_page(
    dataset: str,
    parts: Sequence[Table],
    scores: Scores,
    results: Sequence[Results],
    pictures: Sequence[tuple[str, str, bytes]],
    protocol: Mapping[str, Any],
    baseline: str | None,
) -> str:
    """The page: answer, tables, and for every kind of data growth of the error, map, outages, errors over time."""
    many = len(results) > 1
    answers = [f"{r.kind.capitalize()} data. {answer(r)}" if many else answer(r) for r in results]
    own = protocol.get("reference")
    truth = "reference" if own else "truth"
    page = Page(f"Evaluation on {dataset}", answers + ([f"No truth: errors are against the {own}."] if own else []))
    outages_first = sorted(parts, key=lambda t: "outage" not in t.title)
    for table in outages_first:
        page.heading(table.title)
        page.table(table.columns, table.rows, marks=best_of(table.columns, table.rows))
        page.note(table.note)
    for result in results:
        _sections(page, scores.of_kind(result.kind), result, f"{result.kind}: " if many else "", baseline, truth)
    page.images("The figures for print", [(caption, embedded(data)) for _, caption, data in pictures])
    page.protocol(protocol)
    return page.html()


def best_of(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Marks the row with the least median, where there is one."""
    column = next((i for i, c in enumerate(columns) if c.startswith("median")), None)
    values = [] if column is None else [_value(row[column]) for row in rows]
    if not values or not np.isfinite(values).any():
        return []
    least = int(np.nanargmin(values))
    return ["class=best" if k == least else "" for k in range(len(rows))]


def _value(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _sections(page: Page, scores: Scores, result: Results, kind: str, baseline: str | None, truth: str) -> None:
    name = kind.strip(": ") or "all"
    if scores.outage.any():
        page.heading(f"{kind}Error against the time without GNSS", "Median and 95 % of the outages that last so long.")
        page.figure(f"growth-{name}", growth(scores))
        page.heading(f"{kind}Map", f"The {truth}, the outages, and every filter's way in them; a row below goes there.")
        page.figure(f"map-{name}", outage_map(scores, truth))
        best = least_error(scores, result)
        about = f"Horizontal error at the end [m], the worst of {best} first; a click shows it on the map."
        page.heading(f"{kind}Outages", about)
        columns, rows, marks = outage_rows(scores, result, f"map-{name}", best)
        page.table(columns, rows, marks=marks, tall=True)
        if len(result.per_outage) > len(rows):
            page.note(f"The worst {len(rows)} of {len(result.per_outage)}; all are in metrics.json.")
    else:
        page.heading(f"{kind}Map", f"The {truth} and where every filter went.")
        page.figure(f"map-{name}", piece_map(scores, baseline, truth))
    page.heading(f"{kind}Errors over time", f"RMS over {len(scores.pieces)} pieces; grey: outages of most pieces.")
    page.figure(f"errors-{name}", errors(scores))
    chosen = representative(scores, 3, baseline if baseline in scores.filters else None)
    if chosen:
        i = chosen[len(chosen) // 2]
        piece = scores.pieces[i]
        about = f"{piece.drive} from t = {piece.t_start:.0f} s, a middling piece; black: truth; bands: ±3σ."
        page.heading(f"{kind}IMU errors", about)
        page.figure(f"imu-{name}", imu_errors(scores, i))


def colours(scores: Scores) -> dict[str, str]:
    """Filter → colour."""
    return {n: colour(k) for k, n in enumerate(scores.filters)}


def growth(scores: Scores) -> go.Figure:
    """Median and 95 % of the horizontal error against the time since the last fix, and how many outages reach it."""
    w = scores.windows
    seconds = scores.epoch_s * np.arange(1, int(w.length.max()) + 1)
    figure = stacked(["Median [m]", "95 % [m]", "Outages that last so long"], height=230)
    for name, shade_of in colours(scores).items():
        x = outage_at(magnitudes(scores.filters[name].error)["horizontal"], w, seconds, scores.epoch_s)
        x = np.where(np.isinf(x), 1e9, x)  # a filter that broke counts
        known = np.isfinite(x).any(0)
        for row, q in ((1, 50), (2, 95)):
            y = np.full(len(seconds), np.nan)
            y[known] = np.nanpercentile(x[:, known], q, axis=0)
            y[y > 1e8] = np.nan
            figure.add_trace(line(seconds, y, name, shade_of, legend=row == 1, width=2), row, 1)
    count = (w.length[:, None] * scores.epoch_s >= seconds[None]).sum(0)
    figure.add_trace(go.Bar(x=seconds, y=count, marker_color=SHADE, name="outages", showlegend=False), 3, 1)
    figure.update_yaxes(type="log", nticks=6, row=1, col=1)
    figure.update_yaxes(type="log", nticks=6, row=2, col=1)
    figure.update_xaxes(title_text="Time without GNSS [s]", row=3, col=1)
    return figure


def outage_map(scores: Scores, named: str) -> go.Figure:
    """Truth of all pieces (a reference is ``named`` so), outages, every filter's way in them from the last fix on."""
    w = scores.windows
    known = [~np.isnan(scores.truth_p_n[i, :, 0]) for i in range(len(scores.pieces))]
    truth = [scores.geodetic(i, scores.truth_p_n[i, known[i]]) for i in range(len(scores.pieces)) if known[i].any()]
    windows = list(zip(w.piece, np.maximum(w.first - 1, 0), w.last))
    hidden = [scores.geodetic(i, scores.truth_p_n[i, a : b + 1]) for i, a, b in windows]
    traces = [
        track(joined(hidden, 8000), "outage", SHADE, width=9),
        track(joined(truth, 12_000), named, TRUTH, width=1.5),
    ]
    for name, c in colours(scores).items():
        p = scores.filters[name].p_n
        ways = [scores.geodetic(i, p[i, a : b + 1]) for i, a, b in windows]
        traces.append(track(joined(ways, 8000), name, c, width=2))
    return chart(traces, around=traces[:2])


def piece_map(scores: Scores, baseline: str | None, named: str) -> go.Figure:
    """Truth and every filter of up to eight pieces from good to bad."""
    chosen = representative(scores, 8, baseline if baseline in scores.filters else None)
    traces = [track(joined([scores.geodetic(i, scores.truth_p_n[i]) for i in chosen]), named, TRUTH, width=2)]
    for name, c in colours(scores).items():
        p = scores.filters[name].p_n
        traces.append(track(joined([scores.geodetic(i, p[i]) for i in chosen]), name, c, width=2))
    return chart(traces, around=traces[:1])


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
        o, i = result.per_outage[k], int(w.piece[k])
        rows.append(
            [o["drive"], f"{o['t_start']:.0f}", f"{o['length_s']:g}", number(o["distance_m"])]
            + [number(x) for x in ends[k]]
        )
        part = scores.truth_p_n[i, max(w.first[k] - 1, 0) : w.last[k] + 1]
        lat, lon = scores.geodetic(i, np.nanmean(part, 0))
        half = 0.7 * max(float(np.ptp(part[:, 0])), float(np.ptp(part[:, 1])), 20.0)
        marks.append(mark(figure, lat, lon, half))
    return ["Drive", "from t\n[s]", "Length\n[s]", "Distance\n[m]", *names], rows, marks


def errors(scores: Scores) -> go.Figure:
    """RMS over the pieces of the horizontal, velocity and attitude error at each time."""
    figure = stacked([title for title, _ in OVER_TIME.values()], height=180)
    for name, c in colours(scores).items():
        size = magnitudes(scores.filters[name].error)
        for row, (quantity, (_, scale)) in enumerate(OVER_TIME.items(), 1):
            y = rms_over_pieces(np.where(np.isinf(size[quantity]), np.nan, size[quantity])) * scale
            if np.isfinite(y).any():
                figure.add_trace(line(scores.t, y, name, c, legend=row == 1), row, 1)
    figure.update_yaxes(type="log")
    figure.update_xaxes(title_text="Time since the start of a piece [s]", row=len(OVER_TIME), col=1)
    shade(figure, spans(scores.t, scores.outage.mean(0) > 0.5), len(OVER_TIME))
    return figure


def imu_errors(scores: Scores, i: int) -> go.Figure:
    """Estimates of one piece with their ±3σ, and the truth where it is known."""
    figure = stacked([title for title, _ in IMU], height=120)
    for k, (_, scale) in enumerate(IMU):
        truth = scores.true_imu_error[i, :, k] * scale
        for name, c in colours(scores).items():
            run = scores.filters[name]
            y, sigma = run.imu_error[i, :, k] * scale, 3 * run.imu_std[i, :, k] * scale
            if not np.nan_to_num(run.imu_error[i]).any():
                continue
            if np.isfinite(sigma).any():
                figure.add_trace(band(scores.t, y - sigma, y + sigma, name, c), k + 1, 1)
            figure.add_trace(line(scores.t, y, name, c, legend=k == 0), k + 1, 1)
        if np.isfinite(truth).any():
            figure.add_trace(line(scores.t, truth, "truth", TRUTH, legend=k == 0), k + 1, 1)
        _settled(figure, scores, i, k, scale)
    figure.update_xaxes(title_text="Time since the start of the piece [s]", row=6, col=1)
    shade(figure, spans(scores.t, scores.outage[i]), 6)
    return figure


def _settled(figure: go.Figure, scores: Scores, i: int, k: int, scale: float) -> None:
    """Limits by the last four fifths of the lines: the first swings may leave the panel."""
    late = scores.t > 0.2 * scores.t[-1]
    lines: list[Array] = [r.imu_error[i, late, k] for r in scores.filters.values()]
    values = np.concatenate([*lines, scores.true_imu_error[i, late, k]]) * scale
    values = values[np.isfinite(values)]
    if values.size:
        margin = 0.6 * float(np.ptp(values)) or 1e-6
        figure.update_yaxes(range=[float(values.min()) - margin, float(values.max()) + margin], row=k + 1, col=1)
