"""An attitude reference for drives that have none: a Kalman filter over the whole drive, smoothed backwards.

    python -m pipelines.studies.attitude_reference data/town data/town_attitude --imu consumer
    python -m pipelines.studies.attitude_reference data/town --imu consumer    # check only, where attitude is known

Roll, pitch and yaw of the reference are filled in where they are NaN; everything else is copied. The figures printed
compare smoother and filter with the attitudes that the reference does have. Filter and smoother run on ``--epoch``
seconds, between which attitude is interpolated on the sphere.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import torch
import yaml
from scipy.spatial.transform import Rotation, Slerp

from dlkf.config import config_dir
from dlkf.data.schema import ATTITUDE, drive_file, new_dataset, write_drive, write_drives_table
from dlkf.data.store import load_dataset
from dlkf.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.smoother import smoothed
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.offline import navigate_drives

RPY = ["roll", "pitch", "yaw"]


def attitude_at(solution: pd.DataFrame, t: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw [rad] of a solution at times inside it, NaN outside (n, 3)."""
    at = np.asarray(t, dtype=float)
    known = solution.t.to_numpy()
    angles = solution[RPY[::-1]].to_numpy()
    turns = Slerp(known, Rotation.from_euler("ZYX", angles))  # pyright: ignore[reportArgumentType]  a stack of n
    inside = (at >= known[0]) & (at <= known[-1])
    out = np.full((len(at), 3), np.nan)
    out[inside] = turns(at[inside]).as_euler("ZYX")[:, ::-1]
    return out


def errors(found: np.ndarray, reference: pd.DataFrame) -> np.ndarray:
    """Attitude differences [rad] where both are known and valid (n, 3)."""
    known = reference[RPY].to_numpy(dtype=float)
    both = np.isfinite(found).all(1) & np.isfinite(known).all(1) & reference.valid.to_numpy()
    difference = found[both] - known[both]
    return np.arctan2(np.sin(difference), np.cos(difference))


def main() -> int:
    """Run, fill in, print."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("out", type=Path, nargs="?")
    arguments.add_argument("--model", default="mbkf21_car")
    arguments.add_argument("--imu", default="automotive_mems")
    arguments.add_argument("--velocity-std", type=float, default=1.0, help="tuning.velocity_std")
    arguments.add_argument("--rate-hz", type=float, default=50.0)
    arguments.add_argument("--epoch", type=float, default=0.2)
    options = arguments.parse_args()
    try:
        found = solutions(options)
        frames = {name: read(options.dataset, "reference", name) for name in found["smoothed"]}
        report(found, frames)
        if options.out is not None:
            write(options, found["smoothed"], frames)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def solutions(options: argparse.Namespace) -> dict[str, dict[str, pd.DataFrame]]:
    """Solution tables by drive of the filter and of its smoother."""
    preset = config_dir() / "imu" / f"{options.imu}.yaml"
    if not preset.is_file():
        raise InputError(f"unknown IMU preset {options.imu!r}; they are the files of conf/imu")
    spec = imu_spec(yaml.safe_load(preset.read_text()))
    rules = options.epoch**-0.5  # a rule applied more often says no more about a drive
    tuning = Tuning(velocity_std=options.velocity_std, lateral_std=0.2 * rules, vertical_std=0.2 * rules)
    filter = build_filter(options.model, spec, tuning=tuning)
    drives = load_dataset(
        options.dataset, rate_hz=options.rate_hz, epoch_s=options.epoch, dtype=torch.float64, reference=False
    )
    skipped: dict[str, str] = {}
    found = {
        kind: {r.drive: r.table for r in navigate_drives(drives, model, skipped=skipped)}
        for kind, model in (("filtered", filter), ("smoothed", smoothed(filter, "rts")))
    }
    for reason in skipped.values():
        print(f"left out: {reason}")
    return found


def read(dataset: Path, kind: str, drive: str) -> pd.DataFrame:
    """A table of a drive."""
    path = drive_file(dataset, kind, drive)
    if not path.is_file():
        raise InputError(f"drive {drive}: has no {kind}; nothing to fill in")
    return pq.ParquetFile(path).read().to_pandas()


def report(found: dict[str, dict[str, pd.DataFrame]], frames: dict[str, pd.DataFrame]) -> None:
    """RMS of roll, pitch and yaw against the attitudes that are known."""
    for kind, tables in found.items():
        rows = np.concatenate([errors(attitude_at(tables[d], f.t.to_numpy()), f) for d, f in frames.items()])
        if not len(rows):
            print("the reference knows no attitude to compare with")
            return
        rms = np.degrees(np.sqrt(np.mean(rows**2, 0)))
        shown = ", ".join(f"{name} {x:.2f}°" for name, x in zip(RPY, rms))
        print(f"{kind}: {shown} RMS over {len(rows)} rows of {len(frames)} drives")


def write(options: argparse.Namespace, tables: dict[str, pd.DataFrame], frames: dict[str, pd.DataFrame]) -> None:
    """The dataset with its missing attitudes filled in."""
    rows = pq.ParquetFile(options.dataset / "drives.parquet").read().to_pandas()
    written = []
    with new_dataset(options.out) as folder:
        for row in rows[rows.drive.isin(list(tables))].to_dict("records"):
            name = row["drive"]
            frame = frames[name]
            made = attitude_at(tables[name], frame.t.to_numpy())
            unknown = ~np.isfinite(frame[RPY].to_numpy(dtype=float)).all(1)
            frame.loc[unknown, list(ATTITUDE)] = made[unknown]
            row["reference"] += f"; attitude: {options.model} smoothed, IMU preset {options.imu}"
            imu, gnss = (read(options.dataset, kind, name) for kind in ("imu", "gnss"))
            written.append(write_drive(folder, row, imu, gnss, frame))
        write_drives_table(folder, written)
    print(f"{options.out}: attitude filled in for {len(written)} drives")


if __name__ == "__main__":
    sys.exit(main())
