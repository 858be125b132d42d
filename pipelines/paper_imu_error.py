"""IMU errors as in section 5.1 of the paper (R120-R124): train, score, compare; one unit and new units.

    python pipelines/paper_imu_error.py                          seeds 0, 1, 2, the paper's 500 epochs
    python pipelines/paper_imu_error.py --seeds 0 trainer.max_epochs=100

Per seed three trainings: one unit for all drives, the same without attitude in the loss (R124), and drives with a new
unit each, where nothing can be learned by heart. Finished trainings are kept: the same command goes on. What is
where stands in ``outputs/paper/imu_error``; ``python pipelines/paper_report.py`` makes the page of it. Further
key=value go to ``dlkf.train``.
"""

from __future__ import annotations

from pathlib import Path

from dlkf.tracking.chain import Study, arguments

HOME = Path("outputs/paper/imu_error")
VARIANTS = {
    "one_unit": ("data.datasets=[data/paper_clean]",),
    "no_attitude": ("data.datasets=[data/paper_clean]", "loss.attitude=0"),
    "new_units": ("data.datasets=[data/paper_clean_units]", "scoring.hour=null"),
}


def main() -> None:
    """Every variant and seed under one parent run."""
    options, overrides = arguments(__doc__, "0,1,2", "one training of every variant for each").parse_known_args()
    study = Study(HOME)
    with study.parent("imu_error", "paper 5.1"):
        for seed in options.seeds:
            for name, given in VARIANTS.items():
                folder = study.train(f"{name}/{seed}", "+experiment=imu_error", f"seed={seed}", *given, *overrides)
                print(f"{name}, seed {seed}: {folder / 'report' / 'report.html'}")


if __name__ == "__main__":
    main()
