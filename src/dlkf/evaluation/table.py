"""Results as tables (terminal, markdown, CSV) and as ``metrics.json``.

Every kind of data has its own table. A dash is "no truth to compare with"; ∞ is a filter whose output was
not finite in at least one piece, never left out.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.table import Table as RichTable
from rich.text import Text

from dlkf.evaluation.bootstrap import MIN_GROUPS
from dlkf.evaluation.metrics import QUANTITIES

DASH = "–"
_WHICH = ("over", "part", "quantity", "statistic")


class Table(NamedTuple):
    """A titled table of text; the first column is the filter, a heading may hold a line break."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]


def number(x: float | str | None, scale: float = 1.0, digits: int = 3) -> str:
    """Three (or so many) significant digits, – for NaN, ∞ for inf; also of a value as ``metrics.json`` has it."""
    x = math.nan if x is None else float(x)
    if math.isnan(x):
        return DASH
    if math.isinf(x):
        return "∞" if x > 0 else "−∞"
    x = x * scale
    if x == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(float(f"{abs(x):.{digits - 1}e}"))))
    return f"{x:.{min(decimals, 6)}f}" if abs(x) < 1e5 else f"{x:.2e}"


def with_interval(c: Mapping[str, Any]) -> str:
    """Ratio with its confidence interval: ``0.71 [0.62–0.83]``, or ``0.71 (n<8)`` of too few recordings for one."""
    ratio, low, high = (number(c[key], digits=2) for key in ("ratio", "ratio_low", "ratio_high"))
    if c["groups"] < MIN_GROUPS:
        return ratio if ratio == DASH else f"{ratio} (n<{MIN_GROUPS})"
    return f"{ratio} [{low}–{high}]"


def comparison(result: Mapping[str, Any], name: str, **which: str) -> dict[str, Any] | None:
    """The row of ``comparisons`` with these ``over``, ``part``, ``quantity``, ``statistic``; None for the baseline."""
    rows = [c for c in result["comparisons"] if c["filter"] == name and which.items() <= c.items()]
    return rows[0] if rows else None


def tables(dataset: str, result: dict[str, Any]) -> list[Table]:
    """The tables of one kind of data: whole pieces, then outages if there are any."""
    n = result["count"]
    what = f"{dataset} ({result['kind']})"
    unit = "run" if n["repeated"] else "piece"
    settled = f"after {result['settle_s']:g} s"
    whole = Table(
        title=f"{what}: {_count(n['pieces'], unit)}, {_count(n['drives'], 'drive')}",
        note=f"RMS over each {unit}, then RMS over the {unit}s; median and 95 % over the {unit}s.",
        columns=[
            "Filter", "3D\n[m]", f"3D, {settled}\n[m]", f"Horiz., {settled}\n[m]", "median\n[m]", "95 %\n[m]",
            "Velocity\n[m/s]", "Attitude\n[°]", "Heading\n[°]",
        ],
        rows=[],
    )  # fmt: skip
    for name, f in result["filters"].items():
        p = f["pieces"]
        flat = p["horizontal"]["settled"]
        whole.rows.append(
            [name, number(p["position"]["all"]["rms"]), number(p["position"]["settled"]["rms"])]
            + [number(flat[s]) for s in ("rms", "median", "p95")]
            + [number(p["velocity"]["all"]["rms"])]
            + [number(p[q]["all"]["rms"], 180 / math.pi) for q in ("attitude", "heading")]
        )
    broken = [f["pieces"]["position"]["all"]["nonfinite"] for f in result["filters"].values()]
    if any(broken):
        whole.columns.append("Not\nfinite")
        for row, count in zip(whole.rows, broken):
            row.append(_count(count, unit))
    return [whole] if not n["outages"] else [whole, outage_table(what, result)]


def outage_table(what: str, result: dict[str, Any]) -> Table:
    """Errors at the end of the outages, at round times into them, before the fixes are back."""
    n, low, high = result["count"], *result["count"]["outage_s"]
    length = f"{low:g} s" if low == high else f"{low:g} to {high:g} s"
    first = next(iter(result["filters"].values()))
    at = [s for s in first["outages"]["at"] if float(s) < high][-3:]
    note = "Horizontal error at the end (RMS, median, 95 % over the outages), at times into it (RMS); "
    note += "velocity and attitude at the end (RMS); drift: horizontal error per distance driven (median)."
    table = Table(
        title=f"{what}: {_count(n['outages'], 'outage')} of {length}, {_count(n['outage_drives'], 'drive')}",
        note=note,
        columns=["Filter", "End, RMS\n[m]", "median\n[m]", "95 %\n[m]"]
        + [f"{s} s\n[m]" for s in at]
        + ["Velocity\n[m/s]", "Attitude\n[°]", "Drift\n[%]"],
        rows=[],
    )
    for name, f in result["filters"].items():
        o = f["outages"]
        row = [name] + [number(o["end"]["horizontal"][s]) for s in ("rms", "median", "p95")]
        row += [number(o["at"][s]["horizontal"]["rms"]) for s in at]
        row += [number(o["end"]["velocity"]["rms"]), number(o["end"]["attitude"]["rms"], 180 / math.pi)]
        row += [number(o["drift"]["median"], 100)]
        table.rows.append(row)
    return table


RATIOS = {
    "end of outages,\nRMS": ("outages", "end", "horizontal", "rms"),
    "end of outages,\ngeom. mean": ("outages", "end", "horizontal", "geomean"),
    "position,\nmean": ("pieces", "all", "position", "mean"),
    "velocity,\nmean": ("pieces", "all", "velocity", "mean"),
    "attitude,\nmean": ("pieces", "all", "attitude", "mean"),
}


def ratio_table(dataset: str, result: dict[str, Any]) -> Table | None:
    """Every filter against the baseline, with intervals; None where there is nothing to compare."""
    rows = result["comparisons"]
    heads = [head for head, (over, *_) in RATIOS.items() if any(c["over"] == over for c in rows)]
    if not rows:
        return None
    cells = []
    for name in dict.fromkeys(c["filter"] for c in rows):
        found = [comparison(result, name, **dict(zip(_WHICH, RATIOS[head]))) for head in heads]
        cells.append([name] + [DASH if c is None else with_interval(c) for c in found])
    return Table(
        title=f"{dataset} ({result['kind']}): ratio to {rows[0]['baseline']}, {_count(rows[0]['groups'], 'recording')}",
        note="Below 1: better than it. Of the horizontal error at the end of the outages: RMS, which the largest "
        "errors decide, and geometric mean, to which every outage counts alike. Of the pieces' RMS (3D): mean over the "
        "pieces, as in the paper. In brackets the 95 % interval by paired bootstrap over the recordings; "
        f"n<{MIN_GROUPS}: too few recordings for one.",
        columns=["Filter", *heads],
        rows=cells,
    )


def slope_table(dataset: str, result: dict[str, Any]) -> Table | None:
    """Slope of the IMU-error estimate against the true or the injected error; None where neither is known."""
    axes = [f"{sensor}\n{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    injected = any("injected_slope" in f["imu_error"] for f in result["filters"].values())
    key = "injected_slope" if injected else "slope"
    rows = [
        [n] + [number(s) for s in f["imu_error"].get(key, [math.nan] * 6)]
        for n, f in result["filters"].items()
    ]
    if all(cell == DASH for row in rows for cell in row[1:]):
        return None
    cause = "an injected bias" if injected else "the true error, over the pieces"
    return Table(
        title=f"{dataset} ({result['kind']}): does the filter estimate the IMU error?",
        note=f"Slope of the estimate at the end of a piece against {cause}: 1 = estimates it, 0 = memorised.",
        columns=["Filter", *axes],
        rows=rows,
    )


def as_rich(table: Table) -> RichTable:
    """For the terminal."""
    out = RichTable(title=Text(table.title), caption=Text(table.note), box=SIMPLE_HEAD, padding=(0, 1))
    out.title_justify, out.caption_justify, out.title_style = "left", "left", "bold"
    for i, column in enumerate(table.columns):
        out.add_column(Text(column), justify="right" if i else "left", vertical="bottom")
    for row in table.rows:
        out.add_row(*map(Text, row))  # Text: brackets are units, not markup
    return out


def as_markdown(table: Table) -> str:
    """A markdown table under its title."""
    head = "| " + " | ".join(c.replace("\n", " ") for c in table.columns) + " |"
    rule = "|" + "|".join([":--"] + ["--:"] * (len(table.columns) - 1)) + "|"
    rows = ["| " + " | ".join(row) + " |" for row in table.rows]
    return "\n".join([f"**{table.title}**", "", head, rule, *rows, "", table.note, ""])


def as_csv(dataset: str, results: Sequence[dict[str, Any]]) -> str:
    """Every summary, one value a line, with its unit."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["dataset", "kind", "filter", "over", "part", "quantity", "statistic", "value", "unit"])
    for r in results:
        for name, f in r["filters"].items():
            parts = [("pieces", phase, q, s) for q, by in f["pieces"].items() for phase, s in by.items()]
            if "outages" in f:
                o = f["outages"]
                parts += [("outages", part, q, s) for part in ("end", "rms") for q, s in o[part].items()]
                parts += [("outages", f"at {t} s", q, s) for t, by in o["at"].items() for q, s in by.items()]
                parts.append(("outages", "end", "drift", o["drift"]))
            for over, part, quantity, stats in parts:
                unit = QUANTITIES.get(quantity, "1")
                for statistic, value in stats.items():
                    u = "1" if statistic in ("n", "nonfinite") else unit
                    writer.writerow([dataset, r["kind"], name, over, part, quantity, statistic, value, u])
    return out.getvalue()


def plain(x: Any) -> Any:
    """The same value in strict JSON: NaN becomes null, infinities the strings "inf" and "-inf"."""
    if isinstance(x, dict):
        return {str(k): plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [plain(v) for v in x]
    if hasattr(x, "item"):
        x = x.item()
    if isinstance(x, float) and not math.isfinite(x):
        return None if math.isnan(x) else ("inf" if x > 0 else "-inf")
    return x


def as_json(content: dict[str, Any]) -> str:
    """The text of ``metrics.json``."""
    return json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")
