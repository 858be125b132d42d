"""GNSS outages as in section 5.3 of the paper, on simulated drives: train, score, then try other IMUs.

    python pipelines/paper_outage.py                    the paper's 500 epochs
    python pipelines/paper_outage.py --quick            some minutes on two cores
    python pipelines/paper_outage.py --seeds 0,1,2      several trainings, for the spread between them

Every seed is trained with ``+experiment=outage``, scored beside the classical filters on the test drives, and
registered as ``models:/outage@seed<n>``. All of them then run over ``data/per_drive``, where each drive has an
IMU that no filter has met: what is left of the advantage there is not knowledge of one IMU.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

NEW_IMUS = Path("data/per_drive")


def run(command: str, *arguments: str) -> None:
    """One command of dlkf; its failure ends the chain."""
    print(f"\n$ python -m dlkf.{command} {' '.join(arguments)}", flush=True)
    if code := subprocess.run([sys.executable, "-m", f"dlkf.{command}", *arguments]).returncode:
        sys.exit(code)


def main() -> None:
    """Train every seed, then evaluate all models together."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--quick", action="store_true", help="a few minutes of training instead of 500 epochs")
    arguments.add_argument("--seeds", default="0", help="one training for each; key=value goes to dlkf.train")
    options, overrides = arguments.parse_known_args()
    profile = ["+profile=quick"] if options.quick else []
    seeds = options.seeds.split(",")
    for seed in seeds:
        register = ["tracking.register=outage", f"tracking.alias=seed{seed}"]
        run("train", "+experiment=outage", *profile, f"seed={seed}", *register, *overrides)
    if not NEW_IMUS.exists():
        run("simulate", "dataset=per_drive", f"out={NEW_IMUS}")
    models = ",".join(["ins", "mbkf15", *(f"models:/outage@seed{seed}" for seed in seeds)])
    outage = ["length_s=80", "stride_s=80", "outage.first_s=[20,25]", "outage.duration_s=[30,50]"]
    out = ("out=outputs/paper_outage/new_imus", "overwrite=true")
    run("evaluate", f"model=[{models}]", f"dataset={NEW_IMUS}", *out, *outage)


if __name__ == "__main__":
    main()
