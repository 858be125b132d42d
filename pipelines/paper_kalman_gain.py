"""Gains as in section 5.2 of the paper (R130-R137): six noises of GNSS, the network retrained for each.

    python pipelines/paper_kalman_gain.py                        seed 0, 250 epochs a set
    python pipelines/paper_kalman_gain.py --seeds 0,1 trainer.max_epochs=500

The Kalman filter is tuned anew for each set, too. Finished trainings are kept: the same command goes on. It ends with
``python -m pipelines.studies.gain_trends``: figures 7-9, tables 4 and 5, and whether the gains follow the noise.
Further key=value go to ``dlkf.train``.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from trainings import Study, arguments

HOME = Path("outputs/paper/kalman_gain")
SETS = ("set1", "set2", "set3", "set4", "set5", "set6")


def main() -> int:
    """Every set and seed under one parent run, then what they say together."""
    options, overrides = arguments(__doc__, "0", "six trainings for each").parse_known_args()
    study = Study(HOME)
    with study.parent("kalman_gain", "paper 5.2"):
        for seed in options.seeds:
            for noise in SETS:
                study.train(f"{noise}/{seed}", "+experiment=kalman_gain", f"+noise={noise}", f"seed={seed}", *overrides)
    return subprocess.run([sys.executable, "-m", "pipelines.studies.gain_trends", str(HOME)]).returncode


if __name__ == "__main__":
    sys.exit(main())
