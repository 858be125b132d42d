"""Figures of an evaluation; every function returns a matplotlib Figure and touches no global state.

Colours are Okabe & Ito's, which colour-blind readers can distinguish; each filter also has its own line style.
Truth (or the reference) is black, an outage is shaded, bands of 1σ are ±3σ as on the page.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from dlkf.base.colours import COLOURS, SHADE
from dlkf.evaluation.bootstrap import MIN_GROUPS, rms_band
from dlkf.evaluation.metrics import Array, magnitudes, outage_at, outage_intervals, rms_over_segments
from dlkf.evaluation.scores import OFF_SCALE, Scores, representative, settled_limits
from dlkf.evaluation.table import ERROR_PANELS, IMU_PANELS, format_number

STYLES = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1)), (0, (2, 2)))
MANY = 20  # outages, from which on a histogram is drawn


def png(figure: Figure, dpi: int = 130) -> bytes:
    """A figure as PNG."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, facecolor="white")
    return out.getvalue()


def all_figures(
    scores: Scores, *, by_time: bool, baseline: str | None, named: str = "truth"
) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of one kind of data; ``named``: what the errors are against.

    ``by_time``: the segments are alike (same length, outage at the same time), so that an average over them at
    each time means something.
    """
    chosen = representative(scores, 4, baseline)
    if not chosen:
        return
    if scores.outage.any():
        yield "error_growth", error_growth(scores)
        pair = [baseline, list(scores.filters)[-1]]
        if len(scores.windows.segment) >= MANY and baseline in scores.filters and pair[0] != pair[1]:
            yield "error_histograms", error_histograms(scores, pair)
    yield "tracks", tracks(scores, chosen, named)
    if by_time and len(scores.segments) > 1:
        yield "error_over_time", error_over_time(scores)
    yield "imu_errors", imu_errors(scores, chosen[len(chosen) // 2])


def line_style(scores: Scores, name: str) -> dict[str, Any]:
    """Colour and style of a filter, the same in every figure of these scores."""
    k = list(scores.filters).index(name)
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": STYLES[k % len(STYLES)]}


def tracks(scores: Scores, segments: Sequence[int], named: str = "truth") -> Figure:
    """2D track of some segments: truth, every filter's path, outages marked on the truth (figs 10, 12).

    A reference that is no truth is ``named`` so.

    Below each track its outage of median error, zoomed to where GNSS comes back.
    """
    hidden = [i for i in segments if scores.outage[i].any()]
    rows = 2 if hidden else 1
    figure = Figure(figsize=(max(4.1 * len(segments), 6), 4.3 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, len(segments), squeeze=False)
    for k, i in enumerate(segments):
        truth = scores.truth_p_n[i, :, :2]
        low, high = np.nanmin(truth, 0), np.nanmax(truth, 0)
        middle = 0.5 * (low + high)
        half = 0.6 * max(*(high - low), 40.0)
        _track(axes[0, k], scores, i, middle, half)
        there = ~np.isnan(truth[:, 0])
        paths = {n: np.nan_to_num(r.p_n[i, there, :2], nan=np.inf) for n, r in scores.filters.items()}
        _absent(axes[0, k], [n for n, p in paths.items() if (np.abs(p - middle) > half).any()])
        known = truth[~np.isnan(truth[:, 0])]
        axes[0, k].plot(known[0, 1], known[0, 0], "o", color="black", ms=5, zorder=5)
        axes[0, k].annotate("start", known[0, ::-1], xytext=(6, 6), textcoords="offset points", fontsize=8, zorder=6)
        axes[0, k].set_title(scores.describe_segment(i), fontsize=9)
        if i in hidden:
            _outage_end(axes[1, k], scores, i)
        elif hidden:
            axes[1, k].set_visible(False)
    handles = [Line2D([], [], color="black", lw=1.6, label=named)]
    if hidden:
        handles.append(Line2D([], [], color=SHADE, lw=8, solid_capstyle="round", label="outage"))
    _legend(figure, handles + _filter_handles(scores, scores.filters))
    return figure


def _track(ax: Axes, scores: Scores, i: int, middle: Array, half: float) -> None:
    """Truth, outages and filters of a segment in a square of 2·half around ``middle`` (north, east)."""
    truth, outage = scores.truth_p_n[i, :, :2], scores.outage[i]
    before = np.roll(outage, -1)
    before[-1] = False  # an outage is drawn from the last fix on
    hidden = np.where((outage | before)[:, None], truth, np.nan)
    ax.plot(hidden[:, 1], hidden[:, 0], color=SHADE, lw=9, solid_capstyle="round", zorder=1)
    ax.plot(truth[:, 1], truth[:, 0], color="black", lw=1.6, zorder=3)
    for name, run in scores.filters.items():
        p = run.p_n[i, :, :2]
        ax.plot(p[:, 1], p[:, 0], lw=1.8, alpha=0.9, zorder=4, **line_style(scores, name))
    ax.set_aspect("equal")
    ax.set_xlim(middle[1] - half, middle[1] + half)
    ax.set_ylim(middle[0] - half, middle[0] + half)
    ax.set(xlabel="East [m]", ylabel="North [m]")
    plain_axes(ax)


def _absent(ax: Axes, names: Sequence[str]) -> None:
    if names:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1}
        note = textwrap.fill(f"leaves the picture: {', '.join(names)}", 42)
        ax.text(0.02, 0.02, note, transform=ax.transAxes, fontsize=8, color="#555555", zorder=6, bbox=box)


def _outage_end(ax: Axes, scores: Scores, i: int) -> None:
    """The end of a segment's outage of median error; a ring is the last position without GNSS."""
    w = outage_intervals(scores.outage[i : i + 1])
    ends = {n: magnitudes(r.error[i, w.last])["horizontal"] for n, r in scores.filters.items()}
    best = np.min([np.where(np.isfinite(e), e, np.inf) for e in ends.values()], 0)
    k = int(np.argsort(best)[len(best) // 2])
    last = int(w.last[k])
    near = [e[k] for e in ends.values() if np.isfinite(e[k]) and e[k] <= 12 * max(best[k], 1.0)]
    truth = scores.truth_p_n[i, last, :2]
    half = max(1.6 * max(near, default=1.0), 4.0)
    _track(ax, scores, i, truth, half)
    absent: list[str] = []
    ax.plot(truth[1], truth[0], "o", ms=8, mfc="none", mec="black", mew=1.6, zorder=5)
    for name, run in scores.filters.items():
        p = run.p_n[i, last]
        if not (np.abs(p[:2] - truth) <= half).all():
            absent.append(name)
        ax.plot(p[1], p[0], "o", ms=8, mfc="none", mec=line_style(scores, name)["color"], mew=1.6, zorder=5)
    _absent(ax, absent)
    start = scores.segments[i].t_start + w.first[k] * scores.epoch_s
    title = f"end of the outage from t = {start:.0f} s, {w.length[k] * scores.epoch_s:g} s without GNSS"
    ax.set_title(title, fontsize=9)


def error_over_time(scores: Scores) -> Figure:
    """RMS over segments at each time since their start, middle 80 % of the segments as a band (figs 13, 14).

    Outages are shaded, darker where more segments have one.
    """
    every = range(len(scores.segments))
    sizes = {n: magnitudes(r.error) for n, r in scores.filters.items()}
    shown = [q for q in ERROR_PANELS if any(np.isfinite(s[q]).any() for s in sizes.values())]
    figure = Figure(figsize=(9, 2.5 * max(len(shown), 1) + 0.9), layout="constrained")
    axes = figure.subplots(max(len(shown), 1), 1, sharex=True, squeeze=False).ravel()
    length = scores.t[np.flatnonzero(~np.isnan(scores.truth_p_n).all((0, 2)))[-1]]
    for ax, q in zip(axes, shown):
        label, scale = ERROR_PANELS[q]
        _shade(ax, scores, every)
        for name in scores.filters:
            x = sizes[name][q] * scale
            finite = np.where(np.isfinite(x), x, np.nan)
            style = line_style(scores, name)
            ax.plot(scores.t, rms_over_segments(np.where(np.isinf(x), np.nan, x)), lw=1.8, zorder=3, **style)
            if len(every) > 4:
                some = (~np.isnan(finite)).sum(0) > 4
                band = np.nanpercentile(finite[:, some], [10, 90], axis=0)
                ax.fill_between(scores.t[some], *band, color=style["color"], alpha=0.13, lw=0, zorder=2)
        ax.set_yscale("log")
        ax.set_ylabel(label)
        ax.set_xlim(0, length)
        plain_axes(ax)
    axes[len(shown) - 1].set_xlabel("Time since the start of the segment [s]")
    band = ", band: middle 80 % of the segments" if len(every) > 4 else ""
    axes[0].set_title(f"RMS over {len(every)} segments{band}", fontsize=9, loc="left")
    _legend(figure, _filter_handles(scores, scores.filters) + _outage_handle(scores, every))
    return figure


def imu_errors(scores: Scores, i: int) -> Figure:
    """IMU-error estimates of a segment over time, six axes; truth in black, ±3σ as a band (figs 6, 11)."""
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    known = not np.isnan(scores.true_imu_error[i]).all()
    last = np.flatnonzero(~np.isnan(scores.truth_p_n[i]).all(-1))[-1]
    settled = scores.t > 0.2 * scores.t[last]
    runs = {n: r for n, r in scores.filters.items() if np.nan_to_num(r.imu_error[i]).any()}  # that estimate one
    for k, (ax, (label, scale)) in enumerate(zip(axes.ravel(), IMU_PANELS)):
        _shade(ax, scores, [i])
        extent: list[Array] = []
        for name, run in runs.items():
            style = line_style(scores, name)
            y, s = run.imu_error[i, :, k] * scale, 3 * run.imu_std[i, :, k] * scale
            ax.plot(scores.t, y, lw=1.7, zorder=3, **style)
            ax.fill_between(scores.t, y - s, y + s, color=style["color"], alpha=0.15, lw=0, zorder=2)
            extent.append(y[settled])
        if known:
            y = scores.true_imu_error[i, :, k] * scale
            ax.plot(scores.t, y, color="black", lw=1.4, zorder=4)
            extent.append(y[settled])
        if limits := settled_limits(extent):
            ax.set_ylim(*limits)
        ax.set_title(label, fontsize=9, loc="left")
        ax.set_xlim(0, scores.t[last])
        if k >= 3:
            ax.set_xlabel("Time since the start [s]")
        plain_axes(ax)
    handles: list[Artist] = [Line2D([], [], color="black", lw=1.4, label="truth")] if known else []
    handles += _filter_handles(scores, runs)
    if any(np.isfinite(r.imu_std[i]).any() for r in scores.filters.values()):
        handles.append(Patch(color="#666666", alpha=0.5, lw=0, label="±3σ, in the colour of each filter"))
    figure.suptitle(f"IMU-error estimates, {scores.describe_segment(i)}", fontsize=10)
    _legend(figure, handles + _outage_handle(scores, [i]))
    return figure


def error_growth(scores: Scores) -> Figure:
    """RMS of the horizontal error over outages against the time without GNSS, with its 95 % bootstrap band."""
    w = scores.windows
    longest = int(w.length.max())
    seconds = scores.epoch_s * np.arange(1, longest + 1)
    groups = [scores.segments[i].group for i in w.segment]
    figure = Figure(figsize=(8, 5), layout="constrained")
    ax = figure.subplots()
    ends: dict[str, float] = {}
    tops: dict[str, float] = {}
    banded = False
    for name, run in scores.filters.items():
        x = outage_at(magnitudes(run.error)["horizontal"], w, seconds, scores.epoch_s)
        rms, low, high = rms_band(x, groups=groups)
        style = line_style(scores, name)
        ax.plot(seconds, np.where(np.isfinite(rms), rms, np.nan), lw=2, label=name, zorder=3, **style)
        ax.fill_between(seconds, low, high, color=style["color"], alpha=0.15, lw=0, zorder=2)
        banded |= bool(np.isfinite(low).any())
        ends[name] = float(np.nanmax(rms, initial=0.0))
        tops[name] = max(float(np.nanmax(high, initial=0.0)), ends[name])
    inside = [n for n in ends if np.isfinite(ends[n]) and ends[n] <= OFF_SCALE * max(min(ends.values()), 1e-9)]
    outside = [f"{n} ({format_number(ends[n])} m)" for n in ends if n not in inside]
    ax.set_ylim(0, 1.05 * max((tops[n] for n in inside), default=1.0))
    ax.set_xlim(0, seconds[-1])
    ax.set(xlabel="Time without GNSS [s]", ylabel="Horizontal error, RMS [m]")
    band = "band: 95 % bootstrap interval of the RMS" if banded else f"under {MIN_GROUPS} recordings: no intervals"
    note = f"\noff the scale at the end: {', '.join(outside)}" if outside else ""
    ax.set_title(f"{len(w.segment)} outages, {band}{note}", fontsize=9, loc="left")
    plain_axes(ax)
    _legend(figure, ax.get_legend_handles_labels()[0])
    return figure


def error_histograms(scores: Scores, names: Sequence[str]) -> Figure:
    """How the outages are spread: horizontal RMS since the outage began, 10, 20, … s into it (paper fig. 14, R148).

    At most six times; the last bin holds what lies beyond. The title says which of several filters are drawn.
    """
    w = scores.windows
    times = np.arange(10.0, w.length.min() * scores.epoch_s + 1e-9, 10.0)[:6]
    counts = np.rint(times / scores.epoch_s).astype(int)
    figure = Figure(figsize=(10, 1.2 + 1.9 * math.ceil(len(counts) / 2)), layout="constrained")
    panels = figure.subplots(math.ceil(len(counts) / 2), 2, squeeze=False)
    squares = {n: magnitudes(scores.filters[n].error)["horizontal"] ** 2 for n in names}
    for ax, count in zip(panels.flat, counts):
        found = {
            n: np.sqrt([x[i, a : a + count].mean() for i, a in zip(w.segment, w.first)]) for n, x in squares.items()
        }
        top = max(float(np.nanquantile(x, 0.95)) for x in found.values())
        for n, x in found.items():
            heights, edges = np.histogram(np.minimum(x, top), bins=20, range=(0.0, top))
            last = n == names[-1]
            ax.stairs(heights, edges, lw=1.6, fill=last, alpha=0.7 if last else 1, **line_style(scores, n))
        ax.set(xlim=(0, top))
        ax.set_title(f"{count * scores.epoch_s:g} s without GNSS", fontsize=9)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        plain_axes(ax)
    if len(names) < len(scores.filters):
        figure.suptitle(f"{len(names)} of {len(scores.filters)} filters: {', '.join(names)}", fontsize=10)
    for ax in panels.flat[len(counts) :]:
        ax.set_visible(False)
    for ax in panels.flat[: len(counts)][-2:]:  # the lowest of each column
        ax.set_xlabel("Horizontal RMS since the outage began [m]", fontsize=9)
    for ax in panels[:, 0]:
        ax.set_ylabel("Outages", fontsize=9)
    _legend(figure, _filter_handles(scores, names))
    return figure


def _shade(ax: Axes, scores: Scores, segments: Iterable[int]) -> None:
    share = scores.outage[list(segments)].mean(0)
    edges = np.concatenate(([0.0], scores.t))
    change = np.flatnonzero(np.diff(share, prepend=-1.0, append=-1.0))
    for a, b in pairwise(change):
        if share[a] > 0:
            ax.axvspan(edges[a], edges[b], color=SHADE, alpha=0.25 + 0.75 * share[a], lw=0, zorder=0)


def _filter_handles(scores: Scores, names: Iterable[str]) -> list[Artist]:
    return [Line2D([], [], lw=1.8, label=n, **line_style(scores, n)) for n in names]


def _outage_handle(scores: Scores, segments: Sequence[int]) -> list[Artist]:
    return [Patch(color=SHADE, label="outage")] if scores.outage[list(segments)].any() else []


def _legend(figure: Figure, handles: Sequence) -> None:
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), frameon=False, fontsize=9)


def plain_axes(ax: Axes) -> None:
    """A light grid behind the lines, no frame."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#EEEEEE", lw=0.8, zorder=0)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=8)
