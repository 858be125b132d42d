"""Tracks on a map: the page draws them in metres, without a network, and on OpenStreetMap's streets where one asks.

Drives that are far apart for their size lie in areas of their own. A map of several areas opens on the first where all
of them together would be specks, and has a choice of areas.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dlkf.base.errors import list_some
from dlkf.data.limits import DEGREE_M
from dlkf.report.drawing import Figure, Trace
from dlkf.report.plots import FONT

Array = NDArray[np.floating]
MOST = 6000  # points of all tracks of one kind on a map
SMALLEST_DEG = 0.002  # of a drive, when its distance from another is compared with its size
SPECKS = 3.0  # all drives together are this many times wider than the widest area: too small to be seen
ONE_PLANE_DEG = 1.0  # wider than this, no plane in metres shows all drives
FEW_NAMED = 2  # drives in the name of an area


class Area(NamedTuple):
    """Drives that are seen together: the corners (latitude, longitude) [°] around them, and their name in a choice."""

    name: str
    low: Array
    high: Array

    @property
    def width(self) -> float:
        """The larger side [° of latitude]."""
        return float(np.max((self.high - self.low) * _shrink(self.low)))


def find_areas(places: Mapping[str, Array]) -> list[Area]:
    """The drives (name → latitudes and longitudes (n, 2)) by area, in their order: two are in one area if the gap
    between them is at most the size of the larger."""
    known = {name: place[np.isfinite(place).all(-1)] for name, place in places.items()}
    known = {name: place for name, place in known.items() if len(place)}
    if not known:
        return []
    names = list(known)
    low, high = (np.array([edge(place, 0) for place in known.values()]) for edge in (np.min, np.max))
    shrink = _shrink(low)
    size = np.maximum(((high - low) * shrink).max(1), SMALLEST_DEG)
    free, areas = np.ones(len(names), bool), []
    for first in range(len(names)):
        if not free[first]:
            continue
        members, waiting = [], [first]
        free[first] = False
        while waiting:
            k = waiting.pop()
            members.append(k)
            gap = np.maximum(np.maximum(low - high[k], low[k] - high), 0.0) * shrink
            near = free & (np.hypot(*gap.T) <= np.maximum(size, size[k]))
            free &= ~near
            waiting += np.flatnonzero(near).tolist()
        areas.append(_join([Area(names[k], low[k], high[k]) for k in sorted(members)]))
    return areas


def _shrink(place: Array) -> Array:
    """What degrees (…, 2) at a place are in degrees of latitude."""
    return np.stack((np.ones(place.shape[:-1]), np.cos(np.radians(place[..., 0]))), -1)


def _join(areas: Sequence[Area], name: str | None = None) -> Area:
    name = name or list_some([area.name for area in areas], FEW_NAMED)
    return Area(name, np.min([a.low for a in areas], 0), np.max([a.high for a in areas], 0))


def add_track(place: Array, name: str, colour: str, *, width: float, **more: Any) -> Trace:
    """A line through latitudes and longitudes (n, 2); NaN breaks it."""
    return _trace(place, name, mode="lines", line={"color": colour, "width": width}, **more)


def dots(
    place: Array, name: str, colour: str | Array, *, size: float = 6, bar: str | None = None,
    ticks: Mapping[float, str] = MappingProxyType({}), **more: Any,
) -> Trace:  # fmt: skip
    """Points (n, 2) of one colour, or coloured by a value with a bar, which has ``ticks`` (value → text) if given."""
    marker: dict[str, Any] = {"size": size, "color": colour}
    if bar is not None:
        at = {"tickvals": list(ticks), "ticktext": list(ticks.values())} if ticks else {}
        marker |= {"colorscale": "Viridis", "colorbar": {"title": {"text": bar}, "thickness": 12, "len": 0.7, **at}}
    return _trace(place, name, mode="markers", marker=marker, **more)


def _trace(place: Array, name: str, **more: Any) -> Trace:
    lat, lon = np.ascontiguousarray(place.T)
    return {"type": "scattermap", "lat": lat, "lon": lon, "name": name, **more}


def chart(
    traces: Sequence[Trace], places: Mapping[str, Array] = MappingProxyType({}), groups: Sequence[str] = ()
) -> Figure:
    """The map of some traces, seen so that the drives at ``places`` (name → (n, 2)) fill it, or the first area of them.

    ``groups`` has one name a trace: buttons show one group at a time; a trace whose group is empty is always shown.
    """
    figure = Figure(list(traces))
    areas = find_areas(places)
    first = 0
    if len(areas) > 1:
        whole = _join(areas, f"all {len(places)} drives")
        if whole.width < ONE_PLANE_DEG:
            first = int(whole.width > SPECKS * max(area.width for area in areas))
            areas.insert(0, whole)
    views = [_view(area) for area in areas] or [{"name": "", "lat": 0.0, "lon": 0.0, "half_lat": 1.0, "half_lon": 1.0}]
    centre = {"lat": views[first]["lat"], "lon": views[first]["lon"]}
    figure.update_layout(
        meta={"areas": views, "first": first},
        map={"style": "white-bg", "center": centre, "zoom": zoom(views[first])}, height=520, font=FONT,
        margin={"l": 0, "r": 0, "t": 40 if groups else 5, "b": 0},
        legend={"orientation": "h", "yanchor": "top", "y": -0.02}, showlegend=True,
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


def in_metres(figure: Figure) -> Figure:
    """A map without tiles as a plane: metres east and north of its middle with equal scale, as the page draws it."""
    views = figure.layout["meta"]
    middle = views["areas"][views["first"]]
    east = DEGREE_M * math.cos(math.radians(middle["lat"]))
    plane = Figure([dict(trace) for trace in figure.data], deepcopy(figure.layout))
    del plane.layout["map"]
    for trace in plane.data:
        lat, lon = trace.pop("lat"), trace.pop("lon")
        trace |= {"type": "scatter", "x": (lon - middle["lon"]) * east, "y": (lat - middle["lat"]) * DEGREE_M}
    look = {"gridcolor": "#eee", "zeroline": False}
    plane.update_xaxis(title={"text": f"East of {middle['lon']:.5f}° [m]"}, **look)
    plane.update_yaxis(title={"text": f"North of {middle['lat']:.5f}° [m]"}, scaleanchor="x", **look)
    plane.update_layout(
        plot_bgcolor="white",
        margin={"l": 70, "r": 10, "b": 45},
        legend={"y": -0.12},
        hovermode="closest",
        dragmode="pan",
    )
    return plane


def _view(area: Area) -> dict[str, Any]:
    """Name, middle and half sides [°] of what shows an area with a margin."""
    middle, half = (area.low + area.high) / 2, np.maximum(0.54 * (area.high - area.low), 1e-4)
    sides = dict(zip(("lat", "lon", "half_lat", "half_lon"), (*middle.tolist(), *half.tolist())))
    return {"name": area.name, **sides}


def zoom(view: Mapping[str, float]) -> float:
    """Of a map of some 700 × 450 pixels (Web Mercator, 512-pixel tiles) that shows a view."""
    wide = view["half_lon"] * 2 * 512 / 360 / 700
    high = view["half_lat"] * 2 * 512 / 360 / math.cos(math.radians(view["lat"])) / 450
    return min(18.0, max(1.0, -math.log2(max(wide, high)) - 0.15))


def join_tracks(parts: Sequence[Array], most: int = MOST) -> Array:
    """Tracks one after the other with NaN between them, evenly thinned to ``most`` points together."""
    total = sum(len(p) for p in parts)
    step = max(1, math.ceil(total / most))
    out = []
    for part in parts:
        keep = np.unique(np.concatenate((np.arange(0, len(part), step), [len(part) - 1]))) if len(part) else []
        out += [part[keep], np.full((1, *part.shape[1:]), np.nan)]
    return np.concatenate(out) if out else np.empty((0, 2))
