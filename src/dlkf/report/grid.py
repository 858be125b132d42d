"""The page of a grid search: its points, the best by validation on top, and parallel coordinates of what was swept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from dlkf.evaluation.table import format_number
from dlkf.report.drawing import Figure
from dlkf.report.page import Page
from dlkf.report.plots import FONT

NAMES = ("run", "run_id", "status")


def grid_page(title: str, table: pd.DataFrame, chosen: pd.DataFrame, metric: str, rows: Sequence[Sequence[str]]) -> str:
    """``table`` has all points: name, swept settings, ``val/…``, ``test/…``; ``chosen`` the few columns to read, the
    best point first and ``metric`` of every filter, ``rows`` its cells.
    """
    validated = next((c for c in map(str, table) if c.startswith("val/")), None)
    page = Page(f"{len(table)} points of a grid search", [_best(chosen, validated)])
    page.heading(title)
    marks = ["class=best" if validated and not k else "" for k in range(len(rows))]
    page.table(list(map(str, chosen)), rows, marks=marks)
    settings = [c for c in map(str, table) if c not in NAMES and "/" not in c]
    scores = [f"test/{c}/{metric}" for c in map(str, chosen) if c not in NAMES and not c.startswith("val/")]
    seen = [c for c in (validated, *scores[:1]) if c is not None]
    known = table.dropna(subset=seen)
    if len(known) > 1 and settings and seen:
        page.heading("What was swept, and what came of it", "A line is a point. Drag along an axis to choose some.")
        page.figure("coordinates", coordinates(known, settings, seen))
    return page.html()


def _best(chosen: pd.DataFrame, validated: str | None) -> str:
    best = chosen.iloc[0]
    if validated is None or pd.isna(best[validated]):
        return "No point was validated."
    filters = [c for c in map(str, chosen) if c not in (*NAMES, validated)]
    on_test = f"; on test {filters[0]} {format_number(best[filters[0]])}" if filters else ""
    return f"Best by validation: {best['run']}, {validated} {format_number(best[validated])}{on_test}."


def coordinates(table: pd.DataFrame, settings: Sequence[str], scores: Sequence[str]) -> Figure:
    """Parallel coordinates: a setting that is no number has its words along the axis."""
    axes = [_axis(c.rpartition(".")[2], table[c]) for c in settings] + [_axis(c, table[c]) for c in scores]
    lines = {"color": table[scores[0]].to_numpy(float), "colorscale": "Viridis", "showscale": True}
    figure = Figure([{"type": "parcoords", "dimensions": axes, "line": lines}])
    figure.update_layout(height=480, font=FONT, margin={"l": 80, "r": 60, "t": 60, "b": 30})
    return figure


def _axis(label: str, values: pd.Series) -> dict[str, Any]:
    numbers = pd.to_numeric(values, errors="coerce")
    if not numbers.isna().any():
        few = sorted(set(numbers))
        ticks = {"tickvals": few, "ticktext": [f"{x:g}" for x in few]} if len(few) < 8 else {}
        return {"label": label, "values": numbers.to_numpy(float), **ticks}
    words = sorted(set(values.astype(str)))
    return {"label": label, "values": [words.index(v) for v in values.astype(str)],
            "tickvals": list(range(len(words))), "ticktext": words}  # fmt: skip
