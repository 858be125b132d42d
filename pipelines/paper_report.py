"""Every table and figure of the paper that can be had, in its order, the published number beside ours: one HTML page.

    python pipelines/paper_report.py                 outputs/paper/report.html
    python pipelines/paper_report.py --home outputs/paper --quick     with the short trainings of section 5.3

shows figures 1, 2, 3 and 5 (``docs/figures/paper``) and reads what ``paper_imu_error.py``, with and without
``--as-published``, ``paper_kalman_gain.py``, ``paper_outage.py``, ``paper_figures.py``, ``paper_real_motion.py`` and
``paper_ablations.py`` left; what has not been run is named with its command. The paper's IMU, roads and receivers are
not ours: compare ratios and orderings, not metres.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from dlkf.base.files import write_into
from dlkf.evaluation.results import Results
from dlkf.evaluation.table import ResultTable, all_tables, format_interval, format_number
from dlkf.report.page import Page, embed_png

FIGURES = Path(__file__).parents[1] / "docs" / "figures" / "paper"
CAPTIONS = {
    "figure1": "Figure 1 (drawn anew): loosely coupled integration with a model-based Kalman filter",
    "figure2": "Figure 2 (drawn anew): the same loop with the network in the filter's place",
    "figure3": "Figure 3 (drawn anew): the network of model=dlkf_literal",
    "figure5": "Figure 5 (drawn anew from the text): antennas on the test vehicle; outline not to scale",
}
TERMS = {"position": "P", "velocity": "V", "attitude": "A"}
UNITS = ("m", "m/s", "rad")
NOTHING = "nothing published"
NOT_HAD = (
    ("Figure 5 as photographed", "a picture of the authors' vehicle; drawn here from the distances in the text"),
    ("Table 2 in full", "rates and the types of IMU and reference are lost; here what the text says"),
    ("Tables 1, 3, 4", "lost numbers; in their place conf/train.yaml, conf/imu/table3_standin.yaml, conf/noise"),
    ("Figures 11 to 14 as measured", "the authors' eleven hours; ours: simulated, or real motion, errors injected"),
)
SENSORS = (  # table 2 as far as the text has it (R101, R104)
    ("GNSS, RTK", "u-blox F9P", "NavXperience 3G+C, above the rear axle", "receiver=rtk"),
    ("GNSS, standard", "u-blox F9P", "Tallysman TW7972, 0.69 m in x from it", "receiver=standalone"),
    ("IMU", "MEMS, brought to 50 Hz", "–", "imu=automotive_mems, rate_hz=50"),
    ("reference", "GNSS/INS", "NavXperience 3G+C", "the simulator's truth"),
)


class Part(NamedTuple):
    """A part of the paper: where its trainings are, what was published, which pictures and tables belong to it."""

    title: str
    study: str
    command: str
    published: Mapping[str, tuple[float, float, float]] = {}  # means of P [m], V [m/s], A [rad] by filter
    pictures: Mapping[str, str] = {}  # caption by name of the file
    tables: tuple[str, ...] = ()  # words in the titles of those that go with it
    only: tuple[str, ...] = ("",)  # trainings whose name begins so
    at_end: float | None = None  # published ratio of horizontal errors at the end of the outages
    note: str = ""


class Claim(NamedTuple):
    """A line of the first table."""

    what: str
    published: str
    ours: str
    verdict: str


PARTS = {
    "imu_error": Part(
        "5.1 IMU errors", "imu_error", "paper_imu_error.py",
        {"dlkf": (0.45, 0.02, 0.07), "mbkf15": (0.49, 0.04, 0.27)},  # R122
        {"imu_errors": "Figure 6: estimates of the IMU's errors (black: true)"},
        ("does the filter estimate", "an hour with GNSS"), only=("one_unit", "no_attitude", "new_units"),
        note="Start 10° off in yaw (1σ). One unit for all drives, as the paper seems to have; the same without "
        "attitude in the loss; a new unit in every drive, where nothing can be memorised.",
    ),
    "as_published": Part(
        "5.1 with the published Kalman filter", "imu_error", "paper_imu_error.py --as-published",
        {"dlkf": (0.45, 0.02, 0.07), "mbkf15": (0.49, 0.04, 0.27)},  # R122
        {"imu_errors": "Figure 6: estimates of the IMU's errors (black: true)"}, only=("as_published",),
        note="Start 60° off in yaw (1σ), untuned, R of 0.5 m and 0.05 m/s (R017). as_published_prior: all unseen "
        "drives, mbkf15_prior given the unit's true error; as_published_tuned and as_published_prior_tuned: mbkf15 and "
        "mbkf15_prior with factors of their own, tuned for this start.",
    ),
    "outage": Part(
        "5.3 Outages of 30 to 50 s", "outage", "paper_outage.py",
        {"dlkf": (0.63, 0.13, 0.17), "mbkf15": (1.43, 0.23, 0.23)},  # R141
        {"tracks": "Figure 10: tracks through outages", "error_growth": "Error against the time without GNSS"},
        ("after longer and longer GNSS", "heading when GNSS goes", "an hour with GNSS"),
    ),
    "semi_real": Part(
        "5.3 Real motion", "figures", "paper_figures.py --real <dataset>", {},
        {"imu_errors": "Figure 11: estimates of the IMU's errors", "tracks": "Figure 12: tracks"}, only=("semi_real",),
        note="The authors' drives are not public: the motion of real drives with the errors of one automotive MEMS "
        "unit injected, segments of 48 s.",
    ),
    "real_motion": Part(
        "5.3 Outages on real motion", "real_motion", "paper_real_motion.py --real <datasets>", {},
        {"imu_errors": "Figure 11: estimates of the IMU's errors", "tracks": "Figure 12: tracks"},
        note="Nothing is trained on it: the motion of all real drives, a unit's errors injected, 30 s without GNSS "
        "every 60 s; whole drives. The first unit is the one that the network was trained on.",
    ),
    "minute": Part(
        "5.3 A minute without GNSS after a minute with it", "figures", "paper_figures.py", {},
        {"error_over_time": "Figure 13: horizontal error over time",
         "error_histograms": "Figure 14: outages by their error"}, only=("minute",), at_end=0.5,
    ),
}  # fmt: skip


def main() -> int:
    """Collect, write, say where."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--home", type=Path, default=Path("outputs/paper"))
    arguments.add_argument("--quick", action="store_true", help="section 5.3 from paper_outage.py --quick")
    options = arguments.parse_args()
    home: Path = options.home
    outage = PARTS["outage"]
    if options.quick:
        outage = outage._replace(study="outage_quick", command="paper_outage.py --quick")
    body = Page("", [])
    claims = [
        *section(body, home, PARTS["imu_error"]), *section(body, home, PARTS["as_published"]),
        *gains(body, home / "kalman_gain"), *section(body, home, outage),
        *section(body, home, PARTS["semi_real"]), *section(body, home, PARTS["real_motion"]),
        *section(body, home, PARTS["minute"]),
    ]  # fmt: skip
    ablations(body, home / "ablations")
    page = Page("The paper, reproduced", answer(claims))
    page.note(
        "Li et al., NAVIGATION 73 (2026). The paper's IMU, roads and receivers are not ours, and the numbers in its "
        "tables 1 to 5 and its figures are lost: compare ratios and orderings, not metres. What is not the paper's "
        "(other filters, intervals, longer GNSS, ablations) is ours."
    )
    page.heading("What the paper says, and what came out", "Ratios of dlkf to mbkf15, one for each training.")
    page.table(["claim", "published", "ours", "reproduced"], claims, words=True)
    for name, caption in CAPTIONS.items():
        page.picture(caption, embed_png((FIGURES / f"{name}.png").read_bytes()))
    page.heading("Table 2: sensors, as far as the text has it", "The last column is what stands in their place here.")
    page.table(["data", "sensor", "antenna", "here"], SENSORS, words=True)
    page.parts += body.parts
    page.heading("Not to be had")
    page.table(["what", "why, and what stands in its place"], NOT_HAD, words=True)
    with write_into(home) as folder:
        (folder / "report.html").write_text(page.html(), encoding="utf-8")
    print("\n".join(" | ".join(claim) for claim in claims), f"Report: {home / 'report.html'}", sep="\n")
    return 0


def answer(claims: list[Claim]) -> list[str]:
    """The first lines: how much was reproduced."""
    run = [c for c in claims if c.verdict not in ("not run", NOTHING)]
    counts = {word: sum(c.verdict.startswith(word) for c in run) for word in ("yes", "in part", "no")}
    text = f"Of {len(run)} claims of the paper that were tried {counts['yes']} are reproduced"
    text += f", {counts['in part']} in part, {counts['no']} not." if run else "."
    left = sum(c.verdict == "not run" for c in claims)
    return [text] + ([f"{left} not run yet."] if left else [])


def trainings(folder: Path) -> dict[str, Path]:
    """Report folders of a study's trainings by key (name/seed); empty where it was not run."""
    file = folder / "trainings.json"
    if not file.is_file():
        return {}
    return {k: Path(v) / "report" for k, v in json.loads(file.read_text()).items() if "/" in k}


def read_results(report: Path) -> Results:
    """The results of a report's one kind of data."""
    (content,) = json.loads((report / "metrics.json").read_text())["results"]
    return Results.of(content)


def section(page: Page, home: Path, part: Part) -> list[Claim]:
    """Means over the segments of the RMS of each (the paper's measure) of every training, then tables and pictures."""
    page.heading(part.title, part.note)
    runs = {k: v for k, v in trainings(home / part.study).items() if k.startswith(part.only)}
    if not runs:
        page.note(f"Not run yet: python pipelines/{part.command}")
        return [Claim(part.title, "", f"python pipelines/{part.command}", "not run")]
    results = {key: read_results(report) for key, report in runs.items()}
    rows = [["published", "", name, *published_cells(part, name)] for name in part.published]
    for key, result in results.items():
        for name in result.filters:
            cells = [key.split("/")[0], key.split("/")[1], name, *measured_cells(result, name)]
            if not any(shown[0] == cells[0] and shown[2:] == cells[2:] for shown in rows):  # the same for every seed
                rows.append(cells)
    baseline = next(iter(results.values())).baseline
    heads = ["training", "seed", "filter", *(cell for t in TERMS.values() for cell in (t, f"{t} ratio")), "end ratio"]
    without = 1 if not any(row[-1] for row in rows) else 0
    page.table(heads[: len(heads) - without], [row[: len(row) - without] for row in rows])
    page.note(
        f"Ratios to {baseline}; the last that of the horizontal RMS at the end of the outages, where there are any. "
        "A classical filter has one row where it is the same for every seed. [ ]: 95 % interval over the recordings."
    )
    key, first = next(iter(runs.items()))
    for table in tables_of(first):
        if any(words in table.title for words in part.tables):
            page.heading(f"{table.title} ({key})", table.note)
            page.table(table.columns, table.rows)
    for name, caption in part.pictures.items():
        if (first / "figures" / f"{name}.png").is_file():
            page.picture(f"{caption} ({key})", embed_png((first / "figures" / f"{name}.png").read_bytes()))
    return claims_of(part, results)


def published_cells(part: Part, name: str) -> list[str]:
    """Published values and their ratio to the Kalman filter's, in the places of ours."""
    cells = []
    for value, baseline, unit in zip(part.published[name], part.published["mbkf15"], UNITS):
        cells += [f"{value:.2f} {unit}", f"{value / baseline:.2f}" if name != "mbkf15" else "1"]
    return [*cells, ""]


def measured_cells(result: Results, name: str) -> list[str]:
    """A filter's values and ratios."""
    cells = []
    for q, unit in zip(TERMS, UNITS):
        cells.append(f"{format_number(result.value(name, 'segments', 'all', q, 'mean'))} {unit}")
        cells.append(format_interval(result.versus(name, "segments", "all", q, "mean")))
    outages = result.count.get("outages")
    return [*cells, format_interval(result.versus(name, "outages", "end", "horizontal")) if outages else ""]


def claims_of(part: Part, results: Mapping[str, Results]) -> list[Claim]:
    """Ratios of dlkf beside the published ones, a line for each kind of training."""
    marks = [a / b for a, b in zip(part.published["dlkf"], part.published["mbkf15"])] if part.published else []
    claims = []
    for n, kind in enumerate(dict.fromkeys(key.split("/")[0] for key in results)):
        marks = marks if n == 0 else []  # the first kind is the paper's
        of_kind = [r for key, r in results.items() if key.split("/")[0] == kind]
        title = f"{part.title}: mean P / V / A" + ("" if len(results) == len(of_kind) else f", {kind}")
        ratios = [[r.versus("dlkf", "segments", "all", q, "mean") for q in TERMS] for r in of_kind]
        if part.at_end is None and all(c for three in ratios for c in three):
            ours = "; ".join(" / ".join(format_number(c.ratio, digits=2) for c in three if c) for three in ratios)
            met = [c.ratio <= mark for three in ratios for c, mark in zip(three, marks) if c]
            claims.append(Claim(title, " / ".join(f"{m:.2f}" for m in marks) or "–", ours, verdict(met)))
        ends = [r.versus("dlkf", "outages", "end", "horizontal") for r in of_kind]
        if part.at_end is not None and all(ends):
            met = [c.ratio <= part.at_end for c in ends if c]
            what = f"{part.title}: horizontal RMS at the end"
            claims.append(Claim(what, f"about {part.at_end:g}", "; ".join(map(format_interval, ends)), verdict(met)))
    return claims


def verdict(met: list[bool]) -> str:
    """Of comparisons with what was published."""
    if not met:
        return NOTHING
    return "yes" if all(met) else "no" if not any(met) else f"in part: {sum(met)} of {len(met)}"


def tables_of(report: Path) -> list[ResultTable]:
    """All tables of a training's report."""
    content = json.loads((report / "metrics.json").read_text())
    more = [ResultTable(**table) for table in content["tables"]]
    return all_tables(content["dataset"], [Results.of(x) for x in content["results"]]) + more


def gains(page: Page, folder: Path) -> list[Claim]:
    """Figures 7-9, tables 4 and 5, and the trends."""
    page.heading("5.2 Gains", "Noise of six sizes added to GNSS; network and Kalman filter anew for each.")
    if not (folder / "trends.md").is_file():
        page.note("Not run yet: python pipelines/paper_kalman_gain.py")
        return [Claim("5.2 Gains follow the noise of GNSS", "", "python pipelines/paper_kalman_gain.py", "not run")]
    rows = {}
    titles = {"table4": "Table 4 (ours): added noise", "table5": "Table 5: means over the segments",
              "trends": "Do the gains follow the noise?"}  # fmt: skip
    for name, title in titles.items():
        head, _, *rows[name] = [split(line) for line in (folder / f"{name}.md").read_text().splitlines() if line]
        page.heading(title)
        page.table(head, rows[name])
    for n, caption in {7: "position noise grows", 8: "velocity noise grows", 9: "both"}.items():
        if (folder / f"figure{n}.png").is_file():
            page.picture(f"Figure {n}: gains, {caption}", embed_png((folder / f"figure{n}.png").read_bytes()))
    claims = []
    for name in ("dlkf", "mbkf15"):
        held = {(row[0], row[3]): row[-1] == "yes" for row in rows["trends"] if row[2] == name}
        not_held = ", ".join(f"{block} (seed {seed})" for (block, seed), yes in held.items() if not yes)
        ours = f"{sum(held.values())} of {len(held)} trends" + (f", not {not_held}" if not_held else "")
        claims.append(Claim(f"5.2 Gains of {name} follow the noise of GNSS", "all", ours, verdict([*held.values()])))
    value = {tuple(row[:3]): [float(x) for x in row[3:6]] for row in rows["table5"]}
    sets = [(s, seed) for s, seed, name in value if name == "dlkf"]
    for i, (term, mark) in enumerate({"P": 1.05, "V": 1.05, "A": 1.0}.items()):
        ratios = [value[s, seed, "dlkf"][i] / value[s, seed, "mbkf15"][i] for s, seed in sets]
        said = "better" if term == "A" else "alike or slightly better"
        ours = f"ratio {min(ratios):.2f} to {max(ratios):.2f}"
        claims.append(Claim(f"5.2 {term} over the six sets", said, ours, verdict([r <= mark for r in ratios])))
    return claims


def ablations(page: Page, folder: Path) -> None:
    """What each part is worth."""
    page.heading("Ablations (ours)", "One change at a time, the quick profile.")
    if not (folder / "ablations.md").is_file():
        page.note("Not run yet: python pipelines/paper_ablations.py")
        return
    head, _, *rows = [split(line) for line in (folder / "ablations.md").read_text().splitlines()]
    page.table(head, rows)


def split(line: str) -> list[str]:
    """Cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.strip("|").split("|")]


if __name__ == "__main__":
    sys.exit(main())
