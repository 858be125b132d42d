"""Outages on real drives: the classical filters, and any model, over folders in the data contract.

    python pipelines/real_outage.py data/town data/road
    python pipelines/real_outage.py data/town --imu consumer --models ins mbkf15 models:/outage@seed0
    python pipelines/real_outage.py data/town --lengths 30 60 120 mode=drives

One table per folder and length of outage; reports are in ``outputs/real_outage/<folder>/<length>s/``. Further
arguments of the form key=value are handed to ``dlkf.evaluate``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path


def main() -> int:
    """``dlkf.evaluate`` for every folder and length; 0 if all of them went well."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("folders", nargs="+", help="datasets, and key=value for dlkf.evaluate")
    arguments.add_argument("--imu", default="automotive_mems", help="what the classical filters are told")
    arguments.add_argument("--models", nargs="+", default=["ins", "mbkf15"])
    arguments.add_argument("--lengths", type=float, nargs="+", default=[30, 60], help="of the outages, in seconds")
    options = arguments.parse_intermixed_args()
    overrides = [word for word in options.folders if "=" in word]
    worst = 0
    for folder in (Path(word) for word in options.folders if "=" not in word):
        for length in options.lengths:
            command = [
                *("-m", "dlkf.evaluate", f"model=[{','.join(options.models)}]", f"dataset={folder}"),
                *(f"imu={options.imu}", f"outage.duration_s={length:g}", f"length_s={60 + length:g}"),
                *("injected_bias=null", f"out=outputs/real_outage/{folder.name}/{length:g}s", *overrides),
            ]
            print("\n$ python " + " ".join(command), flush=True)
            worst = max(worst, subprocess.run([sys.executable, *command]).returncode)
    return worst


if __name__ == "__main__":
    sys.exit(main())
