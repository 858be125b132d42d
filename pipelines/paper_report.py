"""Every table and figure of the paper that can be had, in its order, the published number beside ours: one HTML page.

    python pipelines/paper_report.py                 outputs/paper/report.html
    python pipelines/paper_report.py --home outputs/paper --quick     with the short trainings of section 5.3

reads what ``paper_imu_error.py``, ``paper_kalman_gain.py``, ``paper_outage.py``, ``paper_figures.py`` and
``paper_ablations.py`` left; what has not been run is named with its command. The paper's IMU, roads and receivers are
not ours: compare ratios and orderings, not metres.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dlkf.evaluation.results import Results
from dlkf.evaluation.table import number, with_interval
from dlkf.files import staged
from dlkf.report.page import Page, embedded

TERMS = {"position": "P", "velocity": "V", "attitude": "A"}
SECTION_51 = {"dlkf": ("0.45 m", "0.02 m/s", "0.07 rad"), "mbkf15": ("0.49 m", "0.04 m/s", "0.27 rad")}  # R122
SECTION_53 = {"dlkf": ("0.63 m", "0.13 m/s", "0.17 rad"), "mbkf15": ("1.43 m", "0.23 m/s", "0.23 rad")}  # R141
UNITS = ("m", "m/s", "rad")


def main() -> int:
    """Collect, write, say where."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--home", type=Path, default=Path("outputs/paper"))
    arguments.add_argument("--quick", action="store_true", help="section 5.3 from paper_outage.py --quick")
    options = arguments.parse_args()
    home: Path = options.home
    page = Page("The paper, reproduced", [])
    page.note(
        "Li et al., NAVIGATION 73 (2026). Its tables 1-4 and the numbers in its figures are lost; what stands in their "
        "place is ours (docs/paper.md)."
    )
    summary = [
        section(page, "5.1 IMU errors", home / "imu_error", "paper_imu_error.py", SECTION_51, ("imu_errors",)),
        gains(page, home / "kalman_gain"),
        section(
            page, "5.3 Outages of 30 to 50 s", home / ("outage_quick" if options.quick else "outage"),
            "paper_outage.py", SECTION_53, ("tracks", "error_over_time", "error_growth"),
        ),
        section(
            page, "5.3 Real motion (figures 11, 12)", home / "figures", "paper_figures.py --real <dataset>", {},
            ("imu_errors", "tracks"), only="semi_real",
        ),
        section(
            page, "5.3 A minute without GNSS (figures 13, 14)", home / "figures", "paper_figures.py", {},
            ("error_over_time", "error_histograms"), only="minute",
        ),
        ablations(page, home / "ablations"),
    ]  # fmt: skip
    page.answer = summary
    page.heading("Not reproduced", "and why")
    page.table(
        ["what", "why"],
        [
            ["Table 2, figure 5", "the authors' vehicle and sensors"],
            ["Tables 1, 3, 4", "their numbers are lost: conf/train.yaml, conf/imu/table3_standin.yaml, conf/noise"],
            ["Figures 11 to 14 as measured", "eleven hours on the authors' car; ours are simulated or semi-real"],
        ],
    )
    with staged(home) as folder:
        (folder / "report.html").write_text(page.html(), encoding="utf-8")
    print("\n".join(summary), f"Report: {home / 'report.html'}", sep="\n")
    return 0


def trainings(folder: Path) -> dict[str, Path]:
    """Report folders of a study's trainings by key; empty where it was not run."""
    file = folder / "trainings.json"
    if not file.is_file():
        return {}
    return {k: Path(v) / "report" for k, v in json.loads(file.read_text()).items() if "/" in k}


def results_of(report: Path) -> Results:
    """The results of a report's one kind of data."""
    (content,) = json.loads((report / "metrics.json").read_text())["results"]
    return Results.of(content)


def section(
    page: Page,
    title: str,
    folder: Path,
    command: str,
    published: dict[str, tuple[str, ...]],
    figures: tuple[str, ...],
    only: str = "",
) -> str:
    """Means over the pieces of the RMS of each (the paper's measure), every training; its pictures; one sentence."""
    page.heading(title)
    runs = {k: v for k, v in trainings(folder).items() if k.startswith(only)}
    if not runs:
        page.note(f"Not run yet: python pipelines/{command}")
        return f"{title}: not run yet (python pipelines/{command})."
    rows, ratios = [], []
    for name, three in published.items():
        rows.append(["published", name, *(cell for value in three for cell in (value, ""))])
    for key, report in runs.items():
        result = results_of(report)
        for name in result.filters:
            cells = [key, name]
            for q, unit in zip(TERMS, UNITS):
                value = result.value(name, "pieces", "all", q, "mean")
                cells += [f"{number(value)} {unit}", with_interval(result.versus(name, "pieces", "all", q, "mean"))]
            rows.append(cells)
        against = [result.versus("dlkf", "pieces", "all", q, "mean") for q in TERMS]
        ratios.append(f"{key}: " + " / ".join(number(c.ratio, digits=2) if c else "-" for c in against))
        end = result.versus("dlkf", "outages", "end", "horizontal")
        if only and end:
            ratios[-1] += f", horizontal RMS at the end of the outages {with_interval(end)}"
    heads = [cell for t in TERMS.values() for cell in (t, f"{t}: ratio to {result.baseline}")]
    page.table(["training", "filter", *heads], rows)
    first = next(iter(runs.values()))
    for name in figures:
        if (first / "figures" / f"{name}.png").is_file():
            picture = (first / "figures" / f"{name}.png").read_bytes()
            page.picture(f"{title}: {name.replace('_', ' ')} ({next(iter(runs))})", embedded(picture))
    return f"{title}: mean P / V / A of dlkf over {result.baseline}: {'; '.join(ratios)}."


def ablations(page: Page, folder: Path) -> str:
    """What each part is worth."""
    page.heading("Ablations (R050, R052, R063)", "One change at a time, the quick profile.")
    if not (folder / "ablations.md").is_file():
        page.note("Not run yet: python pipelines/paper_ablations.py")
        return "Ablations: not run yet (python pipelines/paper_ablations.py)."
    head, _, *rows = [split(line) for line in (folder / "ablations.md").read_text().splitlines()]
    page.table(head, rows)
    return f"Ablations: {len(rows) - 1} trainings."


def gains(page: Page, folder: Path) -> str:
    """Figures 7-9, tables 4 and 5, and the trends."""
    page.heading("5.2 Gains")
    if not (folder / "trends.md").is_file():
        page.note("Not run yet: python pipelines/paper_kalman_gain.py")
        return "5.2 Gains: not run yet (python pipelines/paper_kalman_gain.py)."
    for name, title in (("table4", "Added noise"), ("table5", "Means over the pieces"), ("trends", "Trends")):
        head, _, *rows = [split(line) for line in (folder / f"{name}.md").read_text().splitlines()]
        page.heading(title)
        page.table(head, rows)
    for n in (7, 8, 9):
        if (folder / f"figure{n}.png").is_file():
            page.picture(f"Figure {n}", embedded((folder / f"figure{n}.png").read_bytes()))
    text = (folder / "trends.md").read_text()
    return f"5.2 Gains: {text.count('| yes |')} of {text.count('| yes |') + text.count('| no |')} trends hold."


def split(line: str) -> list[str]:
    """Cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.strip("|").split("|")]


if __name__ == "__main__":
    sys.exit(main())
