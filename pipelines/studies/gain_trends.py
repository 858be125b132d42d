"""Do the gains follow the noise of GNSS? Figures 7-9, tables 4 and 5 of the paper from its six trainings (R130-R137).

    python -m pipelines.studies.gain_trends outputs/paper/kalman_gain

reads the trainings of ``python pipelines/paper_kalman_gain.py`` and writes ``table4.md``, ``table5.md``, ``trends.md``
and ``figure7.png`` to ``figure9.png`` beside them.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from dlkf.evaluation.figures import png
from dlkf.evaluation.gains import heat_map
from dlkf.evaluation.results import Results

FIGURES = {7: ("set1", "set2", "set3"), 8: ("set1", "set4", "set5"), 9: ("set6",)}
FALLS = {"K_pp": ("set1", "set2", "set3"), "K_vv": ("set1", "set4", "set5")}  # monotone down (R134, R135)
RISES = {"K_pv": ("set1", "set3"), "K_vp": ("set1", "set5")}
LEARNED, BASELINE = ("dlkf", "dlkf_kalman"), "mbkf15"
QUANTITIES = {"position": "m", "velocity": "m/s", "attitude": "rad"}


def main() -> int:
    """Read, draw, tabulate; 0 where every trend holds for both filters in every seed."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("home", type=Path, help="folder with trainings.json")
    home: Path = arguments.parse_args().home
    file = home / "trainings.json"
    if not file.is_file():
        print(f"{file} is not there; run python pipelines/paper_kalman_gain.py first", file=sys.stderr)
        return 2
    runs = {tuple(k.split("/")): Path(v) / "report" for k, v in json.loads(file.read_text()).items() if "/" in k}
    gains = {key: json.loads((folder / "gains.json").read_text()) for key, folder in runs.items()}
    seeds = sorted({seed for _, seed in gains})
    filters = [n for n in (*LEARNED, BASELINE) if all(n in of_filters for of_filters in gains.values())]
    for number, sets in FIGURES.items():
        known = [s for s in sets if (s, seeds[0]) in gains]
        panels = [(f"{f}, {s}", np.array(gains[s, seeds[0]][f]["last"])) for f in filters for s in known]
        if panels:
            title = f"Figure {number}: gain at the last fix of one segment"
            (home / f"figure{number}.png").write_bytes(png(heat_map(panels, len(known) if number < 9 else 2, title)))
    holds, text = trends(gains, seeds, filters)
    (home / "trends.md").write_text(text)
    (home / "table4.md").write_text(table4(runs))
    (home / "table5.md").write_text(table5(runs))
    print((home / "table5.md").read_text(), text, sep="\n")
    return 0 if holds else 1


def trends(gains: dict, seeds: list[str], filters: list[str]) -> tuple[bool, str]:
    """Whether each block falls or rises as it should, with the values."""
    lines = ["| block | sets | filter | seed | mean diagonal | as it should |", "|:--|:--|:--|:--|:--|:--|"]
    all_hold = True
    for blocks, sign in ((FALLS, -1), (RISES, 1)):
        for block, sets in blocks.items():
            for seed in seeds:
                if any((s, seed) not in gains for s in sets):
                    continue
                for name in filters:
                    if name not in LEARNED and seed != seeds[0]:
                        continue  # as with the first seed
                    values = [gains[s, seed][name][block] for s in sets]
                    holds = bool((sign * np.diff(values) > 0).all())
                    all_hold &= holds
                    cells = [block, ", ".join(sets), name, seed, " → ".join(f"{v:.3g}" for v in values)]
                    lines.append(f"| {' | '.join(cells)} | {'yes' if holds else 'no'} |")
    return all_hold, "\n".join(lines) + "\n"


def table4(runs: dict[tuple[str, str], Path]) -> str:
    """The added noise of each set: ours, as the paper's numbers are lost."""
    lines = ["| set | s_p [m] | s_v [m/s] |", "|:--|--:|--:|"]
    for (name, seed), folder in sorted(runs.items()):
        if seed == min(s for _, s in runs):
            noise = json.loads((folder / "metrics.json").read_text())["protocol"]["gnss_noise"] or {"s_p": 0, "s_v": 0}
            lines.append(f"| {name} | {noise['s_p']:g} | {noise['s_v']:g} |")
    return "\n".join(lines) + "\n"


def table5(runs: dict[tuple[str, str], Path]) -> str:
    """Mean over the segments of the RMS of position, velocity and attitude, and ratios to ``mbkf15``, of every set and
    filter; of a learned one with every seed."""
    lines = ["| set | filter | seed | P [m] | V [m/s] | A [rad] | P / V / A, ratio |", "|:--|:--|:--|--:|--:|--:|--:|"]
    scored = set()
    for (name, seed), folder in sorted(runs.items()):
        (content,) = json.loads((folder / "metrics.json").read_text())["results"]
        result = Results.of(content)
        errors = {f: [result.value(f, "segments", "all", q, "mean") for q in QUANTITIES] for f in result.filters}
        for f, values in errors.items():
            if f not in LEARNED and (name, f) in scored:
                continue  # as with the first seed
            scored.add((name, f))
            ratio = " / ".join(f"{x / y:.2f}" for x, y in zip(values, errors[BASELINE]))
            cells = [name, f, seed if f in LEARNED else "–", *(f"{x:.3g}" for x in values), ratio]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
