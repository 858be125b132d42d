"""Figures of plotly.js as plain values.

The Python package plotly checks every property of every trace, which takes longer than all that the figures show, and
seconds for a page of a dozen drives. Here a figure is a list of traces and a layout, as plotly.js reads them
(https://plotly.com/javascript/reference/); the tests have plotly check the figures of every page.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from dlkf.base.config import merge_settings

Trace = dict[str, Any]
TEMPLATE = "plotly_white"
MOST_DECADES = 5  # of a logarithmic axis with every power of ten
CONSTANT = 1e-6  # a narrower range than this share of its values has no ticks of its own
LEAST_TICKS, LINEAR_TICKS = 2, 4  # between the least and the largest value; of evenly spaced ones about


@dataclass
class Figure:
    """Traces and a layout; ``rows`` panels below each other have the axes ``x``, ``x2`` … and ``y``, ``y2`` …."""

    data: list[Trace] = field(default_factory=list)
    layout: dict[str, Any] = field(default_factory=dict)
    rows: int = 1

    def add_trace(self, trace: Trace, row: int = 1) -> None:
        """A trace in a panel."""
        if self.rows > 1:
            trace |= {"xaxis": f"x{_number(row)}", "yaxis": f"y{_number(row)}"}
        self.data.append(trace)

    def update_layout(self, **more: Any) -> None:
        """Set properties of the layout, those of nested ones each by itself."""
        self.layout = merge_settings(self.layout, more)

    def update_xaxis(self, row: int = 1, **more: Any) -> None:
        """Set properties of a panel's time axis."""
        self.update_layout(**{f"xaxis{_number(row)}": more})

    def update_yaxis(self, row: int = 1, **more: Any) -> None:
        """Set properties of a panel's value axis."""
        self.update_layout(**{f"yaxis{_number(row)}": more})

    def set_log_scale(self, row: int = 1) -> None:
        """A logarithmic value axis of the traces that the panel has, its numbers written out (10000, not 10k): powers
        of ten, of narrower data also 2 and 5 times these, of still narrower ones evenly spaced numbers."""
        axis = f"y{_number(row)}"
        y = [np.asarray(trace["y"], float) for trace in self.data if trace.get("yaxis", "y") == axis]
        values = np.concatenate(y) if y else np.empty(0)
        values = values[np.isfinite(values) & (values > 0)]
        low, high = (float(values.min()), float(values.max())) if values.size else (1.0, 10.0)
        ticks = _log_ticks(low, high)
        texts = [np.format_float_positional(v, trim="-") for v in ticks]
        self.update_yaxis(row, type="log", tickvals=ticks, ticktext=texts)

    def to_json(self) -> str:
        """As plotly.js reads it; arrays of floats are binary."""
        return json.dumps(
            {"data": self.data, "layout": self.layout}, default=_plain, allow_nan=False, separators=(",", ":")
        )


def panels(titles: Sequence[str], spacing: float) -> Figure:
    """Empty panels below each other, ``spacing`` of the height between them, with the time axis of the last."""
    rows = len(titles)
    height = (1.0 - spacing * (rows - 1)) / rows
    figure = Figure(rows=rows)
    titled = []
    for row, title in enumerate(titles, 1):
        low = (rows - row) * (height + spacing)
        top = min(low + height, 1.0)
        shared = {"matches": f"x{_number(rows)}", "showticklabels": False} if row < rows else {}
        figure.update_xaxis(row, anchor=f"y{_number(row)}", domain=[0.0, 1.0], **shared)
        figure.update_yaxis(row, anchor=f"x{_number(row)}", domain=[low, top])
        titled.append(
            {
                "text": title, "x": 0, "y": top, "xref": "paper", "yref": "paper", "xanchor": "left",
                "yanchor": "bottom", "showarrow": False, "font": {"size": 12},
            }
        )  # fmt: skip
    figure.update_layout(annotations=titled)
    return figure


@cache
def library() -> str:
    """plotly.js, as the package brings it."""
    return (_package() / "plotly.min.js").read_text(encoding="utf-8")


@cache
def template() -> str:
    """The look of all figures of a page, JSON."""
    return (_package() / "templates" / f"{TEMPLATE}.json").read_text(encoding="utf-8")


def _package() -> Path:
    """Where plotly's files lie; the package itself need not be imported."""
    spec = find_spec("plotly")
    assert spec is not None and spec.submodule_search_locations  # a dependency of this package
    return Path(spec.submodule_search_locations[0]) / "package_data"


def _number(row: int) -> str:
    """Of an axis: the first has none."""
    return str(row) if row > 1 else ""


def _log_ticks(low: float, high: float) -> list[float]:
    """Round numbers from below ``low`` to above ``high``."""
    first, last = math.log10(low), math.log10(high)
    every = 2 if last - first > MOST_DECADES else 1
    decades = range(every * (math.floor(first / every) - 1), math.ceil(last) + 2, every)
    for steps in ((1,), (1, 2, 5)):
        ticks = [float(f"{step}e{k}") for k in decades for step in steps]
        if sum(low <= tick <= high for tick in ticks) >= LEAST_TICKS:
            return ticks
    if high - low < CONSTANT * high:
        return ticks
    least = (high - low) / LINEAR_TICKS
    power = math.floor(math.log10(least))
    step = next(s for s in (1, 2, 5, 10) if s * 10.0**power >= least)
    count = [math.floor(low / step / 10.0**power) - 1, math.ceil(high / step / 10.0**power) + 2]
    return [float(f"{k * step}e{power}") for k in range(max(count[0], 1), count[1])]


def _plain(value: Any) -> Any:
    """What :mod:`json` does not know: arrays and numbers of numpy."""
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        raise TypeError(f"{type(value).__name__} in a figure")
    if value.dtype in (np.float32, np.float64):
        little = value.astype(f"<f{value.itemsize}", copy=False)
        return {"dtype": f"f{value.itemsize}", "bdata": base64.b64encode(little.tobytes()).decode()}
    return value.tolist()
