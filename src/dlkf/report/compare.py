"""One page over several evaluations: which of them drifts how far, from the ``metrics.json`` that each left."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dlkf.base.colours import filter_colour
from dlkf.base.errors import InputError
from dlkf.base.files import write_into
from dlkf.evaluation.results import Results
from dlkf.evaluation.summary import END, SETTLED, headline
from dlkf.evaluation.table import format_number
from dlkf.report.drawing import Figure
from dlkf.report.evaluation import mark_best
from dlkf.report.page import Page, flatten_settings
from dlkf.report.plots import line, stack_panels

TEST = ("digest", "reference", "mode", "runs", "seed", "length_s", "stride_s", "start", "outage")  # of the protocol
POINT, SETTING = re.compile(r"\d+-([\w.+]+=.*)"), re.compile(r",(?=[\w.+]+=)")  # of a sweep: folder, its settings
NOT_SETTINGS = ("command", "date", "digest", "skipped")  # differ always, or belong to no comparison


class StoredReport(NamedTuple):
    """An evaluation as it lies in a folder; ``name`` tells it from the others, ``path`` is the whole one."""

    name: str
    path: str
    dataset: str
    protocol: Mapping[str, Any]
    results: list[Results]
    warnings: Sequence[str] = ()  # of filters that are too sure of themselves


def read_reports(folders: Sequence[str | Path]) -> list[StoredReport]:
    """The evaluations in some folders, named by what tells the folders apart.

    Raises InputError for a folder without a readable ``metrics.json``, for one given twice, and for fewer than two.
    """
    if len(folders) < 2:
        raise InputError("give at least two folders that evaluate or train left, such as dlkf compare a b out=c")
    paths = [Path(f).expanduser() for f in folders]
    paths = [p / "report" if (p / "report" / "metrics.json").is_file() else p for p in paths]
    real = [p.resolve() for p in paths]
    if twice := next((p for k, p in enumerate(paths) if real[k] in real[:k]), None):
        raise InputError(f"{twice} is given twice; a run is compared with others")
    reports = []
    for path, name in zip(paths, shorten_names(paths)):
        try:
            content = json.loads((path / "metrics.json").read_text(encoding="utf-8"))
            results = [Results.of(r) for r in content["results"]]
            about = (content["dataset"], content["protocol"], results, content.get("warnings", []))
            reports.append(StoredReport(name, str(path.absolute()), *about))
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(f"{path}: no metrics.json; give folders that evaluate or train left") from None
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}/metrics.json: not an evaluation of this version ({error!r})") from None
    return reports


def shorten_names(paths: Sequence[Path]) -> list[str]:
    """The shortest tails that tell folders apart, without the ``report`` in which train leaves its evaluation; points
    of a sweep by their settings (``0-model=plus,aids=[]``: ``plus, aids=[]``)."""
    parts = [(p.parent if p.name == "report" else p).absolute().parts for p in paths]
    names = [Path(*p[-_count_needed(p, parts[:k] + parts[k + 1 :]) :]).as_posix() for k, p in enumerate(parts)]
    settings = [SETTING.split(found[1]) if (found := POINT.fullmatch(name)) else [name] for name in names]
    readable = [", ".join(part.removeprefix("model=") for part in of_point) for of_point in settings]
    return [better if readable.count(better) == 1 else name for name, better in zip(names, readable)]


def _count_needed(path: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> int:
    """How many last parts of ``path`` no other has."""
    return next((n for n in range(1, len(path)) if all(o[-n:] != path[-n:] for o in others)), len(path))


def write_comparison(out: str | Path, reports: Sequence[StoredReport]) -> None:
    """``compare.html`` in ``out``."""
    page = comparison_page(reports)
    with write_into(out) as folder:
        (folder / "compare.html").write_text(page, encoding="utf-8")


def comparison_page(reports: Sequence[StoredReport]) -> str:
    """Answers, a table and the growth of the error over all of them, and in what they differ."""
    page = Page(f"{len(reports)} evaluations compared", answers(reports), warnings=named_warnings(reports))
    whole = {r.name: r.path for r in reports}
    columns, rows = end_table(reports)
    about = "Horizontal error; RMS over the segments where there are no outages. Marked: the least median of a test. "
    about += "Own 1σ: what the filter says of its error (median); innovation / σ: expected 1, above it overconfident."
    page.heading("At the end of the outages", about)
    page.table(columns, rows, marks=mark_best_of_each(columns, rows, describe_tests(reports)), titles=whole)
    page.heading("Horizontal error against the time without GNSS", "Solid: median; dotted: 95 % of the outages.")
    page.figure("growth", growth_figure(reports))
    page.heading("In what they differ")
    page.table(*differences(reports), words=True, titles=whole)
    page.heading("Where they lie")
    page.table(["Run", "Folder"], list(whole.items()), words=True)
    return page.html()


def answers(reports: Sequence[StoredReport]) -> list[str]:
    """The sentence of each evaluation, behind its name."""
    return [f"{r.name}: {headline(result)}" for r in reports for result in r.results]


def named_warnings(reports: Sequence[StoredReport]) -> list[str]:
    """The lines on filters that are too sure of themselves, behind the evaluation's name."""
    return [f"{r.name}: {line}" for r in reports for line in r.warnings]


def end_table(reports: Sequence[StoredReport]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: run, data, filter, number, errors."""
    columns = ["Run", "Dataset", "Filter", "Number", "RMS\n[m]", "median\n[m]", "95 %\n[m]", "Drift\n[%]"]
    columns += ["Own 1σ\n[m]", "Innovation\n/ σ"]
    rows = []
    for report in reports:
        for result in report.results:
            out = result.count["outages"]
            where = END if out else SETTLED
            for name in result.filters:
                errors = [format_number(result.value(name, *where, s)) for s in ("rms", "median", "p95")]
                drift = format_number(result.value(name, "outages", "end", "drift", "median"), 100)
                data = f"{report.dataset} ({result.kind})"
                own = format_number(result.value(name, "outages", "end", "sigma", "median"))
                innovation = format_number(result.value(name, "segments", "with_gnss", "innovation"), digits=2)
                count = str(out or result.count["segments"])
                rows.append([report.name, data, name, count, *errors, drift, own, innovation])
    return columns, rows


def describe_tests(reports: Sequence[StoredReport]) -> list[str]:
    """What each row of :func:`end_table` was scored on: equal where data and rules are the same."""
    rules = [{key: report.protocol.get(key) for key in TEST} for report in reports]
    return [
        json.dumps([report.dataset, result.kind, rule], sort_keys=True, default=str)
        for report, rule in zip(reports, rules)
        for result in report.results
        for _ in result.filters
    ]


def mark_best_of_each(columns: Sequence[str], rows: Sequence[Sequence[str]], tests: Sequence[str]) -> list[str]:
    """:func:`dlkf.report.evaluation.mark_best` among the rows of each test that several share."""
    marks = [""] * len(rows)
    for test in dict.fromkeys(tests):
        same = [k for k, other in enumerate(tests) if other == test]
        for k, mark in zip(same, mark_best(columns, [rows[k] for k in same]) if len(same) > 1 else ()):
            marks[k] = mark
    return marks


def growth_figure(reports: Sequence[StoredReport]) -> Figure:
    """Errors at round times into the outages, a colour for every run and filter."""
    figure, k = stack_panels(["Horizontal error [m]"], height=390), 0
    for report in reports:
        for result in report.results:
            seconds = result.seconds_into_outage()
            for name in result.filters if seconds else ():
                label = f"{report.name}: {name}"
                for statistic, dash in (("median", "solid"), ("p95", "dot")):
                    y = [result.value(name, "outages", f"at {s} s", "horizontal", statistic) for s in seconds]
                    y = np.where(np.isfinite(y), y, np.nan)
                    trace = line(np.array(seconds, float), y, label, filter_colour(k), legend=statistic == "median")
                    trace["line"]["dash"] = dash
                    figure.add_trace(trace | {"mode": "lines+markers"})
                k += 1
    figure.update_xaxis(title={"text": "Time without GNSS [s]"})
    figure.set_log_scale()
    return figure


def differences(reports: Sequence[StoredReport]) -> tuple[list[str], list[list[str]]]:
    """Settings that are not the same in all reports."""
    values_of_all = []
    for report in reports:
        path: list[str] = []
        values = {}
        for depth, key, text in flatten_settings(report.protocol):
            path[depth:] = [key]
            values[".".join(path)] = text
        values_of_all.append(values | {"dataset": report.dataset})
    keys = [k for k in dict.fromkeys(k for t in values_of_all for k in t) if k.partition(".")[0] not in NOT_SETTINGS]
    keys = [k for k in keys if len({t.get(k) for t in values_of_all}) > 1]
    rows = [[key, *(t.get(key, "–") or "–" for t in values_of_all)] for key in keys]
    return ["Setting", *(r.name for r in reports)], rows or [["nothing but the day", *("" for _ in reports)]]
