"""Filters and starts whose receiver or IMU is wrong: outages and headings of real and simulated drives with errors.

    python -m pipelines.studies.wrong_sensors --real <folder with kitti, rtkx, wid, wid_mru, linkoping>

From the first on, fixes get errors that the reported 1σ does not know: positions off by 3, 1 or 30 m (1σ per axis) in
some seconds, by one error of 3 m for ten seconds about every 50 s, by 0.3, 1 or 3 m in all, or by 1 m that wanders over
30 s; velocities off by 5 m/s in some, by 0.5 m/s in all, or those of a second before; or the receiver extrapolates for
five seconds about every 50 s, its velocity as it was or noisy, or averages two positions. Or it says that ten seconds
of fixes are worse. Or the IMU has a turn-on bias, of random direction, beside its own, gyroscopes whose scale factors
are 1 or 3 % off, or biases that step. Or the files are wrong: stamps of fixes 0.1 or 0.3 s late, clocks 100 or 300 ppm
apart, an antenna 1.4 m from where the lever arm says, one of 500 samples of a sensor spoiled.

``outages.md``: the outages of :mod:`pipelines.studies.plus` on real motion and on ``fleet``; the entirely real drives
start on the wrong data, alone with biases (elsewhere the start is the truth with an error, which shows no bias). RMS /
geometric mean of the horizontal error at the end over the rows [m] and mean NEES, of constants without a gate and with
it and of ``plus``, and its ratios to the best constants with a gate and to itself without delay and antenna,
geometric mean over all outages with a 95 % interval over recordings.

``starts.md``: yaw at the start against the reference attitude, or where a drive has none that of ``plus`` on the same
drive without errors; as a stream starts (``align.search_s=20``) and from rest (``align.from_rest=true`` beside it).
"""

from __future__ import annotations

import argparse
import json
import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from pipelines.studies.ablations.plus_parts import parts
from pipelines.studies.aids import ratio
from pipelines.studies.faults.errors import ERRORS, OF_IMU, OF_VELOCITIES, with_errors
from pipelines.studies.plus import REAL, SOURCES, Row, load, real_cases, recorded, score, simulated_cases
from pipelines.studies.simulated_laws import INJECTED, simulate_sets
from torch import Tensor

from dlkf.base.errors import InputError
from dlkf.base.provenance import describe_provenance
from dlkf.command.composing import imu_preset, tuning_preset
from dlkf.data.alignment import SEARCH, Start
from dlkf.data.drive import Drive
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.segments import whole_drives
from dlkf.data.store import drive_from_tables, drive_rows
from dlkf.data.validate import CheckedTables, read_drive
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_causal
from dlkf.filters.integration import Estimator
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.attitude import vector_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.running.start import align_each

FLEET, BASE, STATISTICS = "fleet", "mbkf33_car", ("rms", "log")
POSITIONS_ALONE, WITH_VELOCITIES = ("wid", "wid_mru", "puck"), ("fleet", "phone")  # datasets of starts
DRAWS, START_S, MOST_STARTS = 5, 150, 12
FROM_REST = replace(SEARCH, from_rest=True)
SPIKED = 1 / 500
WIDE_ACCEL = {"turn_on_bias": 0.5}  # m/s², 1σ
WIDE_GYRO = {"turn_on_bias": math.radians(2.0), "scale_factor": 0.02}
WRONG_ARM = (1.0, 0.5, -0.8)  # m


def spikes(accel: float, gyro: float) -> Callable[[CheckedTables], CheckedTables]:
    """Errors of 1σ [m/s², rad/s] per axis in some samples, always the same."""

    def change(tables: CheckedTables) -> CheckedTables:
        g = np.random.default_rng(zlib.crc32(tables.row.name.encode()))
        t = tables.imu["t"]
        hit = g.random(len(t)) < SPIKED
        off = hit * np.repeat((accel, gyro), 3)[:, None] * g.standard_normal((6, len(t)))
        return replace(tables, imu={**tables.imu, **{c: tables.imu[c] + x for c, x in zip((*ACCEL, *GYRO), off)}})

    return change


def stamped_late(seconds: float) -> Callable[[CheckedTables], CheckedTables]:
    """Stamps of fixes so late."""
    return lambda tables: replace(tables, gnss={**tables.gnss, "t": tables.gnss["t"] + seconds})


def clocks_apart(ppm: float) -> Callable[[CheckedTables], CheckedTables]:
    """A receiver's clock that runs so much faster than the IMU's."""

    def change(tables: CheckedTables) -> CheckedTables:
        t = tables.gnss["t"]
        return replace(tables, gnss={**tables.gnss, "t": t + 1e-6 * ppm * (t - t[0])})

    return change


def antenna_elsewhere(tables: CheckedTables) -> CheckedTables:
    """A lever arm that is wrong by :data:`WRONG_ARM`."""
    arm = tuple(x + off for x, off in zip(tables.row.lever_arm_b, WRONG_ARM))
    return replace(tables, row=replace(tables.row, lever_arm_b=arm))


OF_FILES: Mapping[str, Callable[[CheckedTables], CheckedTables]] = {
    "fixes stamped 0.1 s late": stamped_late(0.1),
    "0.3 s late": stamped_late(0.3),
    "clocks 100 ppm apart": clocks_apart(100.0),
    "300 ppm apart": clocks_apart(300.0),
    "antenna 1.4 m elsewhere": antenna_elsewhere,
    "accelerometers: 15 m/s² in one of 500 samples": spikes(15.0, 0.0),
    "gyroscopes: 1 rad/s in one of 500 samples": spikes(0.0, 1.0),
}


KINDS = (*ERRORS, *OF_FILES)


def from_wrong_files(folder: Path, kind: str) -> list[Drive]:
    """The drives of a dataset whose files are wrong."""
    tables = [OF_FILES[kind](read_drive(folder, row)) for row in drive_rows(folder)]
    return [drive_from_tables(one, "", 50.0, 1.0, torch.float64) for one in tables]


def rivals() -> dict[str, Estimator]:
    """Constants of ``any_car`` without a gate, with it, with it but without delay and antenna, and with it and wide
    priors of the IMU; of ``gradient`` with a gate; ``plus`` without delay and antenna; ``plus``."""
    imu, tuning = imu_preset("automotive_mems"), tuning_preset("any_car")
    plain, gated = f"{BASE}{SOURCES}", f"{BASE}_gated{SOURCES}"
    fixed = gated.replace("+receiver", "")
    filters = {f"{n} any_car": build_causal(n, imu, "no", tuning=tuning) for n in (plain, gated, fixed)}
    wide = replace(imu, accel=replace(imu.accel, **WIDE_ACCEL), gyro=replace(imu.gyro, **WIDE_GYRO))
    filters[f"{gated} any_car, wide priors"] = build_causal(gated, wide, "no", tuning=tuning)
    filters[f"{gated} gradient"] = build_causal(gated, imu, "no", tuning=tuning_preset("gradient"))
    without = "no delay and antenna"
    return {**filters, f"plus, {without}": parts("plus")[without], "plus": trained_filter("plus")}


def outage_rows(
    name: str, folder: Path, filters: Mapping[str, Estimator], kinds: Sequence[str]
) -> Iterator[tuple[str, str, Row]]:
    """Where, kind of error and row of those of ``kinds`` that a dataset can have."""
    drives = load(folder)
    moves = any(bool(d.gnss_valid[:, 3:].any()) for d in drives)
    for kind in kinds:
        if (kind in OF_VELOCITIES and not moves) or (kind in OF_IMU and name not in REAL):
            continue
        wrong = from_wrong_files(folder, kind) if kind in OF_FILES else [with_errors(d, kind) for d in drives]
        for case in real_cases(name, wrong) if name in REAL else simulated_cases(name, wrong):
            for row in score(case, filters):
                if kind not in OF_IMU:
                    yield "simulated" if name == FLEET else "real motion", kind, row
                if name in REAL and (kind in OF_IMU or kind == "none"):
                    yield "real drives", kind, row


def table(rows: Mapping[tuple[str, str], list[Row]]) -> list[str]:
    """A line for each kind of error; the ratios of ``plus`` to the best constants with a gate, chosen with hindsight,
    and to itself without delay and antenna."""
    names = list(next(iter(rows.values()))[0].errors)
    ratios = ["`plus` : the best with a gate", f"`plus` : `{names[-2]}`"]
    lines = [
        f"| | errors | rows | {' | '.join((*names, *ratios))} |",
        f"|:--|:--|{'--:|' * (len(names) + 3)}",
    ]
    for (where, kind), some in rows.items():
        cells = []
        for name in names:
            rms, geometric = (
                np.exp(np.mean([np.log(mean_error(r.errors[name], s)) for r in some])) for s in STATISTICS
            )
            cells.append(f"{rms:.1f} / {geometric:.2f} ({np.mean([r.nees[name] for r in some]):.1f})")
        ours, without, *gated = (
            np.concatenate([r.errors[name] for r in some]) for name in (*names[:-3:-1], *names[1:-2])
        )
        best = min(gated, key=lambda errors: mean_error(errors, "log"))
        groups = [f"{recorded(r.name)} {g}" for r in some for g in r.groups]
        cells += [ratio(ours, other, groups) for other in (best, without)]
        lines.append(f"| {where} | {kind} | {len(some)} | {' | '.join(cells)} |")
    return lines


def attitude(drive: Drive, start: Start) -> Tensor:
    """C_eb (rows, 3, 3): the reference's, or that of ``plus`` from a start on; NaN where there is none."""
    if bool(drive.ref_C_eb.isfinite().any()):
        return drive.ref_C_eb
    with torch.inference_mode():
        plus = compile_filter(trained_filter("plus"), drive.rate_hz, drive.epoch_s)
        C_nb = plus.integrate(whole_drives([drive], [start])).posterior.C_nb[0]
    C_eb = torch.full((drive.epochs + 1, 3, 3), torch.nan, dtype=torch.float64)
    C_eb[start.first] = _axes(start) @ start.state.C_nb
    C_eb[start.first + 1 :] = _axes(start) @ C_nb.double()
    return C_eb


def _axes(start: Start) -> Tensor:
    return ned_axes(*torch.tensor([start.lat, start.lon], dtype=torch.float64))


def start_table(sets: Mapping[str, Sequence[Drive]]) -> list[str]:
    """A line for each dataset, way to start and kind of error."""
    head = ["data", "start", "errors", "starts", "median [°]", "largest [°]", "over 10°", "RMS / 1σ", "first at [s]"]
    lines = [f"| {' | '.join(head)} |", f"|:--|:--|:--|{'--:|' * (len(head) - 3)}"]
    for name, drives in sets.items():
        found = align_each(drives, FROM_REST)
        truth = {d.name: attitude(d, s) for d, s in zip(drives, found) if not isinstance(s, InputError)}
        for way, config in (("stream", SEARCH), ("from rest", FROM_REST)):
            for kind in ERRORS:
                if (kind in OF_VELOCITIES) == (name in WITH_VELOCITIES) or kind == "none":
                    lines.append(_start_line(f"{name} | {way} | {kind}", drives, kind, config, truth))
                    print(lines[-1], flush=True)
    return lines


def _start_line(said: str, drives: Sequence[Drive], kind: str, config, truth: Mapping[str, Tensor]) -> str:
    off, ratio, first = [], [], []
    for draw in range(1 if kind == "none" else DRAWS):
        wrong = [with_errors(d, kind, draw) for d in drives if d.name in truth]
        for d, start in zip(wrong, align_each(wrong, config)):
            if isinstance(start, InputError) or not bool(truth[d.name][start.first].isfinite().all()):
                continue
            C = start.state.C_nb @ (_axes(start).mT @ truth[d.name][start.first]).mT
            off.append(abs(float(torch.rad2deg(vector_from_rotation(C)[2]))))
            ratio.append(off[-1] / float(torch.rad2deg(start.std[8])))
            first.append(start.first * d.epoch_s)
    over, rms = np.mean(np.array(off) > 10), np.sqrt(np.mean(np.square(ratio)))
    spread = f"{np.median(off):.1f} | {max(off):.0f} | {100 * over:.0f} %"
    return f"| {said} | {len(off)} | {spread} | {rms:.1f} | {np.mean(first):.1f} |"


def beginnings(name: str, drives: Sequence[Drive]) -> list[Drive]:
    """The first minutes of some drives, without velocities where those are not of interest."""
    some = [d.part(0, min(d.epochs, START_S)) for d in drives[:: max(1, len(drives) // MOST_STARTS)][:MOST_STARTS]]
    keep = torch.arange(6) < (6 if name in WITH_VELOCITIES else 3)
    return [replace(d, gnss_valid=d.gnss_valid & keep) for d in some]


def main() -> None:
    """Add errors, run, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, required=True, help="folder of real datasets")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where test sets lie, or are made")
    arguments.add_argument("--out", type=Path, default=Path("outputs/wrong_sensors"))
    arguments.add_argument("--errors", nargs="+", choices=KINDS, help="these kinds alone, without starts")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    names = (*INJECTED, *REAL, *WITH_VELOCITIES, "puck")
    simulate_sets(options.data, options.real, [name for name in names if name not in REAL])
    folders = {name: (options.real if name in REAL else options.data) / name for name in names}
    if not options.errors:
        sets = {name: beginnings(name, load(folders[name])) for name in (*POSITIONS_ALONE, *WITH_VELOCITIES)}
        (options.out / "starts.md").write_text("\n".join(start_table(sets)) + "\n")
    filters, rows = rivals(), {}
    for name in (*INJECTED, *REAL, FLEET):
        for where, kind, row in outage_rows(name, folders[name], filters, options.errors or KINDS):
            rows.setdefault((where, kind), []).append(row)
        print(name, flush=True)
    order = ("real motion", "real drives", "simulated")
    rows = dict(sorted(rows.items(), key=lambda x: (order.index(x[0][0]), KINDS.index(x[0][1]))))
    (options.out / "outages.md").write_text("\n".join(table(rows)) + "\n")
    (options.out / "manifest.json").write_text(json.dumps(describe_provenance(), indent=1) + "\n")


if __name__ == "__main__":
    main()
