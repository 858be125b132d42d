"""Lines over time for a page: thinned so that nothing one can see is lost, small enough for ten hours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dlkf.base.colours import SHADE
from dlkf.data.masks import find_runs
from dlkf.report.drawing import Figure, Trace, panels

Array = NDArray[np.floating]
MOST = 1800  # points of a line: more than a screen has columns
FONT = {"family": "system-ui, sans-serif", "size": 12}


def extremes(y: Array) -> NDArray[np.int64]:
    """Indices that keep the least and the largest value of each of :data:`MOST`/2 buckets: peaks survive."""
    n = len(y)
    if n <= MOST:
        return np.arange(n)
    edges = np.linspace(0, n, MOST // 2 + 1).astype(int)
    first, count = edges[:-1, None], np.diff(edges)[:, None]
    place = np.arange(count.max())
    inside = place < count
    bucket = y[np.minimum(first + place, n - 1)]
    known = inside & np.isfinite(bucket)  # a bucket without a value gives its first place twice
    least = np.where(known, bucket, np.inf).argmin(1)
    most = np.where(known, bucket, -np.inf).argmax(1)
    return np.unique(np.concatenate(([0, n - 1], edges[:-1] + least, edges[:-1] + most)))


def every(n: int, most: int) -> NDArray[np.int64]:
    """Indices spread evenly, the last among them."""
    if n <= most:
        return np.arange(n)
    return np.unique(np.linspace(0, n - 1, most).astype(int))


def small(x: Sequence | Array) -> Array:
    """As float32, which halves a page."""
    return np.asarray(x, np.float32)


def stack_panels(titles: Sequence[str], *, height: int) -> Figure:
    """Panels below each other with a common time axis."""
    rows = len(titles)
    figure = panels(titles, min(0.09, 0.4 / rows))
    figure.update_layout(
        height=height * rows + 90, margin={"l": 60, "r": 15, "t": 40, "b": 45}, font=FONT,
        legend={"orientation": "h", "yanchor": "top", "y": -0.12 if rows > 1 else -0.2}, hovermode="x unified",
    )  # fmt: skip
    return figure


def line(x: Array, y: Array, name: str, colour: str, *, legend: bool = True, width: float = 1.5) -> Trace:
    """A thinned line; a name stands in the legend once."""
    i = extremes(np.asarray(y, float))
    return {
        "type": "scatter", "x": small(x[i]), "y": small(y[i]), "name": name, "legendgroup": name, "showlegend": legend,
        "mode": "lines", "line": {"color": colour, "width": width},
    }  # fmt: skip


def band(x: Array, low: Array, high: Array, name: str, colour: str, *, legend: bool = False) -> Trace:
    """A shaded band; parts without a value are left out."""
    i = every(len(x), MOST // 2)
    i = i[np.isfinite(low[i]) & np.isfinite(high[i])]
    r, g, b = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return {
        "type": "scatter", "x": small(np.concatenate((x[i], x[i][::-1]))),
        "y": small(np.concatenate((high[i], low[i][::-1]))), "fill": "toself",
        "fillcolor": f"rgba({r},{g},{b},0.18)", "line": {"width": 0}, "mode": "lines", "name": name,
        "legendgroup": name, "showlegend": legend, "hoverinfo": "skip",
    }  # fmt: skip


def shade(figure: Figure, spans: Sequence[tuple[float, float]], rows: int) -> None:
    """Grey where there was no GNSS; at most 200 spans, the longest."""
    longest = sorted(spans, key=lambda s: s[0] - s[1])[:200]
    shapes = [
        {
            "type": "rect", "x0": a, "x1": b, "y0": 0, "y1": 1, "fillcolor": SHADE, "opacity": 0.6,
            "line": {"width": 0}, "layer": "below", "xref": f"x{k if k > 1 else ''}",
            "yref": f"y{k if k > 1 else ''} domain",
        }
        for k in range(1, rows + 1)
        for a, b in longest
    ]  # fmt: skip
    figure.update_layout(shapes=shapes)


def spans(t: Array, flags: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """(from, to) of the runs of True; a run begins at the sample before it."""
    return [(float(t[max(a - 1, 0)]), float(t[b - 1])) for a, b in find_runs(flags)]
