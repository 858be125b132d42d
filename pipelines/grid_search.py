"""Grid search with one MLflow parent run; the table of all points is printed at the end.

    python pipelines/grid_search.py
    python pipelines/grid_search.py optimizer.lr=1e-3,3e-3 seed=0,1,2
    python pipelines/grid_search.py --jobs 4 model=dlkf,dlkf_literal optimizer.lr=1e-3,3e-3

Without a grid it goes over learning rate and seed. It trains with ``+experiment=outage +profile=quick``; give
others with ``--experiment`` and ``--profile`` (an empty profile is the full length). A point that is already
trained is trained again; one that was killed is gone on with. Look at the result with ``make ui``.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

GRID = ["optimizer.lr=1e-3,3e-3", "seed=0,1"]


def main() -> int:
    """One call of ``dlkf.train -m``; its exit code."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--experiment", default="outage")
    arguments.add_argument("--profile", default="quick")
    arguments.add_argument("--jobs", type=int, default=1, help="points at the same time, each on its share of cores")
    options, grid = arguments.parse_known_args()
    overrides = [f"+experiment={options.experiment}", *(grid or GRID)]
    if options.profile:
        overrides.append(f"+profile={options.profile}")
    environment = dict(os.environ)
    if options.jobs > 1:
        overrides += ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={options.jobs}"]
        environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // options.jobs)))
    command = [sys.executable, "-m", "dlkf.train", "-m", *overrides]
    print(" ".join(["python", *command[1:]]), flush=True)
    return subprocess.run(command, env=environment).returncode


if __name__ == "__main__":
    sys.exit(main())
