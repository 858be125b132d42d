"""Dead reckoning on KITTI's odometry recordings, by KITTI's own measure: ``python -m pipelines.studies.kitti_odometry
--real ../shared/data/real``.

A drive starts from the truth and has no fix afterwards: IMU and a car's constraints alone, as in AI-IMU (Brossard et
al. 2020: 1.10 %). An error is that of a relative pose over 100, 200, … 800 m, from a first pose every second, as a
share of the length (KITTI's devkit, ``evaluate_odometry.cpp``). The constants of a filter are those that are best on
the *other* recordings, of the same grid for all. What is different from AI-IMU is in docs/results/published.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dlkf.command.composing import imu_preset
from dlkf.data.drive import Batch, Drive
from dlkf.data.masks import find_runs
from dlkf.data.segments import Segment, StartLaw, make_batch
from dlkf.data.store import load_dataset
from dlkf.data.tables import read_drives
from dlkf.filters.smoother import Filter
from dlkf.filters.tuning import Tuning
from dlkf.running.batched import run_filter
from dlkf.tracking.models import resolve_model

LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
SEQUENCES = {  # KITTI's numbers of the recordings that are odometry sequences; 02, 03 and 09 are not among the data
    "10-03-0027": "00", "10-03-0042": "01", "09-30-0016": "04", "09-30-0018": "05", "09-30-0020": "06",
    "09-30-0027": "07", "09-30-0028": "08", "09-30-0034": "10",
}  # fmt: skip
WITH_GAPS = ("00", "05")  # in the IMU, so that each is several drives
START = StartLaw(position_m=0.01, velocity_mps=0.05, roll_pitch_deg=0.05, yaw_deg=0.1)  # settings of a filter
FACTORS = {  # of the Tuning that is searched: a grid
    "lateral_std": (0.05, 0.1, 0.15, 0.2, 0.3), "vertical_std": (0.1, 0.15, 0.2, 0.3, 0.45),
    "accel_noise": (1.0, 3.0), "gyro_noise": (1.0, 3.0),
}  # fmt: skip


class SegmentErrors(NamedTuple):
    """Of the relative poses: nominal length [m], error of translation [share], of rotation [rad/m]."""

    length_m: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray


def segment_errors(
    p: np.ndarray,
    C: np.ndarray,
    true_p: np.ndarray,
    true_C: np.ndarray,
    lengths: np.ndarray | Sequence[float] = LENGTHS_M,
) -> SegmentErrors:
    """Errors of relative poses, as KITTI's devkit has them.

    From every pose i to the first j whose true way is more than L further, with ΔC = C_iᵀC_j and Δp = C_iᵀ(p_j − p_i)
    of the estimate and of the truth: |Δp_true − Δp| and the angle of ΔCᵀΔC_true, over the length. The length is the way
    from i to j; the devkit takes L, whose poses are 0.1 s apart and so the same. Poses are positions (T, 3) [m] and
    rotations (T, 3, 3) into the same axes; a way that is shorter than L has no error.
    """
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(true_p, axis=0), axis=-1))))
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for length in lengths:
        last = np.searchsorted(way, way + length, side="right")
        i = np.flatnonzero(last < len(way))
        j = last[i]

        def relative(x: np.ndarray, R: np.ndarray, i: np.ndarray = i, j: np.ndarray = j):
            back = np.swapaxes(R[i], -1, -2)
            return np.einsum("tij,tj->ti", back, x[j] - x[i]), back @ R[j]

        (dp, dC), (true_dp, true_dC) = relative(p, C), relative(true_p, true_C)
        cosine = (np.einsum("tij,tij->t", dC, true_dC) - 1) / 2
        driven = way[j] - way[i]
        errors = np.linalg.norm(true_dp - dp, axis=-1) / driven, np.arccos(np.clip(cosine, -1, 1)) / driven
        found.append((np.full(len(i), float(length)), *errors))
    return SegmentErrors(*(np.concatenate(x) for x in zip(*found)))


def dead_reckoning(drives: Sequence[Drive]) -> Batch:
    """Each drive's longest time with a known attitude, from the truth, without a fix."""
    known = [(d.ref_valid & d.ref_C_eb.isfinite().flatten(1).all(-1)).numpy() for d in drives]
    runs = [max(find_runs(x), key=lambda run: run[1] - run[0]) for x in known]
    parts = [Segment(k, first, last - 1 - first) for k, (first, last) in enumerate(runs)]
    batch = make_batch(drives, parts, start=StartLaw(0, 0, 0, 0))
    nothing = torch.zeros_like(batch.available)
    std = START.std.expand(len(drives), 9)
    return replace(batch, available=nothing, start_std=std).in_precision(torch.float64)


def errors_of(batch: Batch, estimator: Filter) -> list[SegmentErrors]:
    """Of each drive of a batch."""
    with torch.inference_mode():
        state = run_filter(batch, estimator).posterior
    found = []
    for k in range(batch.size[0]):
        n = int(batch.present[k].sum())
        start = [x[k : k + 1] for x in (batch.start.p_n, batch.start.C_nb)]

        def poses(p: torch.Tensor, C: torch.Tensor, k: int = k, n: int = n, start: list[torch.Tensor] = start):
            return [torch.cat((a, x[k, :n])).double().numpy() for a, x in zip(start, (p, C))]

        found.append(segment_errors(*poses(state.p_n, state.C_nb), *poses(batch.truth.p_n, batch.truth.C_nb)))
    return found


def joined(errors: Sequence[SegmentErrors]) -> SegmentErrors:
    """Of several drives together."""
    return SegmentErrors(*(np.concatenate(x) for x in zip(*errors)))


def candidates() -> list[Tuning]:
    """The default factors, and the grid of :data:`FACTORS`."""
    return [Tuning(), *(Tuning(**dict(zip(FACTORS, point))) for point in product(*FACTORS.values()))]


def left_out_best(errors: Sequence[Sequence[SegmentErrors]], sequence: Sequence[str]) -> dict[str, int]:
    """For each sequence the candidate with the least mean error over the segments of all others."""
    chosen = {}
    for name in dict.fromkeys(sequence):
        others = [k for k, s in enumerate(sequence) if s != name]
        means = [float(np.mean(joined([of[k] for k in others]).translation)) for of in errors]
        chosen[name] = int(np.argmin(means))
    return chosen


def print_row(name: str, errors: dict[str, SegmentErrors]) -> None:
    """A row: translational error [%] of each sequence, of all, of those without gaps, and rotation [°/km]."""
    every, counted = joined(list(errors.values())), [e for s, e in errors.items() if s not in WITH_GAPS]
    cells = [f"{100 * e.translation.mean():.2f}" if len(e.translation) else "–" for e in errors.values()]
    ends = [f"{100 * e.translation.mean():.2f} (n = {len(e.translation)})" for e in (every, joined(counted))]
    turned = f"{np.degrees(every.rotation.mean()) * 1000:.1f}"
    print(f"| {name} | {' | '.join((*cells, *ends, turned))} |", flush=True)


def by_sequence(errors: Sequence[SegmentErrors], sequence: Sequence[str]) -> dict[str, SegmentErrors]:
    """Drives of one recording together, in the order of KITTI's numbers."""
    return {s: joined([e for e, of in zip(errors, sequence) if of == s]) for s in sorted(set(sequence))}


def described(tuning: Tuning) -> str:
    """The searched factors, in the order of :data:`FACTORS`."""
    return "/".join(f"{getattr(tuning, name):g}" for name in FACTORS)


def main() -> None:
    """Run, choose, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--real", type=Path, required=True, help="folder of the real drives, with kitti/ in it")
    parser.add_argument("--imu", default="tactical_oxts", help="settings of the filters with constants")
    parser.add_argument("--models", nargs="+", default=["mbkf21_nhc", "mbkf21_car"], help="with constants")
    options = parser.parse_args()
    folder, spec = options.real / "kitti", imu_preset(options.imu)
    names = {row.name: row.group.removeprefix("kitti-2011-") for row in read_drives(folder)}
    chosen = {name: SEQUENCES[group] for name, group in names.items() if group in SEQUENCES}
    sequence = list(chosen.values())
    drives = load_dataset(folder, rate_hz=100.0, dtype=torch.float64, drives=list(chosen))
    batch = dead_reckoning(drives)
    step = np.linalg.norm(np.diff(batch.truth.p_n.numpy(), axis=1), axis=-1) * batch.present[:, 1:].numpy()
    km, minutes = np.nansum(step) / 1000, batch.present.sum().item() * batch.epoch_s / 60
    print(f"{len(drives)} drives of {len(set(sequence))} sequences, {km:.1f} km, {minutes:.0f} min")
    print(f"| filter | {' | '.join(sorted(set(sequence)))} | all [%] | without gaps [%] | rotation [°/km] |")
    print(f"|:--|{'--:|' * (len(set(sequence)) + 3)}")
    for model in ("ins", "plus", "plus_imu"):
        print_row(model, by_sequence(errors_of(batch, resolve_model(model, spec)), sequence))
    for model in options.models:
        tunings = candidates()
        errors = [errors_of(batch, resolve_model(model, spec, tuning=tuning)) for tuning in tunings]
        print_row(f"{model}, default constants", by_sequence(errors[0], sequence))
        best = left_out_best(errors, sequence)
        held_out = [errors[best[s]][k] for k, s in enumerate(sequence)]
        print_row(f"{model}, constants of the other sequences", by_sequence(held_out, sequence))
        at = min(range(len(tunings)), key=lambda c: float(np.mean(joined(errors[c]).translation)))
        print_row(f"{model}, constants of these sequences (a bound)", by_sequence(errors[at], sequence))
        print(f"  best of {len(tunings)} on all: {described(tunings[at])}; on the other sequences, for each:")
        print("  " + "; ".join(f"{s} {described(tunings[k])}" for s, k in sorted(best.items())), flush=True)


if __name__ == "__main__":
    main()
