"""Outages on real drives: the classical filters, and any model, over folders in the data contract.

    python pipelines/real_outage.py data/town data/road
    python pipelines/real_outage.py data/town --imu consumer --models ins mbkf15 models:/outage@seed0
    python pipelines/real_outage.py data/town --lengths 30 60 120 mode=drives

One table per folder and length of outage, and one over all lengths; they and the reports are in
``outputs/real_outage/<name>/``, ``--name`` being the folder's unless it is given. Further arguments of the form
key=value are handed to ``dlkf.evaluate``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from dlkf.evaluation.results import Results
from dlkf.evaluation.table import format_interval


def main() -> int:
    """``dlkf.evaluate`` for every folder and length; 0 if all of them went well."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("folders", nargs="+", help="datasets; key=value goes to dlkf.evaluate")
    arguments.add_argument("--imu", default="automotive_mems", help="settings of the classical filters")
    arguments.add_argument("--models", nargs="+", default=["ins", "mbkf15"])
    arguments.add_argument("--name", help="of the folder of reports")
    arguments.add_argument("--lengths", type=float, nargs="+", default=[30, 60], help="of the outages, in seconds")
    overrides = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
    options = arguments.parse_intermixed_args([word for word in sys.argv[1:] if word not in overrides])
    worst = 0
    for folder in map(Path, options.folders):
        home = Path("outputs/real_outage") / (options.name or folder.name)
        for length in options.lengths:
            command = [
                *("-m", "dlkf.evaluate", f"model=[{','.join(options.models)}]", f"dataset={folder}"),
                *(f"imu={options.imu}", f"outage.duration_s={length:g}", f"length_s={60 + length:g}"),
                *("injected_bias=null", f"out={home}/{length:g}s", "overwrite=true", *overrides),
            ]
            print("\n$ python " + " ".join(command), flush=True)
            worst = max(worst, subprocess.run([sys.executable, *command]).returncode)
        table = summary(home, options.lengths)
        (home / "table.md").write_text(table)
        print(f"\n{table}\n{home / 'table.md'}")
    return worst


def summary(home: Path, lengths: list[float]) -> str:
    """Horizontal error at the end of the outages, every filter and length: RMS (median), ratio to mbkf15."""
    found = {n: json.loads(p.read_text()) for n in lengths if (p := home / f"{n:g}s" / "metrics.json").is_file()}
    made = [(n, Results.of(result)) for n, x in found.items() for result in x["results"]]
    if not made:
        return "no outage could be scored\n"
    heads = [f"{n:g} s, {r.count['outages']} outages ({r.kind}) [m] | ratio" for n, r in made]
    lines = [f"| filter | {' | '.join(heads)} |", "|:--|" + "--:|" * (2 * len(heads))]
    end = ("outages", "end", "horizontal")
    for name in made[0][1].filters:
        cells = []
        for _, result in made:
            cells.append(f"{result.value(name, *end):.3g} ({result.value(name, *end, 'median'):.3g})")
            cells.append(format_interval(result.versus(name, *end)))
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
