"""Tracks on a map: the page draws them in metres, without a network, and on OpenStreetMap's streets where one asks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlkf.report.drawing import Figure, Trace
from dlkf.report.plots import FONT

Array = NDArray[np.floating]
MOST = 6000  # points of all tracks of one kind on a map


def add_track(place: Array, name: str, colour: str, *, width: float, **more: Any) -> Trace:
    """A line through latitudes and longitudes (n, 2); NaN breaks it."""
    return _trace(place, name, mode="lines", line={"color": colour, "width": width}, **more)


def dots(
    place: Array, name: str, colour: str | Array, *, size: float = 6, bar: str | None = None, **more: Any
) -> Trace:
    """Points (n, 2) of one colour, or coloured by a value with a bar."""
    marker: dict[str, Any] = {"size": size, "color": colour}
    if bar is not None:
        marker |= {"colorscale": "Viridis", "colorbar": {"title": {"text": bar}, "thickness": 12, "len": 0.7}}
    return _trace(place, name, mode="markers", marker=marker, **more)


def _trace(place: Array, name: str, **more: Any) -> Trace:
    lat, lon = np.ascontiguousarray(place.T)
    return {"type": "scattermap", "lat": lat, "lon": lon, "name": name, **more}


def chart(traces: Sequence[Trace], groups: Sequence[str] = (), around: Sequence[Trace] | None = None) -> Figure:
    """The map of some traces, seen so that ``around`` (by default all) fill it.

    ``groups`` has one name a trace: buttons show one group at a time; a trace whose group is empty is always shown.
    """
    figure = Figure(list(traces))
    lat, lon = (np.concatenate([np.asarray(t[k], float) for t in around or traces]) for k in ("lat", "lon"))
    known = np.isfinite(lat) & np.isfinite(lon)
    reach = max(np.ptp(lat[known]) * 1.08, 2e-4) / 2 if known.any() else 1.0
    figure.update_layout(
        meta={"half_lat": float(reach), "half_lon": float(np.ptp(lon[known]) * 0.54) if known.any() else 1.0},
        map={"style": "white-bg", **view(lat[known], lon[known])}, height=520, font=FONT,
        margin={"l": 0, "r": 0, "t": 40 if groups else 5, "b": 0},
        legend={"orientation": "h", "yanchor": "top", "y": -0.02},
    )  # fmt: skip
    names = list(dict.fromkeys(g for g in groups if g))
    if len(names) > 1:
        buttons = [
            {"label": n, "method": "restyle", "args": [{"visible": [g in ("", n) for g in groups]}]} for n in names
        ]
        figure.update_layout(
            updatemenus=[
                {"type": "buttons", "direction": "right", "buttons": buttons, "x": 0, "xanchor": "left", "y": 1.0,
                 "yanchor": "bottom", "pad": {"t": 2, "b": 4}, "showactive": True}
            ]
        )  # fmt: skip
        for trace, group in zip(figure.data, groups):
            trace["visible"] = group in ("", names[0])
    return figure


def view(lat: Array, lon: Array) -> dict[str, Any]:
    """Centre and zoom that show all points on a map of some 700 × 450 pixels (Web Mercator, 512-pixel tiles)."""
    if not len(lat):
        return {"center": {"lat": 0.0, "lon": 0.0}, "zoom": 1.0}
    middle = {"lat": float((lat.min() + lat.max()) / 2), "lon": float((lon.min() + lon.max()) / 2)}
    wide = max(float(np.ptp(lon)) * 512 / 360 / 650, 1e-7)
    high = max(float(np.ptp(lat)) * 512 / 360 / math.cos(math.radians(middle["lat"])) / 420, 1e-7)
    return {"center": middle, "zoom": min(18.0, max(1.0, -math.log2(max(wide, high)) - 0.15))}


def join_tracks(parts: Sequence[Array], most: int = MOST) -> Array:
    """Tracks one after the other with NaN between them, evenly thinned to ``most`` points together."""
    total = sum(len(p) for p in parts)
    step = max(1, math.ceil(total / most))
    out = []
    for part in parts:
        keep = np.unique(np.concatenate((np.arange(0, len(part), step), [len(part) - 1]))) if len(part) else []
        out += [part[keep], np.full((1, *part.shape[1:]), np.nan)]
    return np.concatenate(out) if out else np.empty((0, 2))
