"""GNSS outages as in section 5.3 of the paper, on simulated drives: train, score, then try other IMUs.

    python pipelines/paper_outage.py                    the paper's 500 epochs
    python pipelines/paper_outage.py --quick            some minutes on two cores
    python pipelines/paper_outage.py --seeds 0,1,2      several trainings, for the spread between them
    python pipelines/paper_outage.py --models dlkf,dlkf_literal     beside it the paper to the letter
    python pipelines/paper_outage.py --models dlkf_kalman           the network beside a Kalman filter

Every seed is trained with ``+experiment=outage``, scored beside the classical filters on the test drives, and
registered as ``models:/outage@seed<n>``. All of them then run over ``data/per_drive``, where each drive has an
IMU that no filter has met: what is left of the advantage there is not knowledge of one IMU. Finished trainings are
kept: the same command goes on.
"""

from __future__ import annotations

from pathlib import Path

from trainings import Study, arguments, run

HOME = Path("outputs/paper/outage")
NEW_IMUS = Path("data/per_drive")


def main() -> None:
    """Train every seed, then evaluate all models together."""
    parser = arguments(__doc__, "0", "one training of every model for each")
    parser.add_argument("--quick", action="store_true", help="a few minutes of training instead of 500 epochs")
    parser.add_argument("--models", default="dlkf", help="of dlkf, dlkf_literal (the paper to the letter), dlkf_kalman")
    options, overrides = parser.parse_known_args()
    profile = ["+profile=quick"] if options.quick else []
    study = Study(HOME if not options.quick else HOME.with_name("outage_quick"))
    with study.parent("outage", "paper 5.3"):
        for seed in options.seeds:
            for model in options.models.split(","):
                register = ["tracking.register=outage", f"tracking.alias=seed{seed}"] if model == "dlkf" else []
                given = ["+experiment=outage", *profile, f"model={model}", f"seed={seed}", *register, *overrides]
                study.train(f"{model}/{seed}", *given)
    if not NEW_IMUS.exists():
        run("simulate", "dataset=per_drive", f"out={NEW_IMUS}")
    if "dlkf" not in options.models.split(","):
        return
    models = ",".join(["ins", "mbkf15", *(f"models:/outage@seed{seed}" for seed in options.seeds)])
    outage = ["length_s=80", "stride_s=80", "outage.first_s=[20,25]", "outage.duration_s=[30,50]"]
    out = ("out=outputs/paper/new_imus", "overwrite=true")
    run("evaluate", f"model=[{models}]", f"dataset={NEW_IMUS}", *out, *outage)


if __name__ == "__main__":
    main()
