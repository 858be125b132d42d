"""The page of ``navigate``: where the car went and what the filter believes of itself; no truth is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go

from dlkf.colours import COLOURS, QUALITY
from dlkf.report.maps import chart, dots, joined, track
from dlkf.report.page import Page
from dlkf.report.plots import Array, band, every, line, shade, spans, stacked
from dlkf.running.offline import Fixes, Innovation, Navigated

MOST_DRIVES = 12  # with plots of their own; all are on the map
SHOWN = ("t", "lat_deg", "lon_deg", "vel_n", "vel_e", "std_pos_n", "std_pos_e", "gnss_used")  # of all drives
GAP_S = 3.0  # longer without a fix is an outage
STANDING = 0.15  # m/s
R2D = 180 / np.pi


class Course(NamedTuple):
    """A drive for the page: its solution and the fixes it came from."""

    result: Navigated
    fixes: Fixes

    @property
    def without(self) -> Array:
        """Seconds since the last used fix at each row."""
        t, used = self.result.table["t"].to_numpy(), self.result.table["gnss_used"].to_numpy()
        last = np.maximum.accumulate(np.where(used, t, -np.inf))
        return np.where(np.isfinite(last), t - last, t - t[0])

    def for_the_map(self) -> Course:
        """A fifth of it: what the map, the table and the answers show, without what plots of its own would."""
        innovation = self.result.innovation
        if innovation is not None:  # one whose RMS is that of all
            innovation = Innovation(np.array([[innovation.normalised_rms]]), np.ones((1, 1)))
        return self._replace(
            result=replace(self.result, table=self.result.table[list(SHOWN)].copy(), innovation=innovation)
        )


def write_page(out: Path, model: str, dataset: str, courses: Sequence[Course], made: Mapping[str, Any]) -> None:
    """``report.html`` in ``out``."""
    (out / "report.html").write_text(navigation_page(model, dataset, courses, made), encoding="utf-8")


def navigation_page(model: str, dataset: str, courses: Sequence[Course], made: Mapping[str, Any]) -> str:
    """The page of some drives; the first dozen have plots of their own."""
    page = Page(f"{model} on {dataset}", answers(model, courses))
    page.heading("Map", "Coloured by drive, time without GNSS, quality of the fixes, or the filter's own 1σ.")
    page.figure("map", route(courses))
    page.heading("Drives", "A row shows its drive on the map.")
    columns, rows, marks = rows_of(courses)
    page.table(columns, rows, marks=marks, tall=len(courses) > 15)
    page.note(
        "Innovation / σ: what GNSS says less what the filter expects, over the filter's own 1σ of it (RMS). 1 is "
        "right; above, the filter is surer than it should be: its noise is too small for this IMU and receiver."
    )
    for k, course in enumerate(courses[:MOST_DRIVES]):
        _plots(page, k, course)
    if len(courses) > MOST_DRIVES:
        page.note(f"Plots of the first {MOST_DRIVES} of {len(courses)} drives; all are on the map and in the table.")
    page.protocol(made)
    return page.html()


def answers(model: str, courses: Sequence[Course]) -> list[str]:
    """What a person wants to know first: how much was driven, how much of it with GNSS, and how sure the filter is."""
    hours = sum(float(np.ptp(c.result.table["t"])) for c in courses) / 3600
    km = sum(distance(c) for c in courses) / 1000
    longest = max(courses, key=lambda c: c.without.max())
    sigma = np.concatenate([horizontal_std(c) for c in courses])
    lead = f"{len(courses)} drive{'s' if len(courses) != 1 else ''}, {duration(hours)}, {km:.3g} km with {model}."
    text = "A fix in every epoch."
    if longest.without.max() > 0:
        text = f"Longest time without a fix: {longest.without.max():.3g} s"
        text += f" ({longest.result.drive})." if len(courses) > 1 else "."
    if np.isfinite(sigma).any():
        text += f" The filter's own horizontal 1σ: {np.nanmedian(sigma):.2g} m in half of the time, "
        text += f"{np.nanmax(sigma):.2g} m at worst."
    else:
        text += " This filter does not tell its own 1σ."
    return [lead, text]


def duration(hours: float) -> str:
    """1.25 → "1 h 15 min"."""
    minutes = round(hours * 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{hours * 60:.3g} min"


def speed(course: Course) -> Array:
    """Horizontal [m/s]."""
    return np.hypot(course.result.table["vel_n"].to_numpy(), course.result.table["vel_e"].to_numpy())


def distance(course: Course) -> float:
    """Driven [m]."""
    t = course.result.table["t"].to_numpy()
    return float(np.sum(speed(course)[1:] * np.diff(t))) if len(t) > 1 else 0.0


def horizontal_std(course: Course) -> Array:
    """√(σn² + σe²) [m]."""
    table = course.result.table
    return np.hypot(table["std_pos_n"].to_numpy(), table["std_pos_e"].to_numpy())


def _place(course: Course) -> Array:
    return course.result.table[["lat_deg", "lon_deg"]].to_numpy()


def route(courses: Sequence[Course]) -> go.Figure:
    """All drives on one map, in four ways of colouring."""
    traces, groups = [], []

    def add(trace: Any, group: str) -> None:
        traces.append(trace)
        groups.append(group)

    share = max(200, 12_000 // len(courses))
    for k, course in enumerate(courses):
        place = joined([_place(course)], share)
        add(track(place, course.result.drive, COLOURS[k % len(COLOURS)], width=3), "drives")
    hidden = [np.where((c.without > GAP_S)[:, None], _place(c), np.nan) for c in courses]
    add(track(joined([_place(c) for c in courses], 12_000), "with GNSS", "#0072B2", width=3), "outages")
    if any(np.isfinite(h).any() for h in hidden):
        gaps = np.concatenate([_with_breaks(h, share) for h in hidden])
        add(track(gaps, f"over {GAP_S:g} s without a fix", "#D55E00", width=5), "outages")
    for code, (name, colour) in QUALITY.items():
        seen = [np.stack((c.fixes.lat_deg, c.fixes.lon_deg), -1)[c.fixes.quality == code] for c in courses]
        points = np.concatenate([s[every(len(s), share)] for s in seen])
        if len(points):
            add(dots(points, name, colour, size=5), "fixes")
    index = [every(len(c.result.table), share) for c in courses]
    sigma = np.concatenate([horizontal_std(c)[i] for c, i in zip(courses, index)])
    if np.isfinite(sigma).any():
        place = np.concatenate([_place(c)[i] for c, i in zip(courses, index)])
        value = np.log10(np.maximum(np.nan_to_num(sigma, nan=1e-3), 1e-3))
        label = [f"{s:.2g} m" for s in sigma]
        add(dots(place, "horizontal 1σ", value.astype(np.float32), size=5, bar="log₁₀ 1σ [m]", text=label), "1σ")
    return chart(traces, groups)


def _with_breaks(place: Array, most: int) -> Array:
    """Runs of known positions, thinned each, with a NaN after each."""
    known = np.isfinite(place[:, 0])
    edge = np.flatnonzero(np.diff(np.concatenate(([0], known.astype(np.int8), [0]))))
    return joined([place[max(a - 1, 0) : b] for a, b in zip(edge[::2], edge[1::2])], most)


def rows_of(courses: Sequence[Course]) -> tuple[list[str], list[list[str]], list[str]]:
    """Columns, rows and marks of the table of drives."""
    columns = ["Drive", "Duration\n[s]", "Distance\n[km]", "Fixes\nused", "of", "Longest gap\n[s]", "Standing\n[s]"]
    columns += ["1σ, median\n[m]", "1σ, worst\n[m]", "Innovation\n/ σ"]
    rows, marks = [], []
    for course in courses:
        table, sigma = course.result.table, horizontal_std(course)
        known = np.isfinite(sigma).any()
        step = float(np.median(np.diff(table["t"]))) if len(table) > 1 else 0.0
        innovation = course.result.innovation
        ratio = innovation.normalised_rms if innovation is not None else np.nan
        offered = course.fixes.between(course.result.aligned_at, float(table["t"].iloc[-1]))
        rows.append(
            [course.result.drive, f"{np.ptp(table['t']):.0f}", f"{distance(course) / 1000:.2f}"]
            + [str(int(table["gnss_used"].sum())), str(offered), f"{course.without.max():.3g}"]
            + [f"{(speed(course) < STANDING).sum() * step:.0f}"]
            + ([f"{np.nanmedian(sigma):.2g}", f"{np.nanmax(sigma):.2g}"] if known else ["–", "–"])
            + [f"{ratio:.2g}" if np.isfinite(ratio) else "–"]
        )
        place = _place(course)
        half = 60_000 * max(float(np.ptp(place[:, 0])), float(np.ptp(place[:, 1])), 1e-3)
        lat, lon = place.mean(0)
        marks.append(mark("map", lat, lon, half))
    return columns, rows, marks


def mark(figure: str, lat: float, lon: float, half_m: float) -> str:
    """Attributes of a row that jumps to a place on a map."""
    return f'data-map="{figure}" data-lat="{lat:.7f}" data-lon="{lon:.7f}" data-half="{half_m:.0f}"'


def _plots(page: Page, k: int, course: Course) -> None:
    table = course.result.table
    t = table["t"].to_numpy() - table["t"].iloc[0]
    gaps = spans(t, course.without > GAP_S)
    since = f"Time since t = {table['t'].iloc[0]:.1f} s; grey: over {GAP_S:g} s without a fix."
    page.heading(course.result.drive, since)
    sections = [("motion", _motion(course, t, gaps))]
    if course.result.innovation is not None and np.isfinite(course.result.innovation.value).any():
        sections.append(("innovations", _innovations(course, t, gaps)))
    imu = table[[f"{s}_error_{a}" for s in ("accel", "gyro") for a in "xyz"]].to_numpy()
    if np.isfinite(imu).any() and imu.any():
        sections.append(("imu", _imu(course, t, gaps)))
    for name, figure in sections:
        page.figure(f"{name}-{k}", figure)


def _motion(course: Course, t: Array, gaps: Sequence[tuple[float, float]]) -> go.Figure:
    table = course.result.table
    panels = ["Speed [m/s]; standstills in orange", "Heading [°]", "Height [m]", "Horizontal 1σ [m]"]
    figure = stacked(panels, height=150)
    v = speed(course)
    figure.add_trace(line(t, v, "speed", COLOURS[0], legend=False), 1, 1)
    standing = np.where(v < STANDING, v, np.nan)
    if np.isfinite(standing).any():
        figure.add_trace(line(t, standing, "standing", COLOURS[1], legend=False, width=4), 1, 1)
    heading = table["yaw"].to_numpy() * R2D % 360
    jump = np.abs(np.diff(heading, prepend=heading[0])) > 180
    figure.add_trace(line(t, np.where(jump, np.nan, heading), "heading", COLOURS[2], legend=False), 2, 1)
    figure.add_trace(line(t, table["height_m"].to_numpy(), "height", COLOURS[3], legend=False), 3, 1)
    figure.add_trace(line(t, horizontal_std(course), "1σ", COLOURS[5], legend=False), 4, 1)
    figure.update_yaxes(type="log", row=4, col=1)
    figure.update_xaxes(title_text="Time [s]", row=4, col=1)
    shade(figure, gaps, 4)
    return figure


def _innovations(course: Course, t: Array, gaps: Sequence[tuple[float, float]]) -> go.Figure:
    innovation = course.result.innovation
    assert innovation is not None
    names = [f"Innovation {q} {a} [{u}], ±3σ" for q, u in (("position", "m"), ("velocity", "m/s")) for a in "NED"]
    figure = stacked(names, height=120)
    for k in range(6):
        seen = np.isfinite(innovation.value[:, k])
        if not seen.any():
            continue
        sigma = 3 * innovation.std[seen, k]
        if np.isfinite(sigma).any():
            figure.add_trace(band(t[seen], -sigma, sigma, "±3σ", COLOURS[5], legend=k == 0), k + 1, 1)
        y = innovation.value[seen, k]
        figure.add_trace(line(t[seen], y, "innovation", COLOURS[0], legend=k == 0, width=1), k + 1, 1)
    figure.update_xaxes(title_text="Time [s]", row=6, col=1)
    shade(figure, gaps, 6)
    return figure


def _imu(course: Course, t: Array, gaps: Sequence[tuple[float, float]]) -> go.Figure:
    table = course.result.table
    sensors = (("accel", "Accelerometer", "m/s²", 1.0), ("gyro", "Gyroscope", "°/s", R2D))
    axes = [(s, n, u, f, a) for s, n, u, f in sensors for a in "xyz"]
    figure = stacked([f"{n} {a} error [{u}], ±3σ" for _, n, u, _, a in axes], height=120)
    for k, (sensor, _, _, factor, a) in enumerate(axes):
        y = table[f"{sensor}_error_{a}"].to_numpy() * factor
        sigma = 3 * table[f"std_{sensor}_error_{a}"].to_numpy() * factor
        if np.isfinite(sigma).any():
            figure.add_trace(band(t, y - sigma, y + sigma, "±3σ", COLOURS[2], legend=k == 0), k + 1, 1)
        figure.add_trace(line(t, y, "estimate", COLOURS[2], legend=k == 0), k + 1, 1)
    figure.update_xaxes(title_text="Time [s]", row=6, col=1)
    shade(figure, gaps, 6)
    return figure
