"""Pictures of the sky over a drive; every function returns a matplotlib Figure and touches no global state.

``fixes``, ``raw`` and ``reference`` are tables of a dataset made with satellites (``receiver=…``, ``raw=true``).
"""

from __future__ import annotations

from typing import cast

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from dlkf.navigation.earth import SEMI_MAJOR

Array = NDArray[np.floating]
BLUE, ORANGE, GREEN, SHADE = "#0072B2", "#D55E00", "#009E73", "#DDDDDD"
COUNTS = np.arange(3.5, 13.5)  # limits of the colours of a number of satellites
DPI = 110


def sky_plot(raw: pd.DataFrame, above: pd.DataFrame, title: str = "") -> Figure:
    """Azimuth around, elevation inwards: tracks of all satellites ``above`` the horizon (prn, azimuth, elevation [rad])
    in grey, the epochs at which each was tracked in blue, the name at the last place."""
    figure = Figure(figsize=(5.6, 5.6), layout="constrained", dpi=DPI)
    axes = cast(PolarAxes, figure.add_subplot(projection="polar"))
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetagrids(range(0, 360, 45), ("N", "45°", "E", "135°", "S", "225°", "W", "315°"))
    axes.set_rlim(0, 90)
    axes.set_rgrids((0, 30, 60), ("90°", "60°", "30°"), angle=67.5)
    share = raw.groupby("prn").size() / raw.t.nunique()
    for prn, track in above.groupby("prn"):
        tracked = raw[raw.prn == prn]
        axes.plot(track.azimuth, 90 - np.degrees(track.elevation), color="#999999", linewidth=3, zorder=1)
        axes.plot(tracked.azimuth, 90 - np.degrees(tracked.elevation), ".", color=BLUE, markersize=4, zorder=2)
        last = track.azimuth.iloc[-1], 90 - np.degrees(track.elevation.iloc[-1])
        axes.plot(*last, "o", color=BLUE if len(tracked) else "#999999", markersize=6, zorder=3)
        text = f"G{prn:02d} {100 * share.get(prn, 0.0):.0f} %"
        axes.annotate(text, last, xytext=(7, 5), textcoords="offset points", fontsize=8)
    axes.set_title(f"{title}\nshare of the epochs in which each was tracked", fontsize=10)
    return figure


def dilution(fixes: pd.DataFrame, title: str = "") -> Figure:
    """Number of satellites, and dilution of precision, over time; grey where there is no fix."""
    figure = Figure(figsize=(9, 4.6), layout="constrained", dpi=DPI)
    top, bottom = figure.subplots(2, sharex=True)
    top.step(fixes.t, fixes.satellites, color=BLUE, where="mid", linewidth=1)
    top.axhline(4, color="black", linewidth=0.8, linestyle=":")
    top.set_ylim(-0.5, max(12, fixes.satellites.max()) + 0.5)
    top.set_yticks(range(0, 13, 2))
    top.set_ylabel("Satellites tracked")
    top.set_title(title, fontsize=10)
    known = fixes.where(fixes.quality > 0)
    for name, colour in (("pdop", BLUE), ("hdop", GREEN), ("vdop", ORANGE)):
        bottom.plot(fixes.t, known[name], color=colour, label=name.upper(), linewidth=1, marker=".", markersize=2)
    bottom.set_yscale("log")
    bottom.set_yticks((0.5, 1, 2, 5, 10, 20), ("0.5", "1", "2", "5", "10", "20"))
    bottom.set_ylim(0.4, 22)
    bottom.minorticks_off()
    bottom.set_ylabel("Dilution of precision")
    bottom.set_xlabel("Time [s]")
    bottom.legend(loc="lower right", ncols=3, fontsize=9)
    for axes in (top, bottom):
        _shade(axes, fixes)
        axes.grid(alpha=0.3)
    return figure


def route(fixes: pd.DataFrame, reference: pd.DataFrame, title: str = "") -> Figure:
    """The way of the reference, and on it the number of satellites of every epoch; crosses where there is no fix."""
    figure = Figure(figsize=(7, 6), layout="constrained", dpi=DPI)
    axes = figure.subplots()
    lat0, lon0 = reference.lat_deg.iloc[0], reference.lon_deg.iloc[0]
    east = np.radians(reference.lon_deg - lon0) * SEMI_MAJOR * np.cos(np.radians(lat0))
    north = np.radians(reference.lat_deg - lat0) * SEMI_MAJOR
    at = [np.interp(fixes.t, reference.t, x) for x in (east, north)]
    axes.plot(east, north, color="#BBBBBB", linewidth=0.7, zorder=0)
    known = (fixes.quality > 0).to_numpy()
    norm = BoundaryNorm(COUNTS, 256)
    dots = axes.scatter(at[0][known], at[1][known], c=fixes.satellites[known], norm=norm, cmap="viridis", s=9)
    axes.plot(at[0][~known], at[1][~known], "x", color=ORANGE, markersize=4, label="no fix")
    axes.set_aspect("equal")
    axes.margins(0.05)
    axes.set_xlabel("East [m]")
    axes.set_ylabel("North [m]")
    axes.set_title(title, fontsize=10)
    figure.colorbar(dots, label="Satellites tracked", ticks=range(4, 13), shrink=0.8)
    if not known.all():
        axes.legend(loc="best")
    return figure


def errors(fixes: pd.DataFrame, error_n: Array, title: str = "") -> Figure:
    """Error of every fix [m] in north, east and down (N, 3), within three times the 1σ that the fix claims."""
    figure = Figure(figsize=(9, 5.4), layout="constrained", dpi=DPI)
    known = (fixes.quality > 0).to_numpy()
    for axes, name, error, axis in zip(figure.subplots(3, sharex=True), ("North", "East", "Down"), error_n.T, "ned"):
        limit = 3 * fixes[f"std_pos_{axis}"].where(known)
        axes.fill_between(fixes.t, -limit, limit, color=BLUE, alpha=0.2, linewidth=0, label="3 σ claimed")
        axes.plot(fixes.t, np.where(known, error, np.nan), color=BLUE, linewidth=0.8, label="error")
        span = 1.15 * np.nanquantile(np.maximum(limit, np.abs(np.where(known, error, 0))), 0.98)
        axes.set_ylim(-span, span)
        axes.set_ylabel(f"{name} [m]")
        axes.grid(alpha=0.3)
        _shade(axes, fixes)
    figure.axes[0].set_title(title, fontsize=10)
    figure.axes[0].legend(loc="upper right", ncols=2, fontsize=9)
    figure.axes[-1].set_xlabel("Time [s]")
    return figure


def world(lat_deg: Array, lon_deg: Array, count: Array, pdop: Array, title: str = "") -> Figure:
    """Mean number of satellites in view and the 95 % of PDOP over a grid (L,), (M,) of the Earth, (L, M) each."""
    figure = Figure(figsize=(9, 7), layout="constrained", dpi=DPI)
    for axes, values, label, levels in zip(
        figure.subplots(2, sharex=True),
        (count, pdop),
        ("Satellites in view, mean", "PDOP, 95 % of the time below"),
        (np.arange(9, 12.01, 0.25), np.arange(1.6, 2.61, 0.1)),
    ):
        filled = axes.contourf(lon_deg, lat_deg, values, levels=levels, cmap="viridis", extend="both")
        figure.colorbar(filled, ax=axes, label=label)
        axes.set_yticks(range(-90, 91, 30))
        axes.set_ylabel("Latitude [°]")
    figure.axes[0].set_title(title, fontsize=10)
    axes.set_xticks(range(-180, 181, 60))
    axes.set_xlabel("Longitude [°]")
    return figure


def _shade(axes: Axes, fixes: pd.DataFrame) -> None:
    """Grey where there is no fix."""
    axes.fill_between(
        fixes.t, 0, 1, where=fixes.quality == 0, color=SHADE, transform=axes.get_xaxis_transform(), step="mid",
        linewidth=0, zorder=0,
    )  # fmt: skip
