"""Gains as in section 5.2 of the paper (R130-R137): six noises of GNSS, the network retrained for each.

    python pipelines/paper_kalman_gain.py                        seed 0, 250 epochs a set
    python pipelines/paper_kalman_gain.py --seeds 0,1 trainer.max_epochs=500
    python pipelines/paper_kalman_gain.py --model dlkf_kalman model.base=mbkf15    beside a Kalman filter

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
    parser = arguments(__doc__, "0", "six trainings for each")
    parser.add_argument("--model", default="dlkf", help="the filter that is trained; not dlkf: in a folder of its own")
    options, overrides = parser.parse_known_args()
    home = HOME if options.model == "dlkf" else HOME.with_name(f"{HOME.name}_{options.model}")
    study = Study(home)
    with study.parent("kalman_gain", "paper 5.2"):
        for seed in options.seeds:
            for noise in SETS:
                given = ("+experiment=kalman_gain", f"+noise={noise}", f"model={options.model}", f"seed={seed}")
                study.train(f"{noise}/{seed}", *given, *overrides)
    return subprocess.run([sys.executable, "-m", "pipelines.studies.gain_trends", str(home)]).returncode


if __name__ == "__main__":
    sys.exit(main())
