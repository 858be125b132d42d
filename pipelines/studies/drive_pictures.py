"""Pictures of the drives of any dataset, simulated or real.

    python -m pipelines.studies.drive_pictures data/lifelike --out outputs/pictures
    python -m pipelines.studies.drive_pictures ../shared/data/real/rtkx --drive <name of the drive>

Draws a drive as in figure 4 of the paper (track, speed, specific force, rates, errors), the first one unless
``--drive`` says which, and for all drives the histograms of speed, accelerations and radii.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dlkf.errors import InputError
from dlkf.simulation.pictures import write_pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--drive", nargs="+", default=[], help="names in drives.parquet; the first one by default")
    parser.add_argument("--out", type=Path, default=Path("outputs/pictures"))
    arguments = parser.parse_args()
    try:
        for path in write_pictures(arguments.dataset, arguments.out, arguments.drive):
            print(path)
    except InputError as error:
        print(f"dlkf: error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
