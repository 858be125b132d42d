"""The page of ``navigate``: where the car went and the filter's own 1σ; no truth is needed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from dlkf.base.colours import COLOURS, QUALITY
from dlkf.data.masks import find_runs
from dlkf.data.schema import QUALITIES
from dlkf.filters.aids.estimates import format_estimate, label_estimate
from dlkf.report.drawing import Figure
from dlkf.report.maps import add_track, chart, dots, join_tracks
from dlkf.report.page import Page
from dlkf.report.plots import Array, band, every, line, shade, spans, stack_panels
from dlkf.running.grid import UsableFixes
from dlkf.running.innovations import SETTLE, Innovation
from dlkf.running.offline import Navigated

MOST_DRIVES = 12  # with plots of their own; all are on the map
SHOWN = ("t", "lat_deg", "lon_deg", "vel_n", "vel_e", "std_pos_n", "std_pos_e", "gnss_used")  # of all drives
FEW_NAMED = 3  # drives in a sentence
GAP_S = 3.0  # longer without a fix is an outage
STANDING = 0.15  # m/s
SHARE, SHOWS = "vibration_speed_share", 0.1  # a column of the solution, and from where on vibration shows a speed
R2D = 180 / np.pi
STEPS = tuple(m * 10.0**e for e in range(-3, 5) for m in (1, 2, 5))  # m, of a colour bar
WORDS = {"speed": "Wheel speed", "baro": "Barometer"}  # of sensors; of others their name
SIGNS = (
    "Innovation / σ is expected to be 1; where most updates are refused, see the unit, sign and clock of the sensor. "
    "Positive are a wheel that reads too much or comes late, fixes whose stamps are late, a receiver's clock that is "
    "fast against the IMU's. All hold at the end of the drive: with such a clock the delay grows."
)


class TrackOnMap(NamedTuple):
    """A drive for the page: its solution and the fixes it came from."""

    result: Navigated
    fixes: UsableFixes

    @property
    def without(self) -> Array:
        """Seconds since the last used fix at each row."""
        t, used = self.result.table["t"].to_numpy(), self.result.table["gnss_used"].to_numpy()
        last = np.maximum.accumulate(np.where(used, t, -np.inf))
        return np.where(np.isfinite(last), t - last, t - t[0])

    def for_the_map(self) -> TrackOnMap:
        """A fifth of it: what the map, the table and the answers show, without what plots of its own would."""
        innovation = self.result.innovation
        if innovation is not None:
            innovation = Innovation(innovation.ratio.astype(np.float32), np.ones((1, 1), np.float32))
        table = self.result.table[[*SHOWN, *self.result.sensor_columns]].copy()
        return self._replace(result=replace(self.result, table=table, innovation=innovation))


def navigation_page(
    model: str, dataset: str, courses: Sequence[TrackOnMap], made: Mapping[str, Any], warnings: Sequence[str] = ()
) -> str:
    """The page of some drives; the first dozen have plots of their own."""
    page = Page(f"{model} on {dataset}", summary_lines(model, courses), warnings=warnings)
    page.heading("Map", "Coloured by drive, time without GNSS, quality of the fixes, or the filter's own 1σ.")
    page.figure("map", route_map(courses))
    page.heading("Drives", "A row shows its drive on the map.")
    columns, rows, marks = make_rows(courses)
    page.table(columns, rows, marks=marks, tall=len(courses) > 15)
    page.note(
        "Innovation / σ: what GNSS says less what the filter expects, over the filter's own 1σ of it (RMS). 1 is "
        "right; above, the filter is overconfident: its noise is too small for this IMU and receiver."
    )
    columns, rows = sensor_rows([course.result for course in courses])
    if columns:
        page.heading("Sensors and receiver", "Updates that used a sensor; estimates ± 1σ at the end of the drive.")
        page.table(columns, rows, tall=len(courses) > 15)
        page.note(SIGNS)
    for k, course in enumerate(courses[:MOST_DRIVES]):
        _plots(page, k, course)
    if len(courses) > MOST_DRIVES:
        page.note(f"Plots of the first {MOST_DRIVES} of {len(courses)} drives; all are on the map and in the table.")
    page.protocol(made)
    return page.html()


def summary_lines(model: str, courses: Sequence[TrackOnMap]) -> list[str]:
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
        text += f" The filter's own horizontal 1σ: median {np.nanmedian(sigma):.2g} m, "
        text += f"maximum {np.nanmax(sigma):.2g} m."
    else:
        text += " This filter gives no 1σ."
    refused = [f"{c.result.refused} of {c.result.drive}" for c in courses if any(c.result.refused)]
    more = f" and of {len(refused) - FEW_NAMED} more drives" if len(refused) > FEW_NAMED else ""
    said = [f"Rejected as implausible: {', '.join(refused[:FEW_NAMED])}{more}."] if refused else []
    lost = [f"{times(len(c.result.restarts))} in {c.result.drive}" for c in courses if c.result.restarts]
    if lost:
        more = f" and in {len(lost) - FEW_NAMED} more drives" if len(lost) > FEW_NAMED else ""
        said.append(
            f"The filter was lost and started over {', '.join(lost[:FEW_NAMED])}{more}: positions, velocities and IMU "
            "contradict each other there."
        )
    return [lead, text, *vibration_lines(courses), *said]


def times(count: int) -> str:
    """1 → "once", 3 → "3 times"."""
    return "once" if count == 1 else f"{count} times"


def vibration_lines(courses: Sequence[TrackOnMap]) -> list[str]:
    """In which drives the vibration showed the speed; none where the filter does not look at it."""
    tables = [c.result.table for c in courses if SHARE in c.result.table]
    if not tables:
        return []
    shows = sum(float(t[SHARE].max()) > SHOWS for t in tables)
    used = sum(int(t["vibration_speed_used"].sum()) for t in tables)
    if not shows:
        return ["Speed from vibration: the spectrum of the IMU does not show it."]
    where = f" in {shows} of {len(tables)} drives" if len(tables) > 1 else ""
    outage = any((c.without > GAP_S).any() for c in courses)
    done = f"{used} measurements used" if used or outage else "not needed: no outage"
    return [f"Speed from vibration: the spectrum of the IMU shows it{where}; {done}."]


def duration(hours: float) -> str:
    """1.25 → "1 h 15 min"."""
    minutes = round(hours * 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{hours * 60:.3g} min"


def speed(course: TrackOnMap) -> Array:
    """Horizontal [m/s]."""
    return np.hypot(course.result.table["vel_n"].to_numpy(), course.result.table["vel_e"].to_numpy())


def distance(course: TrackOnMap) -> float:
    """Driven [m]."""
    t = course.result.table["t"].to_numpy()
    return float(np.sum(speed(course)[1:] * np.diff(t))) if len(t) > 1 else 0.0


def horizontal_std(course: TrackOnMap) -> Array:
    """√(σn² + σe²) [m]."""
    table = course.result.table
    return np.hypot(table["std_pos_n"].to_numpy(), table["std_pos_e"].to_numpy())


def _place(course: TrackOnMap) -> Array:
    return course.result.table[["lat_deg", "lon_deg"]].to_numpy()


def route_map(courses: Sequence[TrackOnMap]) -> Figure:
    """All drives on one map, in four ways of colouring."""
    traces, groups = [], []

    def add(trace: Any, group: str) -> None:
        traces.append(trace)
        groups.append(group)

    share = max(200, 12_000 // len(courses))
    for k, course in enumerate(courses):
        place = join_tracks([_place(course)], share)
        add(add_track(place, course.result.drive, COLOURS[k % len(COLOURS)], width=3), "drives")
    hidden = [np.where((c.without > GAP_S)[:, None], _place(c), np.nan) for c in courses]
    add(add_track(join_tracks([_place(c) for c in courses], 12_000), "with GNSS", "#0072B2", width=3), "outages")
    if any(np.isfinite(h).any() for h in hidden):
        runs = [[h[max(a - 1, 0) : b] for a, b in find_runs(np.isfinite(h[:, 0]))] for h in hidden]
        gaps = np.concatenate([join_tracks(parts, share) for parts in runs])
        add(add_track(gaps, f"over {GAP_S:g} s without a fix", "#D55E00", width=5), "outages")
    for code, colour in QUALITY.items():
        seen = [np.stack((c.fixes.lat_deg, c.fixes.lon_deg), -1)[c.fixes.quality == code] for c in courses]
        points = np.concatenate([s[every(len(s), share)] for s in seen])
        if len(points):
            add(dots(points, QUALITIES[code], colour, size=5), "fixes")
    index = [every(len(c.result.table), share) for c in courses]
    sigma = np.concatenate([horizontal_std(c)[i] for c, i in zip(courses, index)])
    if np.isfinite(sigma).any():
        place = np.concatenate([_place(c)[i] for c, i in zip(courses, index)])
        value = np.log10(np.maximum(np.nan_to_num(sigma, nan=1e-3), 1e-3))
        label = [f"{s:.2g} m" for s in sigma]
        ticks = {math.log10(x): f"{x:g}" for x in STEPS if value.min() - 0.1 < math.log10(x) < value.max() + 0.1}
        of_sigma = {"bar": "1σ [m]", "ticks": ticks, "text": label}
        add(dots(place, "horizontal 1σ", value.astype(np.float32), size=5, **of_sigma), "1σ")
    return chart(traces, {c.result.drive: _place(c) for c in courses}, groups)


def make_rows(courses: Sequence[TrackOnMap]) -> tuple[list[str], list[list[str]], list[str]]:
    """Columns, rows and marks of the table of drives."""
    columns = ["Drive", "Duration\n[s]", "Distance\n[km]", "Fixes\nused", "of", "Longest gap\n[s]", "Standing\n[s]"]
    columns += ["1σ, median\n[m]", "1σ, maximum\n[m]", "Innovation\n/ σ"]
    rows, marks = [], []
    for course in courses:
        table, sigma = course.result.table, horizontal_std(course)
        known = np.isfinite(sigma).any()
        step = float(np.median(np.diff(table["t"]))) if len(table) > 1 else 0.0
        innovation = course.result.innovation
        ratio = innovation.normalised_rms if innovation is not None else np.nan
        rows.append(
            [course.result.drive, f"{np.ptp(table['t']):.0f}", f"{distance(course) / 1000:.2f}"]
            + [str(int(table["gnss_used"].sum())), str(len(course.fixes.t)), f"{course.without.max():.3g}"]
            + [f"{(speed(course) < STANDING).sum() * step:.0f}"]
            + ([_two_digits(float(np.nanmedian(sigma))), _two_digits(float(np.nanmax(sigma)))] if known else ["–", "–"])
            + [_two_digits(ratio) if np.isfinite(ratio) else "–"]
        )
        place = _place(course)
        half = 60_000 * max(float(np.ptp(place[:, 0])), float(np.ptp(place[:, 1])), 1e-3)
        lat, lon = place.mean(0)
        marks.append(mark_outages("map", lat, lon, half))
    return columns, rows, marks


def sensor_rows(drives: Sequence[Navigated]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of the table of further sensors; no columns where no drive has an update of one or an estimate
    worth a word."""
    columns: dict[str, dict[str, str]] = {}  # heading → drive → cell
    for result in drives:
        for sensor, (used, seen, spread) in result.sensor_updates.items():
            if seen:
                words = WORDS.get(sensor) or sensor.replace("_", " ").capitalize()
                columns.setdefault(f"{words},\nupdates used", {})[result.drive] = f"{used} of {seen}"
                columns.setdefault(f"{words},\ninnovation / σ", {})[result.drive] = f"{spread:.2f}"
        for name in (name for name in result.sensors() if f"std_{name}" in result.table):
            last = result.table.iloc[-1]
            cell = format_estimate(name, float(last[name]), float(last[f"std_{name}"]))
            columns.setdefault(label_estimate(name), {})[result.drive] = cell
    rows = [[result.drive, *(cells.get(result.drive, "–") for cells in columns.values())] for result in drives]
    return ["Drive", *columns] if columns else [], rows


def _two_digits(value: float) -> str:
    return f"{value:#.2g}".rstrip(".")


def mark_outages(figure: str, lat: float, lon: float, half_m: float) -> str:
    """Attributes of a row that jumps to a place on a map."""
    return f'data-map="{figure}" data-lat="{lat:.7f}" data-lon="{lon:.7f}" data-half="{half_m:.0f}"'


def _plots(page: Page, k: int, course: TrackOnMap) -> None:
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


def _motion(course: TrackOnMap, t: Array, gaps: Sequence[tuple[float, float]]) -> Figure:
    table = course.result.table
    panels = ["Speed [m/s]; standstills in orange", "Heading [°]", "Height [m]", "Horizontal 1σ [m]"]
    figure = stack_panels(panels, height=150)
    v = speed(course)
    figure.add_trace(line(t, v, "speed", COLOURS[0], legend=False), 1)
    standing = np.where(v < STANDING, v, np.nan)
    if np.isfinite(standing).any():
        figure.add_trace(line(t, standing, "standing", COLOURS[1], legend=False, width=4), 1)
    heading = table["yaw"].to_numpy() * R2D % 360
    jump = np.abs(np.diff(heading, prepend=heading[0])) > 180
    figure.add_trace(line(t, np.where(jump, np.nan, heading), "heading", COLOURS[2], legend=False), 2)
    figure.add_trace(line(t, table["height_m"].to_numpy(), "height", COLOURS[3], legend=False), 3)
    figure.add_trace(line(t, horizontal_std(course), "1σ", COLOURS[5], legend=False), 4)
    figure.set_log_scale(4)
    figure.update_xaxis(4, title={"text": "Time [s]"})
    shade(figure, gaps, 4)
    return figure


def _innovations(course: TrackOnMap, t: Array, gaps: Sequence[tuple[float, float]]) -> Figure:
    innovation = course.result.innovation
    assert innovation is not None
    names = [f"Innovation {q} {a} [{u}], ±3σ" for q, u in (("position", "m"), ("velocity", "m/s")) for a in "NED"]
    known = [k for k in range(6) if k < 3 or np.isfinite(innovation.value[:, k]).any()]
    figure = stack_panels([names[k] for k in known], height=120)
    for row, k in enumerate(known, 1):
        seen = np.isfinite(innovation.value[:, k])
        if not seen.any():
            continue
        sigma = 3 * innovation.std[seen, k]
        if np.isfinite(sigma).any():
            figure.add_trace(band(t[seen], -sigma, sigma, "±3σ", COLOURS[5], legend=row == 1), row)
        y = innovation.value[seen, k]
        figure.add_trace(line(t[seen], y, "innovation", COLOURS[0], legend=row == 1, width=1), row)
        if len(y) > SETTLE:  # the wide start may leave the panel
            limit = 1.2 * float(np.nanmax(np.concatenate((np.abs(y[SETTLE:]), sigma[SETTLE:]))))
            figure.update_yaxis(row, range=[-limit, limit])
    figure.update_xaxis(len(known), title={"text": "Time [s]"})
    shade(figure, gaps, len(known))
    return figure


def _imu(course: TrackOnMap, t: Array, gaps: Sequence[tuple[float, float]]) -> Figure:
    table = course.result.table
    sensors = (("accel", "Accelerometer", "m/s²", 1.0), ("gyro", "Gyroscope", "°/s", R2D))
    axes = [(s, n, u, f, a) for s, n, u, f in sensors for a in "xyz"]
    figure = stack_panels([f"{n} {a} error [{u}], ±3σ" for _, n, u, _, a in axes], height=120)
    for k, (sensor, _, _, factor, a) in enumerate(axes):
        y = table[f"{sensor}_error_{a}"].to_numpy() * factor
        sigma = 3 * table[f"std_{sensor}_error_{a}"].to_numpy() * factor
        if np.isfinite(sigma).any():
            figure.add_trace(band(t, y - sigma, y + sigma, "±3σ", COLOURS[2], legend=k == 0), k + 1)
        figure.add_trace(line(t, y, "estimate", COLOURS[2], legend=k == 0), k + 1)
    figure.update_xaxis(6, title={"text": "Time [s]"})
    shade(figure, gaps, 6)
    return figure
