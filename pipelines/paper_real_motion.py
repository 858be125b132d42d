"""Outages of 30 s on the motion of all real drives there are, with the errors of several units injected (paper 5.3).

    python pipelines/paper_real_motion.py --real data/kitti,data/wid_mru,data/rtkx,data/linkoping
    python pipelines/paper_real_motion.py --real data/kitti --units 177 --learned models:/outage@seed0

For every unit (a seed of ``imu=automotive_mems``) the motion of all datasets after ``--real``, GNSS of their references
and the unit's errors as one dataset, ``data/real_motion_<unit>``. Whole drives from their own alignment, outages of
30 s all along them, intervals over the recordings. Unit 177 is that of ``dataset=one_imu``: it is scored with
``--learned``, networks that were trained on that unit, and with ``mbkf15_prior``, which is given its errors. Nothing is
trained on real motion. Further key=value go to ``dlkf.evaluate``.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import pandas as pd
from paper_imu_error import unit_error
from trainings import Study, run

from dlkf.data.schema import new_dataset, write_drives_table

HOME = Path("outputs/paper/real_motion")
KNOWN_UNIT = "177"  # dataset.unit_seed of conf/simulated/_point_car.yaml
PROTOCOL = ("imu=automotive_mems", "mode=drives", "outage.first_s=20", "outage.duration_s=30", "injected_bias=null")
STD = "[3e-3,3e-3,3e-3,1e-4,1e-4,1e-4]"  # of a unit's error that is given: its walk, and the source's own errors


def main() -> None:
    """A dataset and an evaluation for every unit."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", required=True, help="datasets of real drives, separated by commas")
    arguments.add_argument("--units", default="177,178,179", help="seeds of the units")
    arguments.add_argument("--learned", default="", help="networks trained on unit 177, separated by commas")
    options, overrides = arguments.parse_known_args()
    study = Study(HOME)
    for unit in options.units.split(","):
        dataset, out = Path(f"data/real_motion_{unit}"), HOME / unit / "report"
        if not dataset.exists():
            inject(options.real.split(","), unit, dataset)
        models, given = ["mbkf15", "mbkf21_car", "plus"], ["tuning=any_car"]
        if unit == KNOWN_UNIT:
            models += ["mbkf15_prior", *filter(None, options.learned.split(","))]
            given += [f"prior.mean={unit_error(dataset)}", f"prior.std={STD}"]
        scored = (f"model=[{','.join(models)}]", f"dataset={dataset}", *PROTOCOL, *given)
        run("evaluate", *scored, f"out={out}", "overwrite=true", *overrides)
        study.remember(f"unit {unit}/0", str(out.parent))


def inject(sources: list[str], unit: str, out: Path) -> None:
    """The motion of all sources with the errors of one unit, as one dataset."""
    words = ("dataset=semi_real", "imu=automotive_mems", "dataset.imu_errors=one", f"dataset.unit_seed={unit}")
    rows = []
    with new_dataset(out, False) as folder:
        for k, source in enumerate(sources):
            part = folder / f"part{k}"
            run("simulate", *words, f"source={source}", f"seed={unit}", f"out={part}")
            rows += pd.read_parquet(part / "drives.parquet").to_dict("records")
            for table in ("imu", "gnss", "reference"):
                shutil.copytree(part / table, folder / table, dirs_exist_ok=True)
            shutil.rmtree(part)
        write_drives_table(folder, rows)


if __name__ == "__main__":
    main()
