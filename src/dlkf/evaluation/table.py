"""Results as tables (terminal, markdown, CSV) and as ``metrics.json``.

Every kind of data has its own table. A dash is "no truth to compare with"; ∞ is a filter whose output was
not finite in at least one segment, never left out.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable
from rich.text import Text

from dlkf.evaluation.bootstrap import MIN_GROUPS, Comparison
from dlkf.evaluation.results import IMU_AXES, LEAST_M, Results, Value

DASH = "–"
DEGREES = 180 / math.pi
# titles of panels and what a value is multiplied by
ERROR_PANELS = {
    "horizontal": ("Horizontal error [m]", 1.0),
    "velocity": ("Velocity error [m/s]", 1.0),
    "attitude": ("Attitude error [°]", DEGREES),
}
SENSORS = (("Accelerometer", "m/s²", 1.0), ("Gyroscope", "°/s", DEGREES))
IMU_PANELS = [(f"{name} {axis} error [{unit}]", scale) for name, unit, scale in SENSORS for axis in "xyz"]


class ResultTable(NamedTuple):
    """A titled table of text; the first column is the filter, a heading may hold a line break."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]


def format_number(x: float, scale: float = 1.0, digits: int = 3) -> str:
    """Three (or so many) significant digits, – for NaN, ∞ for inf."""
    if math.isnan(x):
        return DASH
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    x = x * scale
    if x == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(float(f"{abs(x):.{digits - 1}e}"))))
    return f"{x:.{min(decimals, 6)}f}" if abs(x) < 1e5 else f"{x:.2e}"


def format_length(low: float, high: float) -> str:
    """Of outages [s], the shortest and the longest."""
    return f"{low:g} s" if low == high else f"{low:g} to {high:g} s"


def format_ratios(*ratios: float) -> list[str]:
    """Ratios in two decimals, in three or four where one that is not 1 would read 1.00: each stands on its side of 1.

    Those below 0.1 and from 10 on in two and three significant digits.
    """
    near = [x for x in ratios if 0.1 <= x < 10 and x != 1]
    decimals = next((n for n in (2, 3) if not any(round(x, n) == 1 for x in near)), 4)
    return [f"{x:.{decimals}f}" if 0.1 <= x < 10 else format_number(x, digits=3 if x > 1 else 2) for x in ratios]


def format_interval(c: Comparison | None) -> str:
    """Ratio with its interval: ``0.71 [0.62–0.83]``, ``0.71 (n<8)`` of too few recordings; 1 of the baseline."""
    if c is None:
        return "1"
    ratio, low, high = format_ratios(c.ratio, c.ratio_low, c.ratio_high)
    if c.groups < MIN_GROUPS:
        return ratio if ratio == DASH else f"{ratio} (n<{MIN_GROUPS})"
    return f"{ratio} [{low}–{high}]"


def result_tables(dataset: str, result: Results) -> list[ResultTable]:
    """The tables of one kind of data: whole segments, then outages if there are any."""
    n = result.count
    what = f"{dataset} ({result.kind})"
    unit = "run" if n["repeated"] else "segment"
    settled = f"after {result.settle_s:g} s"
    whole = ResultTable(
        title=f"{what}: {_count(n['segments'], unit)}, {_count(n['drives'], 'drive')}",
        note=f"RMS over each {unit}, then RMS over the {unit}s; median and 95 % over the {unit}s."
        + (" A run has the outages of a drive at one of several offsets." if n["repeated"] else ""),
        columns=[
            "Filter", "3D\n[m]", f"3D, {settled}\n[m]", f"Horiz., {settled}\n[m]", "median\n[m]", "95 %\n[m]",
            "Velocity\n[m/s]", "Attitude\n[°]", "Heading\n[°]",
        ],
        rows=[],
    )  # fmt: skip
    for name in result.filters:
        of = partial(result.value, name, "segments")
        row = [name, format_number(of("all", "position")), format_number(of("settled", "position"))]
        row += [format_number(of("settled", "horizontal", s)) for s in ("rms", "median", "p95")]
        row += [
            format_number(of("all", "velocity")),
            *(format_number(of("all", q), DEGREES) for q in ("attitude", "heading")),
        ]
        whole.rows.append(row)
    broken = [int(result.value(n, "segments", "all", "position", "nonfinite")) for n in result.filters]
    if any(broken):
        whole.columns.append("Not\nfinite")
        for row, count in zip(whole.rows, broken):
            row.append(_count(count, unit))
    return [whole] if not n["outages"] else [whole, outage_table(what, result)]


def outage_table(what: str, result: Results) -> ResultTable:
    """Errors at the end of the outages and at round times into them."""
    n, length = result.count, format_length(*result.count["outage_s"])
    at = [s for s in result.seconds_into_outage() if float(s) < n["outage_s"][1]][-2:]
    driven = int(max(result.value(name, "outages", "end", "drift", "n") for name in result.filters))
    of_some = f" over the {_count(driven, 'outage')} of more than {LEAST_M:g} m" if driven < n["outages"] else ""
    table = ResultTable(
        title=f"{what}: {_count(n['outages'], 'outage')} of {length}, {_count(n['outage_drives'], 'drive')}",
        note="Horizontal error at the end (RMS, median, 95 % over the outages), at times into it (RMS); velocity and "
        f"attitude at the end (RMS); drift: horizontal error per distance driven (median{of_some}); own 1σ: what the "
        "filter says of its horizontal error at the end (median); innov. / σ: innovations over the 1σ that it expects "
        "(RMS).",
        columns=["Filter", "End, RMS\n[m]", "median\n[m]", "95 %\n[m]"]
        + [f"RMS\n{s} s\n[m]" for s in at]
        + ["Velocity\n[m/s]", "Attitude\n[°]", "Drift\n[%]", "Own 1σ\n[m]", "Innov.\n/ σ"],
        rows=[],
    )
    for name in result.filters:
        of = partial(result.value, name, "outages")
        row = [name] + [format_number(of("end", "horizontal", s)) for s in ("rms", "median", "p95")]
        row += [format_number(of(f"at {s} s", "horizontal")) for s in at]
        row += [format_number(of("end", "velocity")), format_number(of("end", "attitude"), DEGREES)]
        row += [format_number(of("end", "drift", "median"), 100), format_number(of("end", "sigma", "median"))]
        innovation = result.value(name, "segments", "with_gnss", "innovation")
        table.rows.append([*row, format_number(innovation, digits=2)])
    return table


RATIOS = {
    "end of outages,\nRMS": ("outages", "end", "horizontal", "rms"),
    "end of outages,\ngeom. mean": ("outages", "end", "horizontal", "geomean"),
    "position,\nmean": ("segments", "all", "position", "mean"),
    "velocity,\nmean": ("segments", "all", "velocity", "mean"),
    "attitude,\nmean": ("segments", "all", "attitude", "mean"),
}


def ratio_table(dataset: str, result: Results) -> ResultTable | None:
    """Every filter against the baseline, with intervals; None where there is nothing to compare."""
    names = [n for n in result.filters if n != result.baseline]
    heads = {h: which for h, which in RATIOS.items() if any(result.versus(n, *which) for n in names)}
    if not heads:
        return None
    groups = {h: max(c.groups for n in names if (c := result.versus(n, *which))) for h, which in heads.items()}
    alike = len(set(groups.values())) == 1
    counts = {h: _count(n, "recording") for h, n in groups.items()}
    return ResultTable(
        title=f"{dataset} ({result.kind}): ratio to {result.baseline}" + (f", {next(iter(counts.values()))}" * alike),
        note="Below 1: better than it. Of the horizontal error at the end of the outages: RMS, which the largest "
        "errors decide, and geometric mean, to which every outage counts alike. Of the segments' RMS (3D): mean over "
        "the segments, as in the paper. In brackets the 95 % interval by paired bootstrap over the recordings; "
        f"n<{MIN_GROUPS}: too few recordings for one.",
        columns=["Filter", *(h if alike else f"{h},\n{counts[h]}" for h in heads)],
        rows=[[n, *(format_interval(result.versus(n, *which)) for which in heads.values())] for n in names],
    )


def slope_table(dataset: str, result: Results) -> ResultTable | None:
    """Slope of the IMU-error estimate against the true or the injected error; None where neither is known."""
    injected = any(v.statistic == "injected_slope" for v in result.values)
    statistic = "injected_slope" if injected else "slope"
    rows = [
        [n, *(format_number(result.value(n, "segments", "last", axis, statistic)) for axis in IMU_AXES)]
        for n in result.filters
    ]
    if all(cell == DASH for row in rows for cell in row[1:]):
        return None
    cause = "an injected bias" if injected else "the true error, over the segments"
    return ResultTable(
        title=f"{dataset} ({result.kind}): does the filter estimate the IMU error?",
        note=f"Slope of the estimate at the end of a segment against {cause}: 1 = estimates it, 0 = memorised.",
        columns=["Filter", *(axis.replace("_", "\n") for axis in IMU_AXES)],
        rows=rows,
    )


def all_tables(dataset: str, results: Sequence[Results]) -> list[ResultTable]:
    """The tables of every kind of data, one kind after the other."""
    out = []
    for r in results:
        more = (ratio_table(dataset, r), slope_table(dataset, r))
        out += result_tables(dataset, r) + [t for t in more if t is not None]
    return out


def as_rich(table: ResultTable) -> RichTable:
    """For the terminal."""
    out = RichTable(title=Text(table.title), caption=Text(table.note), box=SIMPLE_HEAD, padding=(0, 1))
    out.title_justify, out.caption_justify, out.title_style = "left", "left", "bold"
    for i, column in enumerate(table.columns):
        side, wrap = ("right", "ellipsis") if i else ("left", "fold")
        out.add_column(Text(column), justify=side, overflow=wrap, vertical="bottom")
    for row in table.rows:
        out.add_row(*map(Text, row))  # Text: brackets are units, not markup
    return out


def as_markdown(table: ResultTable) -> str:
    """A markdown table under its title."""
    head = "| " + " | ".join(c.replace("\n", " ") for c in table.columns) + " |"
    rule = "|" + "|".join([":--"] + ["--:"] * (len(table.columns) - 1)) + "|"
    rows = ["| " + " | ".join(row) + " |" for row in table.rows]
    return "\n".join([f"**{table.title}**", "", head, rule, *rows, "", table.note, ""])


def as_csv(dataset: str, results: Sequence[Results]) -> str:
    """The tidy frame: every value a line, with its unit."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["dataset", *Value._fields])
    writer.writerows((dataset, *v) for r in results for v in r.values)
    return out.getvalue()


def plain_text(x: Any) -> Any:
    """The same value in strict JSON: NaN becomes null, infinities the strings "inf" and "-inf"."""
    if isinstance(x, dict):
        return {str(k): plain_text(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain_text(v) for v in x]
    if hasattr(x, "item"):
        x = x.item()
    if isinstance(x, float) and not math.isfinite(x):
        return None if math.isnan(x) else ("inf" if x > 0 else "-inf")
    return x


def as_json(content: dict[str, Any]) -> str:
    """The text of ``metrics.json``."""
    return json.dumps(plain_text(content), ensure_ascii=False, allow_nan=False) + "\n"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")
