"""Why the network's lead shrinks with longer GNSS: attitude and IMU error swapped where an outage begins.

    python -m pipelines.studies.network_lead --model outputs/train/outage/<run>/best --dataset data/one_imu

A Kalman filter and a network run over the same segments with GNSS for 22, 60 and 300 s. From there pure strapdown goes
on for 40 s, from true position and velocity, with the attitude of one of them and the IMU error of one of them, held.
An attitude and an accelerometer error that belong together cancel, g δθ = δf: swapped, they do not. The table has the
horizontal error at the end (geometric mean [m]) and the RMS error of each estimate at the outage's start. ``mbkf15``
has the factors that are tuned for ``one_imu``. Drives on which the network was trained or chosen are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from dlkf.command.composing import imu_preset
from dlkf.data.drive import Batch, Drive
from dlkf.data.segments import cut_segments
from dlkf.data.store import load_dataset
from dlkf.evaluation.metrics import mean_error
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol, Scenes
from dlkf.filters.build import build_causal
from dlkf.filters.integration import BatchSolution, Estimator, integrate
from dlkf.filters.saved import load_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.state import ATTITUDE, NavState
from dlkf.navigation.strapdown import strapdown

SECONDS, OUTAGE_S, MOST = (22, 60, 300), 40, 60
TUNED = Tuning(accel_noise=30.0, accel_walk=100.0, velocity_std=0.5)  # docs/results/paper.md, a minute without GNSS
PAIRS = (("mbkf15", "mbkf15"), ("dlkf", "dlkf"), ("mbkf15", "dlkf"), ("dlkf", "mbkf15"))  # attitude, IMU error
COLUMNS = ("GNSS [s]", "n", *(f"attitude {a}, IMU error {e} [m]" for a, e in PAIRS), "mbkf15 itself", "dlkf itself")
ERRORS = ("GNSS [s]", "filter", "tilt [°]", "accelerometer, level [m/s²]", "gyroscope [°/s]", "heading [°]")


def main() -> int:
    """Two tables."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--model", required=True, type=Path, help="folder of a network trained on one unit")
    arguments.add_argument("--dataset", required=True, type=Path, help="simulated drives with that unit")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    network = load_filter(options.model)
    seen = {*network.card.get("trained_on", ()), *network.card.get("chosen_on", ())}
    rows = pd.read_parquet(options.dataset / "drives.parquet", columns=["drive", "group"])
    names = rows.drive[~rows.group.isin(seen)].tolist()
    drives = load_dataset(options.dataset, rate_hz=50, epoch_s=1.0, dtype=torch.float64, drives=names, progress=None)
    filters = {"mbkf15": build_causal("mbkf15", imu_preset("automotive_mems"), "", tuning=TUNED), "dlkf": network}
    ends: list[tuple[str, ...]] = [COLUMNS]
    errors: list[tuple[str, ...]] = [ERRORS]
    for seconds in SECONDS:
        end, error = at_outage(filters, drives, seconds)
        ends.append(
            (f"{seconds}", f"{len(end['dlkf', 'dlkf'])}", *(f"{mean_error(x, 'log'):.3g}" for x in end.values()))
        )
        errors += [(f"{seconds}", name, *(f"{x:.2g}" for x in sizes)) for name, sizes in error.items()]
    print("\n".join("\t".join(row) for row in [*ends, *errors]))
    return 0


def at_outage(
    filters: dict[str, Estimator], drives: Sequence[Drive], seconds: int
) -> tuple[dict[tuple[str, str], np.ndarray], dict[str, list[float]]]:
    """Horizontal errors [m] at the end of the outages, of the pairs and of the filters themselves; RMS errors of the
    estimates where the outage begins."""
    length = float(seconds + OUTAGE_S + 5)
    plan = OutagePlan(float(seconds), float(OUTAGE_S), offsets_s=(0.0,))
    segments = cut_segments(drives, length)
    scenes = Scenes(drives, Protocol("segments", length, length, outage=plan), segments=segments, limit=MOST)
    ends: dict[tuple[str, str], list[np.ndarray]] = {pair: [] for pair in (*PAIRS, ("mbkf15", ""), ("dlkf", ""))}
    sizes: dict[str, list[np.ndarray]] = {name: [] for name in filters}
    for batch in scenes.withheld():
        with torch.inference_mode():
            given = {"mbkf15": batch, "dlkf": batch.in_precision(torch.float32)}
            runs = {name: integrate(given[name], f, keep_covariances=True) for name, f in filters.items()}
            truth = _at(batch.truth, seconds - 1)
            for name, run in runs.items():
                off = run.imu_error[:, seconds - 1].double() - batch.true_imu_error[:, seconds - 1]
                turn = _at(run.posterior, seconds - 1).error_to(truth)[:, ATTITUDE]
                sizes[name].append(torch.cat((off, turn), -1).numpy())
                ends[name, ""].append(_horizontal(_at(run.posterior, seconds + OUTAGE_S - 1), batch, seconds))
            for attitude, error in PAIRS:
                state = truth._replace(C_nb=_at(runs[attitude].posterior, seconds - 1).C_nb)
                ends[attitude, error].append(_horizontal(_drifted(state, runs[error], batch, seconds), batch, seconds))
    return {k: np.concatenate(x) for k, x in ends.items()}, {k: _rms(np.concatenate(x)) for k, x in sizes.items()}


def _drifted(state: NavState, run: BatchSolution, batch: Batch, seconds: int) -> NavState:
    """After the outage, by strapdown alone with the IMU error that a run had at its start."""
    assert run.error is not None
    bias, matrix = run.error.bias[:, seconds - 1].double(), run.error.matrix
    error = ImuError(bias, None if matrix is None else matrix[:, seconds - 1].double())
    frame = batch.frame.prepared()
    for imu in batch.imu[:, seconds : seconds + OUTAGE_S].unbind(1):
        state = strapdown(state, error.corrected(imu), batch.dt, frame).end
    return state


def _at(states: NavState, epoch: int) -> NavState:
    return NavState(*(x[:, epoch].double() for x in states))


def _horizontal(state: NavState, batch: Batch, seconds: int) -> np.ndarray:
    off: Tensor = state.p_n - batch.truth.p_n[:, seconds + OUTAGE_S - 1]
    return off[:, :2].norm(dim=-1).numpy()


def _rms(errors: np.ndarray) -> list[float]:
    """Tilt [°], level accelerometers [m/s²], gyroscopes [°/s], heading [°] of errors (n, 9)."""
    square = (errors**2).mean(0)
    tilt, level, gyro, heading = (square[k].mean() ** 0.5 for k in (slice(6, 8), slice(0, 2), slice(3, 6), slice(8, 9)))
    return [float(np.degrees(tilt)), float(level), float(np.degrees(gyro)), float(np.degrees(heading))]


if __name__ == "__main__":
    sys.exit(main())
