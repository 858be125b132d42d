"""Figures as plain values are those that plotly would have made, and lines are thinned without losing a peak."""

import base64
import json
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
import pytest
from plotly.subplots import make_subplots

from dlkf.data.masks import find_runs
from dlkf.report.drawing import Figure, library, panels, template
from dlkf.report.navigation import navigation_page
from dlkf.report.page import Page
from dlkf.report.plots import MOST, extremes
from tests.evaluation.drawn import figures_of
from tests.running.test_offline import driven


@pytest.mark.parametrize("rows", [2, 6])
def test_panels_lie_where_plotly_has_them(rows):
    titles = [f"panel {k}" for k in range(rows)]
    oracle = make_subplots(rows, 1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.06)
    oracle.update_annotations(font_size=12, xanchor="left", x=0)
    oracle.add_trace(go.Scatter(x=[1.0, 2.0], y=[1.0, 2.0]), rows, 1)
    figure = panels(titles, 0.06)
    figure.add_trace({"type": "scatter", "x": [1.0, 2.0], "y": [1.0, 2.0]}, rows)
    theirs, ours = json.loads(oracle.to_json()), json.loads(figure.to_json())
    del theirs["layout"]["template"]
    assert ours["data"] == theirs["data"] and sorted(ours["layout"]) == sorted(theirs["layout"])
    for k in range(1, rows + 1):
        for axis in (f"xaxis{k if k > 1 else ''}", f"yaxis{k if k > 1 else ''}"):
            a, b = ours["layout"][axis], theirs["layout"][axis]
            assert a.pop("domain") == pytest.approx(b.pop("domain")) and a == b
    for a, b in zip(ours["layout"]["annotations"], theirs["layout"]["annotations"], strict=True):
        assert a.pop("y") == pytest.approx(b.pop("y")) and a == b


def test_arrays_are_binary_as_plotly_writes_them():
    y = np.array([1.0, np.nan, -3.5])
    figure = Figure([{"type": "scatter", "x": y.astype(np.float32), "y": y, "text": np.arange(3), "opacity": y[0]}])
    theirs = json.loads(go.Figure(go.Scatter(x=y.astype(np.float32), y=y)).to_json())["data"][0]
    ours = json.loads(figure.to_json())["data"][0]
    assert (ours["x"], ours["y"]) == (theirs["x"], theirs["y"]) and ours["text"] == [0, 1, 2] and ours["opacity"] == 1
    assert np.frombuffer(base64.b64decode(ours["y"]["bdata"])).tolist()[::2] == [1.0, -3.5]
    with pytest.raises(ValueError, match="JSON"):
        Figure([{"x": [float("nan")]}]).to_json()
    with pytest.raises(TypeError, match="set in a figure"):
        Figure([{"x": {1.0}}]).to_json()


def test_nested_properties_are_set_each_by_itself():
    figure = Figure(layout={"legend": {"y": 1, "orientation": "h"}})
    figure.update_layout(legend={"y": 2}, height=100)
    figure.update_yaxis(type="log")
    figure.update_yaxis(title={"text": "m"})
    assert figure.layout["legend"] == {"y": 2, "orientation": "h"} and figure.layout["height"] == 100
    assert figure.layout["yaxis"] == {"type": "log", "title": {"text": "m"}}


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ((0.6, 4.0), ["0.5", "1", "2", "5"]),
        ((0.03, 40.0), ["0.01", "0.1", "1", "10", "100"]),
        ((0.02, 8000.0), ["0.01", "1", "100", "10000"]),
        ((0.12, 8.0), ["0.1", "0.2", "0.5", "1", "2", "5", "10"]),
        ((0.13, 0.34), ["0.1", "0.2", "0.3", "0.4"]),
        ((3.61, 4.09), ["3.4", "3.6", "3.8", "4", "4.2"]),
        ((2.0, 2.0), ["1", "2", "5"]),
        ((0.0, np.nan), ["1", "10"]),
    ],
)
def test_a_logarithmic_axis_has_round_numbers_in_full(values, shown):
    figure = panels(["one", "two"], 0.1)
    figure.add_trace({"type": "scatter", "x": [0.0, 1.0], "y": np.array(values)}, 2)
    figure.set_log_scale(2)
    axis = figure.layout["yaxis2"]
    assert [float(text) for text in axis["ticktext"]] == axis["tickvals"] and axis["type"] == "log"
    first = axis["ticktext"].index(shown[0])
    assert axis["ticktext"][first : first + len(shown)] == shown


def test_words_of_a_table_are_left_aligned_and_numbers_right():
    page = Page("town", [])
    page.table(["Run", "Filter", "Error", "Found"], [["a", "plus", "1.5", "–"], ["b", "–", "∞", "–"]])
    assert page.parts[0].count("class=text") == 3 and "<td class=text>plus</td><td>1.5</td>" in page.parts[0]


def test_a_page_of_drives_holds_figures_that_plotly_knows():
    page = navigation_page("plus", "town", [driven(seed) for seed in range(2)], {})
    figures = figures_of(page)
    assert list(figures) == ["map", *(f"{what}-{k}" for k in range(2) for what in ("motion", "innovations", "imu"))]
    assert len(figures["motion-0"].data) == 4 and len(figures["imu-1"].data) == 12
    assert library() in page and f"const TEMPLATE = {template()};" in page and "{{" not in page.replace(library(), "")


def test_runs_of_true():
    assert find_runs(np.array([True, False, True, True, False])) == [(0, 1), (2, 4)]
    assert find_runs(np.ones(4, bool)) == [(0, 4)] and find_runs(np.zeros(3, bool)) == []


def test_thinning_keeps_every_peak_and_every_gap():
    rng = np.random.default_rng(0)
    y = rng.normal(size=10 * MOST + 7)
    y[5000:5200] = np.nan
    y[777], y[-30] = 40.0, np.inf
    i = extremes(y)
    assert len(i) <= MOST + 2 and (np.diff(i) > 0).all() and i[0] == 0 and i[-1] == len(y) - 1
    edges = np.linspace(0, len(y), MOST // 2 + 1).astype(int)
    for a, b in pairwise(edges):
        inside, part = y[i[(i >= a) & (i < b)]], y[a:b][np.isfinite(y[a:b])]
        if len(part):
            assert part.min() in inside and part.max() in inside
        else:
            assert len(inside) == 1
    assert extremes(y[:MOST]).tolist() == list(range(MOST))
