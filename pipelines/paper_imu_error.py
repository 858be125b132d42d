"""IMU errors as in section 5.1 of the paper (R120-R124): train, score, compare; one unit and new units.

    python pipelines/paper_imu_error.py                          seeds 0, 1, 2, the paper's 500 epochs
    python pipelines/paper_imu_error.py --seeds 0 trainer.max_epochs=100
    python pipelines/paper_imu_error.py --as-published --seeds 0  the paper's Kalman filter as it must have run

Per seed three trainings: one unit for all drives, the same without attitude in the loss (R124), and drives with a new
unit each, where nothing can be memorised. With ``--as-published`` one training for each seed: the start is 60° off in
yaw (1σ), the Kalman filter is not tuned and its R is 0.5 m and 0.05 m/s (R017), and while the network is trained an
attitude correction is at most half a turn (paper.md 4.5, 4.10); all unseen drives are then scored again with a Kalman
filter tuned for that start and with one that is given the unit's error. Finished trainings are kept: the same command
goes on. What is where stands in ``outputs/paper/imu_error``; ``python pipelines/paper_report.py`` makes the page of it.
Further key=value go to ``dlkf.train``.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
from trainings import Study, arguments, run

HOME = Path("outputs/paper/imu_error")
CLEAN, IMU = "data/paper_clean", "imu=table3_standin"
VARIANTS = {
    "one_unit": (f"data.datasets=[{CLEAN}]",),
    "no_attitude": (f"data.datasets=[{CLEAN}]", "loss.attitude=0"),
    "new_units": ("data.datasets=[data/paper_clean_units]", "scoring.hour=null"),
}
START = "yaw_deg=60"  # 1σ
R = ("position_std=25", "velocity_std=2.5")  # factors on fixes of 0.02 m and 0.02 m/s: 0.5 m, 0.05 m/s
AS_PUBLISHED = (
    f"data.datasets=[{CLEAN}]", f"data.start.{START}", "model.training_turn=3.14159", "scoring.hour=null",
    "baselines.tune=false", *(f"baselines.tuning.{factor}" for factor in R),
)  # fmt: skip
SEGMENTS = (f"dataset={CLEAN}", IMU, "length_s=60", "stride_s=60", "start=coarse", f"start.{START}")
STD = "[1e-3,1e-3,1e-3,1e-5,1e-5,1e-5]"  # of a unit's error that is given


def main() -> None:
    """Every variant and seed under one parent run."""
    parser = arguments(__doc__, "0,1,2", "one training of every variant for each")
    parser.add_argument("--as-published", action="store_true", help="start 60° off in yaw, R of 0.5 m and 0.05 m/s")
    options, overrides = parser.parse_known_args()
    variants = {"as_published": AS_PUBLISHED} if options.as_published else VARIANTS
    study = Study(HOME)
    with study.parent("imu_error", "paper 5.1"):
        for seed in options.seeds:
            for name, given in variants.items():
                folder = study.train(f"{name}/{seed}", "+experiment=imu_error", f"seed={seed}", *given, *overrides)
                print(f"{name}, seed {seed}: {folder / 'report' / 'report.html'}")
                if options.as_published:
                    score_as_published(study, seed, folder / "best")


def score_as_published(study: Study, seed: str, weights: Path) -> None:
    """The drives that the network has not seen, from the same start, with Kalman filters of the published R, and with
    each tuned for this start; ``mbkf15_prior`` is given the unit's true error."""
    prior = (f"prior.mean={unit_error(Path(CLEAN))}", f"prior.std={STD}")
    kinds: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        "as_published_prior": (("mbkf15", "mbkf15_prior"), tuple(f"tuning.{factor}" for factor in R)),
    }
    for name, kind in (("mbkf15", "as_published_tuned"), ("mbkf15_prior", "as_published_prior_tuned")):
        tuned = HOME / f"tuned_{name}"
        if not tuned.is_dir():
            scored = ("objective=pva", "outage=null", "fractions=[0.55,0.1,0.35]", "segments=60")
            run("tune", f"model={name}", "name=published_start", f"out={tuned}", *SEGMENTS, *scored, *prior)
        kinds[kind] = ((name,), ("--config-dir", str(tuned), "tuning=published_start"))
    for kind, (names, factors) in kinds.items():
        if f"{kind}/{seed}" in study.done:
            continue
        home = HOME / kind / seed
        shutil.copytree(weights, home / "dlkf", dirs_exist_ok=True)  # the tables call a model after its folder
        models = f"model=[{','.join(names)},{home / 'dlkf'}]"
        report = (f"out={home / 'report'}", "overwrite=true", "unseen=true", "outage=null", f"baseline={names[0]}")
        run("evaluate", *factors, models, *SEGMENTS, *prior, *report)
        study.remember(f"{kind}/{seed}", str(home))


def unit_error(dataset: Path) -> list[float]:
    """The error (6) [m/s², rad/s] of the one unit of a simulated dataset: mean over its first drive."""
    columns = [f"{sensor}_error_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    first = min((dataset / "reference").glob("drive=*"))
    return pd.read_parquet(first / "part-0.parquet", columns=columns).mean().tolist()


if __name__ == "__main__":
    main()
