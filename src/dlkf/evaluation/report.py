"""Everything an evaluation leaves behind: metrics.json, table.md, table.csv, figures/*.png, report.html."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dlkf.evaluation import figures
from dlkf.evaluation.results import Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.table import Table, as_csv, as_json, as_markdown, ratio_table, slope_table, tables
from dlkf.files import staged

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; }
body { max-width: 1080px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
table { border-collapse: collapse; margin: .6em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .7em; border-bottom: 1px solid #ddd; text-align: right; }
th { border-bottom: 2px solid #888; font-weight: 600; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; } .note { color: #555; font-size: .9em; }
dt { font-weight: 600; } .scroll { overflow-x: auto; }
"""


def png(figure: Figure, dpi: int = 130) -> bytes:
    """A figure as PNG."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, facecolor="white")
    return out.getvalue()


def all_tables(dataset: str, results: Sequence[Results]) -> list[Table]:
    """The tables of every kind of data, one kind after the other."""
    out = []
    for r in results:
        more = (ratio_table(dataset, r), slope_table(dataset, r))
        out += tables(dataset, r) + [t for t in more if t is not None]
    return out


def all_figures(
    scores: Scores, *, by_time: bool, baseline: str | None = None
) -> Iterator[tuple[str, str, Figure]]:
    """(file name, caption, figure) of one kind of data.

    ``by_time``: the pieces are alike (same length, outage at the same time), so that an average over them at
    each time means something; whole drives are shown one by one instead.
    """
    chosen = figures.representative(scores, 4, baseline if baseline in scores.filters else None)
    if not chosen:
        return
    middle = chosen[len(chosen) // 2]
    if scores.outage.any():
        yield "error_growth", "horizontal error against the time without GNSS", figures.error_growth(scores)
    yield (
        "tracks",
        "tracks of pieces from good to bad (quantiles of the error of the baseline)",
        figures.tracks(scores, chosen),
    )
    if by_time and len(scores.pieces) > 1:
        yield "error_over_time", "errors over time, all pieces", figures.error_over_time(scores)
    yield "error_over_time_one", "errors over time, one piece", figures.error_over_time(scores, [middle])
    yield "imu_errors", "IMU-error estimates, one piece", figures.imu_errors(scores, [middle])


def write_report(
    out: str | Path,
    dataset: str,
    scores: Scores,
    results: Sequence[Results],
    *,
    protocol: dict[str, Any],
    by_time: bool,
    baseline: str | None = None,
    more: Sequence[Table] = (),
    dpi: int = 130,
) -> list[Path]:
    """Write the whole report into ``out``, all files or none; returns their paths.

    ``results`` has one entry per kind of data (of scores.of_kind); ``protocol`` is how the
    scores were made, in plain values; ``more`` tables follow those of the results. Raises InputError if
    ``out`` cannot be written to.
    """
    parts = [*all_tables(dataset, results), *more]
    pictures: list[tuple[str, str, bytes]] = []
    for kind in scores.kinds:
        suffix = "" if len(scores.kinds) == 1 else f"_{kind}"
        for name, caption, figure in all_figures(scores.of_kind(kind), by_time=by_time, baseline=baseline):
            pictures.append((f"{name}{suffix}.png", f"{kind.capitalize()} data: {caption}", png(figure, dpi)))
    files: dict[str, bytes] = {
        "metrics.json": as_json(
            {"dataset": dataset, "protocol": protocol, "results": [r.as_dict() for r in results]}
        ).encode(),
        "table.md": "\n".join(map(as_markdown, parts)).encode(),
        "table.csv": as_csv(dataset, results).encode(),
        "report.html": report_html(f"Evaluation on {dataset}", parts, pictures, protocol).encode(),
        **{f"figures/{name}": data for name, _, data in pictures},
    }
    with staged(out) as folder:
        (folder / "figures").mkdir()
        for name, data in files.items():
            (folder / name).write_bytes(data)
    return [Path(out) / name for name in files]


def _heading(text: str) -> str:
    return html.escape(text).replace("\n", "<br>")


def report_html(
    title: str, parts: Sequence[Table], pictures: Sequence[tuple[str, str, bytes]], protocol: dict[str, Any]
) -> str:
    """One self-contained page: tables, figures (PNG inside), and how the numbers were made."""
    body = [f"<h1>{html.escape(title)}</h1>"]
    for t in parts:
        head = "".join(f"<th>{_heading(c)}</th>" for c in t.columns)
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in t.rows
        )
        body.append(
            f"<h2>{html.escape(t.title)}</h2><div class=scroll><table><tr>{head}</tr>{rows}</table></div>"
            f"<p class=note>{html.escape(t.note)}</p>"
        )
    for name, caption, data in pictures:
        source = base64.b64encode(data).decode()
        alt = html.escape(name.removesuffix(".png").replace("_", " "))
        body.append(f'<h2>{html.escape(caption)}</h2><img alt="{alt}" src="data:image/png;base64,{source}">')
    settings = "".join(
        f"<dt>{html.escape(str(k))}</dt><dd>{html.escape(str(v))}</dd>" for k, v in protocol.items()
    )
    body.append(f"<h2>Protocol</h2><dl>{settings}</dl>")
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>\n"
    )
