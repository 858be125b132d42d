"""Figures 11 to 14 of the paper (R143-R148): real motion, and a minute without GNSS after a minute with it.

    python pipelines/paper_figures.py --real data/kitti               the paper's 500 epochs
    python pipelines/paper_figures.py --real data/kitti trainer.max_epochs=100

Two trainings for each seed. ``minute``: outages from 60 to 120 s of simulated segments (figures 13 and 14).
``semi_real``, where ``--real`` names a dataset of real drives with a good IMU: their motion with the errors of one
automotive MEMS unit injected, split by recording (figures 11 and 12). Real recordings are short: segments of 48 s with
an outage of 25 to 28 s, where the paper has 30 to 50. Finished trainings are kept: the same command goes on. What is
where stands in ``outputs/paper/figures``; ``python pipelines/paper_report.py`` makes the page of it. Further key=value
go to ``dlkf.train``.
"""

from __future__ import annotations

from pathlib import Path

from trainings import Study, arguments, run

HOME = Path("outputs/paper/figures")
SEMI_REAL = Path("data/semi_real_one")
SHORT = (
    f"data.datasets=[{SEMI_REAL}]", "data.fractions=[0.45,0.15,0.4]", "data.length_s=40", "data.eval_length_s=48",
    "data.eval_stride_s=24", "data.eval_outage={first_s:16,duration_s:26}", "scoring.outage.first_s=[15,18]",
    "scoring.outage.duration_s=[25,28]", "scoring.after_s=[]", "scoring.hour=null", "callbacks.curriculum.full_s=40",
)  # fmt: skip


def main() -> None:
    """Both trainings of every seed under one parent run."""
    parser = arguments(__doc__, "0", "both trainings for each")
    parser.add_argument("--real", help="dataset of real drives, whose motion is used")
    options, overrides = parser.parse_known_args()
    if options.real and not SEMI_REAL.exists():
        unit = ("dataset=semi_real", f"source={options.real}", "dataset.imu_errors=one")
        run("simulate", *unit, f"out={SEMI_REAL}")
    study = Study(HOME)
    with study.parent("figures", "paper 5.3, figures 11 to 14"):
        for seed in options.seeds:
            study.train(f"minute/{seed}", "+experiment=minute", f"seed={seed}", *overrides)
            if options.real:
                given = ("+experiment=outage", "name=semi_real", f"seed={seed}", *SHORT, *overrides)
                study.train(f"semi_real/{seed}", *given)


if __name__ == "__main__":
    main()
