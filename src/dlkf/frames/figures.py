"""A solution and an evaluation as figures that a notebook shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dlkf.base.colours import COLOURS, SHADE, filter_colour
from dlkf.data.limits import DEGREE_M
from dlkf.evaluation.figures import plain_axes, png
from dlkf.evaluation.metrics import magnitudes, outage_at
from dlkf.evaluation.scores import Scores
from dlkf.report.navigation import GAP_S, TrackOnMap, horizontal_std
from dlkf.report.page import embed_png
from dlkf.report.plots import spans
from dlkf.running.grid import UsableFixes
from dlkf.running.offline import Navigated

DPI = 80


class NotebookFigure(Figure):
    """A figure that a notebook shows without pyplot; ``savefig`` writes it."""

    def _repr_png_(self) -> bytes:
        return png(self, DPI)


def as_html(figure: Figure) -> str:
    """A figure as ``<img>``."""
    return f'<img alt="" src="{embed_png(png(figure, DPI))}">'


def draw_solution(navigated: Navigated, fixes: UsableFixes) -> NotebookFigure:
    """The track in metres with its fixes; beside it horizontal 1σ, and position innovations over their 1σ."""
    course = TrackOnMap(navigated, fixes)
    table = navigated.table
    figure = NotebookFigure(figsize=(10, 4.2), layout="constrained")
    axes: Any = figure.subplot_mosaic([["track", "sigma"], ["track", "innovation"]], width_ratios=[1, 1.2])
    lat, lon = table["lat_deg"].to_numpy(), table["lon_deg"].to_numpy()
    scale = np.array([DEGREE_M * np.cos(np.radians(lat[0])), DEGREE_M])

    def metres(lat: np.ndarray, lon: np.ndarray) -> np.ndarray:
        return (np.stack((lon, lat), -1) - (table["lon_deg"].iloc[0], table["lat_deg"].iloc[0])) * scale

    ax = axes["track"]
    ax.plot(*metres(fixes.lat_deg, fixes.lon_deg).T, ".", color="#BBBBBB", markersize=4, label="fixes")
    ax.plot(*metres(lat, lon).T, color=COLOURS[0], linewidth=1.5, label="solution")
    hidden = np.where((course.without > GAP_S)[:, None], metres(lat, lon), np.nan)
    if np.isfinite(hidden).any():
        ax.plot(*hidden.T, color=COLOURS[1], linewidth=3, label=f"over {GAP_S:g} s without a fix")
    ax.set(xlabel="East [m]", ylabel="North [m]", aspect="equal", adjustable="datalim")
    ax.legend(fontsize=8, loc="best")
    t = table["t"].to_numpy()
    sigma = horizontal_std(course)
    axes["sigma"].plot(t, np.maximum(sigma, 1e-4), color=COLOURS[5])
    if np.isfinite(sigma).any() and np.nanmax(sigma) > 10 * np.nanmin(sigma):
        axes["sigma"].set_yscale("log")
    else:
        axes["sigma"].set_ylim(0, None)
    axes["sigma"].set_title("Horizontal 1σ of the filter [m]", fontsize=9, loc="left")
    innovation = navigated.innovation
    if innovation is not None and len(innovation.value) == len(t):
        for k, axis in enumerate("NED"):
            ratio = innovation.value[:, k] / innovation.std[:, k]
            axes["innovation"].plot(t, ratio, ".", markersize=3, color=COLOURS[k], label=axis)
        axes["innovation"].legend(fontsize=8, ncols=3, loc="upper right")
    axes["innovation"].axhspan(-1, 1, color=SHADE, alpha=0.6, zorder=0)
    axes["innovation"].set_title("Position innovations over their 1σ", fontsize=9, loc="left")
    axes["innovation"].set_xlabel("t [s]")
    for name in ("sigma", "innovation"):
        for a, b in spans(t, course.without > GAP_S):
            axes[name].axvspan(a, b, color=SHADE, alpha=0.6, zorder=0)
    for ax in figure.axes:
        plain_axes(ax)
    return figure


def draw_evaluation(scores: Scores, outages: pd.DataFrame) -> NotebookFigure:
    """Median (solid) and largest (dotted) horizontal error against the time without GNSS; every outage's end."""
    figure = NotebookFigure(figsize=(10, 3.8), layout="constrained")
    growth, ends = figure.subplots(1, 2, width_ratios=[1.2, 1])
    w = scores.windows
    seconds = scores.epoch_s * np.arange(1, int(w.length.max()) + 1) if len(w.length) else np.empty(0)
    for k, (name, run) in enumerate(scores.filters.items()):
        if not len(seconds):
            break
        error = outage_at(magnitudes(run.error)["horizontal"], w, seconds, scores.epoch_s)
        colour = filter_colour(k)
        growth.plot(seconds, np.nanmedian(error, 0), color=colour, label=name)
        growth.plot(seconds, np.nanmax(error, 0), ":", color=colour)
        ends.plot(np.sort(outages[name]), np.arange(1, len(outages) + 1), "o-", color=colour, markersize=4, label=name)
    growth.set_title("Horizontal error: median (solid), largest (dotted) [m]", fontsize=9, loc="left")
    growth.set_xlabel("Time without GNSS [s]")
    growth.set_yscale("log")
    growth.legend(fontsize=8)
    ends.set_title("Outages that end with less than this error", fontsize=9, loc="left")
    ends.set(xlabel="Horizontal error at the end [m]", xscale="log", ylim=(0, None))
    for ax in figure.axes:
        plain_axes(ax)
    return figure
