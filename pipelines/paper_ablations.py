"""What each part of the network and of its training is worth (R050, R052, R063): one change at a time.

    python pipelines/paper_ablations.py                                  some minutes each, seed 0
    python pipelines/paper_ablations.py --seeds 0,1 --rows base,gru trainer.max_epochs=100

Every row is ``+experiment=outage +profile=quick`` with one change, scored on the same segments as the others. It ends
with ``outputs/paper/ablations/ablations.md``: end of the outages and ratios to the tuned 15-state filter, right after
the start and after minutes of GNSS. Finished trainings are kept: the same command goes on. Further key=value go to
``dlkf.train``.
"""

from __future__ import annotations

import json
from pathlib import Path

from trainings import Study, arguments

from dlkf.evaluation.results import Results
from dlkf.evaluation.table import format_interval, format_number

HOME = Path("outputs/paper/ablations")
ROWS: dict[str, tuple[str, ...]] = {
    "base": (),
    "CNN only (R050)": ("model.network.cell=none",),
    "LSTM only (R050)": ("model.network.window=false",),
    "GRU (R052)": ("model.network.cell=gru",),
    "half the size": ("model.network.lstm_hidden=128", "model.network.dense=[256,128]"),
    "double the size": ("model.network.lstm_hidden=512", "model.network.dense=[1024,512]"),
    "dropout 0.5 (R049)": ("model.network.dropout=0.5",),
    "torch's own initialisation": ("model.network.init=plain",),
    "no start from the mean error": ("model.known_from=nothing",),
    "gain and error in North-East-Down": ("model.frame=ned",),
    "network at fixes only": ("model.outage_mode=hold",),
    "six-axis IMU error (R033)": ("model.imu_error=constant",),
    "no curriculum (R071)": ("callbacks.curriculum.warm_s=60", "callbacks.outage.start_epoch=0"),
    "no decimation (R069)": ("callbacks.decimation=null",),
    "no outages in training (R070)": ("callbacks.outage=null",),
    "no adaptive weights (R066)": ("callbacks.loss_weights=null",),
    "loss after the update only (paper.md 4.12)": ("loss.prior=0",),
    "no attitude in the loss (R124)": ("loss.attitude=0",),
    "the paper to the letter": ("model=dlkf_literal",),
}
SCORED = ("baselines.models=[mbkf15]", "scoring.after_s=[22,120]", "scoring.hour=null", "scoring.injected_bias=null")


def main() -> None:
    """Every row and seed under one parent run, then the table."""
    parser = arguments(__doc__, "0", "one training of every row for each")
    parser.add_argument("--rows", help=f"of: {', '.join(ROWS)}")
    options, overrides = parser.parse_known_args()
    rows = options.rows.split(",") if options.rows else list(ROWS)
    if unknown := [row for row in rows if row not in ROWS]:
        parser.error(f"there is no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    study = Study(HOME)
    with study.parent("ablations", "paper R050, R052, R063"):
        for seed in options.seeds:
            for row in rows:
                change = ("+experiment=outage", "+profile=quick", "name=ablations", f"seed={seed}", *SCORED, *ROWS[row])
                study.train(f"{row}/{seed}", *change, *overrides)
    text = table(study)
    (HOME / "ablations.md").write_text(text)
    print(f"{text}\n{HOME / 'ablations.md'}")


def table(study: Study) -> str:
    """One line per training: end of the outages, ratios to ``mbkf15``; the last line is the 15-state filter itself."""
    heads = ("change", "seed", "end, RMS [m]", "median [m]", "ratio of RMS", "of geometric means", "P / V / A, mean")
    lines = [f"| {' | '.join(heads)} | after 120 s |", "|:--|" + "--:|" * len(heads)]
    end, last = ("outages", "end", "horizontal"), ""
    for key, folder in study.done.items():
        if "/" not in key:
            continue
        change, seed = key.rsplit("/", 1)
        content = json.loads((Path(folder) / "report" / "metrics.json").read_text())
        result = Results.of(content["results"][0])
        three = (result.versus("dlkf", "segments", "all", q, "mean") for q in ("position", "velocity", "attitude"))
        cells = [
            format_number(result.value("dlkf", *end)),
            format_number(result.value("dlkf", *end, "median")),
            format_interval(result.versus("dlkf", *end)),
            format_interval(result.versus("dlkf", *end, "geomean")),
            " / ".join(format_number(c.ratio, digits=2) if c else "-" for c in three),
        ]
        lines.append(f"| {change} | {seed} | {' | '.join(cells)} | {later(content)} |")
        itself = (format_number(result.value("mbkf15", *end, statistic)) for statistic in ("rms", "median"))
        last = f"| `mbkf15` | | {' | '.join(itself)} | | | | |"
    return "\n".join([*lines, last]) + "\n"


def later(content: dict) -> str:
    """Ratio of geometric means after 120 s with GNSS, of a report's further tables."""
    for given in content["tables"]:
        heads = [column.replace("\n", " ") for column in given["columns"]]
        place = next((k + 1 for k, head in enumerate(heads) if head.startswith("120 s geo")), None)
        if place:
            return next(row[place] for row in given["rows"] if row[0] == "dlkf")
    return ""


if __name__ == "__main__":
    main()
