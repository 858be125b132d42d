"""``plus`` on cars of other people: logs of public repositories as datasets, and the filters on them.

    python -m pipelines.studies.other_cars --logs logs --out outputs/other_cars
    python -m pipelines.studies.other_cars --logs logs --sets boston beijing kth --out outputs/held_out

Clones the repositories that are missing below ``--logs`` (``<owner>/<name>``), writes each log as a dataset below
``--out``, prints what its axes, signs and clocks are checked by, and scores the filters as
:func:`pipelines.studies.plus.real_cases` does: whole drives from their own alignment, outages of 30 and 60 s from 45,
300 and 600 s on. ``table.md`` has RMS / geometric mean of the horizontal error at the end of the outages [m], and in
brackets the mean NEES over them, and below, over all logs, the ratios of ``plus`` to the others; ``manifest.json`` the
commits and the digests of the datasets. None of the data may enter the project.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from pipelines.studies.ablations.plus_parts import parts
from pipelines.studies.aids import ratio
from pipelines.studies.cars.logs import LOGS, G
from pipelines.studies.plus import SOURCES, Row, constants, found_noise, load, real_cases, score

from dlkf.base.errors import InputError
from dlkf.base.provenance import describe_provenance
from dlkf.data.drive import Drive
from dlkf.data.intake import IngestOptions, ingest_drives
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.store import dataset_digest
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.shipped import trained_filter

FIXED = ("mbkf33_car any_car", f"mbkf33_car{SOURCES} any_car", f"mbkf33_car{SOURCES} gradient")
FOUND = f"mbkf21_car{SOURCES}"
BEFORE_S = (45, 300, 600)
SHORTEST_S = 110.0


def correlate(drive: DriveFrames) -> dict[str, tuple[float, float]]:
    """Correlation with the reference and slope against it, of seconds in motion: yaw rate against course, acceleration
    forward against speed and to the right against speed times course, each by its change."""
    assert drive.reference is not None
    imu, reference = drive.imu, drive.reference[drive.reference["valid"]]
    t, t_reference = imu["t"].to_numpy(), reference["t"].to_numpy()
    at = np.arange(np.ceil(max(t[0], t_reference[0])), min(t[-1], t_reference[-1]))
    v = np.interp(at, t_reference, reference["vel_n"]) + 1j * np.interp(at, t_reference, reference["vel_e"])
    speed, turn = np.abs(v), np.angle(v[1:] / np.where(v == 0, 1, v)[:-1])
    use = (np.minimum(speed[1:], speed[:-1]) > 3.0) & (np.abs(turn) < 0.8)
    truth = {"gyro_z": turn, "accel_x": np.diff(speed), "accel_y": turn * (speed[1:] + speed[:-1]) / 2}
    found = {}
    for name, expected in truth.items():
        gained = np.diff(np.interp(at, t, np.cumsum(imu[name] * np.diff(t, prepend=t[0]))))[use]
        found[name] = (np.corrcoef(gained, expected[use])[0, 1], np.polyfit(expected[use], gained, 1)[0])
    return found


def convert(name: str, logs: Path, folder: Path) -> list[str]:
    """Write a log as a dataset and return what its axes, signs and clocks are checked by; InputError on doubt."""
    lines, drives = [], list(LOGS[name].read(logs))
    for drive in drives:
        found = correlate(drive)
        down = float(drive.imu["accel_z"].mean())
        shown = "; ".join(f"{axis} r {r:.3f}, slope {slope:.2f}" for axis, (r, slope) in found.items())
        line = f"{name}/{drive.name}: accel_z {down:.2f} m/s² in the mean; {shown}"
        if abs(down + G) >= 0.6 or min(r for r, _ in found.values()) <= 0.7:
            raise InputError(f"axes, signs or clocks are not those of the log that this was written for: {line}")
        lines.append(line)
        drive.meta.update(source=" ".join(LOGS[name].repositories), licence="of the repository")
    ingest_drives(drives, folder, IngestOptions(split_gaps=True), overwrite=True)
    return lines


def clone(repository: str, logs: Path) -> None:
    """A repository of GitHub with its history below ``logs``, if it is not there."""
    if not (logs / repository).is_dir():
        url = f"https://github.com/{repository}"
        subprocess.run(["git", "clone", "--filter=blob:none", url, str(logs / repository)], check=True)


def load_long(folder: Path) -> list[Drive]:
    """Drives of a dataset, without those that the gaps of a log have left short."""
    return [drive for drive in load(folder) if drive.epochs * drive.epoch_s > SHORTEST_S]


def markdown(rows: Sequence[Row]) -> list[str]:
    """RMS / geometric mean and, in brackets, mean NEES of every filter."""
    names = list(rows[0].errors)
    lines = [f"| log | GNSS [s] | outage [s] | outages | {' | '.join(names)} |", f"|:--|{'--:|' * (3 + len(names))}"]
    for row in rows:
        cells = [f"`{row.name}`", str(row.before_s), str(row.length_s), str(len(row.groups))]
        for name, e in row.errors.items():
            cells.append(f"{mean_error(e, 'rms'):.1f} / {mean_error(e, 'log'):.2f} ({row.nees[name]:.1f})")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def pooled(rows: Sequence[Row]) -> list[str]:
    """``plus`` : each other filter, ratios of geometric means and of RMS over all outages, with intervals over
    recordings."""
    names = [name for name in rows[0].errors if name != "plus"]
    lines = [f"| GNSS [s] | outages (recordings) | {' | '.join(names)} |", f"|--:|--:|{'--:|' * len(names)}"]
    for before_s in BEFORE_S:
        some = [row for row in rows if row.before_s == before_s]
        if not some:
            continue
        groups = [f"{row.name} {group}" for row in some for group in row.groups]
        errors = {name: np.concatenate([row.errors[name] for row in some]) for name in (*names, "plus")}
        ratios = [
            "; ".join(ratio(errors["plus"], errors[name], groups, kind) for kind in ("geomean", "rms"))
            for name in names
        ]
        lines.append(f"| {before_s} | {len(groups)} ({len(set(groups))}) | {' | '.join(ratios)} |")
    return lines


def main() -> None:
    """Clone, convert, check, score, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--logs", type=Path, default=Path("logs"), help="where the clones lie, or are put")
    arguments.add_argument("--sets", nargs="+", choices=LOGS, default=list(LOGS), help="only these logs")
    arguments.add_argument("--parts", action="store_true", help="and plus without a part")
    arguments.add_argument("--out", type=Path, default=Path("outputs/other_cars"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    digests = {}
    for name in options.sets:
        for repository in LOGS[name].repositories:
            clone(repository, options.logs)
        print("\n".join(convert(name, options.logs, options.out / name)), flush=True)
        drives, digests[name] = load_long(options.out / name), dataset_digest(options.out / name)
        same = constants()
        filters = {n: same[n] for n in FIXED} | {"plus": trained_filter("plus")} | found_noise(drives, [FOUND])
        filters |= parts("plus") if options.parts else {}
        for before_s in BEFORE_S:
            for case in real_cases(name, drives, before_s, LOGS[name].every_s):
                rows += score(case, filters)
                print(markdown(rows[-1:])[-1], flush=True)
    lines = [*markdown(rows), "", *pooled(rows)]
    (options.out / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines[-4:]))
    made = {**describe_provenance(), "digests": digests}
    (options.out / "manifest.json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
