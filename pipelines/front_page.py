"""The table and the picture of README.md: five filters through outages on simulated and on real motion.

    python pipelines/front_page.py --kitti data/real/kitti
    python pipelines/front_page.py --dlkf outputs/train/outage/<hash>/best

Trains ``dlkf`` by the quick profile unless ``--dlkf`` names a folder of weights; scores the unseen drives of
``one_imu`` (outages of 60 s after 60 s) and, with ``--kitti``, real motion with the errors of a consumer IMU
(outages of 30 s). The table is printed, the picture is docs/figures/outage.png.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from trainings import run

from dlkf.base.colours import filter_colour
from dlkf.evaluation.results import Results
from dlkf.evaluation.table import format_number

FILTERS = {  # in the table: its text
    "ins": "INS, strapdown from the last fix",
    "mbkf15": "EKF, 15 states",
    "mbkf21_car": "EKF with vehicle constraints",
    "plus": "EKF with vehicle constraints that adapts to IMU, car and receiver; the default of navigate",
    "dlkf": "the paper's network, trained on this IMU (24 epochs)",
}
QUICK = ("+experiment=outage", "+profile=quick", "baselines.models=[mbkf15]", "baselines.tune=false",
         "scoring.hour=null", "scoring.after_s=[]")  # fmt: skip
COMMON = ("tuning=any_car", "injected_bias=null", "tracking.log=false", "overwrite=true")
OUT = Path("outputs/front_page")
FIGURE = Path("docs/figures/outage.png")


def main() -> int:
    """Train, score, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--dlkf", help="folder with the weights of a trained dlkf")
    parser.add_argument("--kitti", help="the real drives of KITTI in the data contract")
    options = parser.parse_args()
    weights = options.dlkf or next(line.split()[-1] for line in run("train", *QUICK) if line.startswith("Model:"))
    run("evaluate", f"model=[ins,mbkf15,mbkf21_car,plus,{weights}]", "dataset=data/one_imu", "unseen=true",
        "length_s=120", "stride_s=120", f"out={OUT}/simulated", *COMMON)  # fmt: skip
    simulated, real = results(OUT / "simulated"), None
    if options.kitti:
        words = ("imu=consumer", "receiver=white", f"out={OUT}/kitti", "overwrite=true")
        run("simulate", f"source={options.kitti}", *words)
        run("evaluate", "model=[ins,mbkf15,mbkf21_car,plus]", f"dataset={OUT}/kitti", "mode=drives",
            "outage.duration_s=30", "outage.first_s=20", f"out={OUT}/real", *COMMON)  # fmt: skip
        real = results(OUT / "real")
    draw(simulated)
    print(f"\n{table(simulated, real)}\n{FIGURE}")
    return 0


def results(folder: Path) -> Results:
    """Of the one kind of data in a report."""
    (found,) = json.loads((folder / "metrics.json").read_text())["results"]
    return Results.of(found)


def labels(result: Results) -> dict[str, str]:
    """Name in the front page's table → name in the report, where the trained folder's name stands for dlkf."""
    return {n if n in FILTERS else "dlkf": n for n in result.filters}


def table(simulated: Results, real: Results | None) -> str:
    """A row per filter: RMS (median) of the horizontal error."""
    heads = [f"simulated, {simulated.count['outages']} outages: 30 s [m]", "60 s [m]"]
    heads += [] if real is None else [f"real motion, {real.count['outages']} outages: 30 s [m]"]
    lines = [f"| filter | | {' | '.join(heads)} |", "|:--|:--|" + "--:|" * len(heads)]
    for name, of_simulated in labels(simulated).items():
        cells = [cell(simulated, of_simulated, "at 30 s"), cell(simulated, of_simulated, "end")]
        if real is not None:
            cells.append(cell(real, name, "end") if name in real.filters else "–")
        lines.append(f"| `{name}` | {FILTERS[name]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def cell(result: Results, name: str, part: str) -> str:
    """RMS (median)."""
    rms, median = (format_number(result.value(name, "outages", part, "horizontal", s)) for s in ("rms", "median"))
    return f"{rms} ({median})"


def draw(result: Results) -> None:
    """Median error against the time without GNSS, every point over the same outages."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    seconds = [float(s) for s in result.seconds_into_outage()]
    for k, (label, name) in enumerate(labels(result).items()):
        median = [result.value(name, "outages", f"at {s:g} s", "horizontal", "median") for s in seconds]
        axes.plot(seconds, median, "o-", color=filter_colour(k), label=label)
    axes.set(xlabel="time without GNSS [s]", ylabel="median horizontal error [m]", yscale="log", xlim=(0, None))
    axes.set_title(f"{result.count['outages']} simulated outages of 60 s, each after 60 s of GNSS", fontsize=10)
    axes.grid(alpha=0.3, which="both")
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.66))
    figure.savefig(FIGURE, dpi=130)


if __name__ == "__main__":
    sys.exit(main())
