"""Coning and sculling, what they cost and what loading wins back.

    python -m pipelines.studies.coning_sculling data/clean

First motions with a closed form: coning of 1° half-angle (drift of the attitude), and a roll of 0.5° in step with a
lateral push of 2 m/s² (drift of the velocity). *Plain* are the means that a sensor of that rate gives, *loaded* the
samples made of them (:mod:`dlkf.data.increments`), at the sensor's own rate or merged to a lower one.

Then drives simulated without IMU errors at 100 Hz (``dlkf.simulate imu=perfect``): 60 s of pure inertial navigation
from the truth, horizontal error at the end, RMS. *Averaged* to a rate; *loaded* at it from 100 Hz; *low-rate sensor*:
averaged, then loaded at its own rate.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dlkf.data.drive import Drive
from dlkf.data.resampling import Grid, resample_imu
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.segments import StartLaw, cut_pieces, make_batch
from dlkf.data.store import drive_from_tables, load_dataset
from dlkf.data.tables import Columns, read_drives
from dlkf.data.validate import DriveTables, read_checked
from dlkf.filters.model_based import Ins
from dlkf.running.batched import run_filter

CHANNELS = (*ACCEL, *GYRO)
SECONDS = 20
CONING, ROLL, PUSH = math.radians(1.0), math.radians(0.5), 2.0
EXACT = StartLaw(position_m=0, velocity_mps=0, roll_pitch_deg=0, yaw_deg=0)


def coning(hz: float) -> Callable[[np.ndarray], np.ndarray]:
    """Integral (n, 6) of force and rate of an axis that describes a cone."""
    a, w = CONING, 2 * math.pi * hz
    return lambda t: np.stack(
        (0 * t, 0 * t, 0 * t, np.sin(a) * np.cos(w * t), np.sin(a) * np.sin(w * t), -w * (1 - np.cos(a)) * t), -1
    )


def sculling(hz: float) -> Callable[[np.ndarray], np.ndarray]:
    """Integral (n, 6) of a lateral push in step with a roll; downwards it gains PUSH · ROLL / 2."""
    w = 2 * math.pi * hz
    zero = np.zeros_like
    return lambda t: np.stack(
        (zero(t), -PUSH / w * np.cos(w * t), zero(t), ROLL * np.sin(w * t), zero(t), zero(t)), -1
    )


def sampled(integral: Callable[[np.ndarray], np.ndarray], rate: int) -> Columns:
    """What a sensor of a rate [Hz] gives: means over its intervals."""
    at = np.arange(SECONDS * rate + 1) / rate
    return {"t": at[1:], **dict(zip(CHANNELS, (np.diff(integral(at), axis=0) * rate).T))}


def averaged(imu: Columns, ratio: int) -> Columns:
    """Every ``ratio`` samples as their mean."""
    rows = len(imu["t"]) // ratio * ratio
    means = {c: imu[c][:rows].reshape(-1, ratio).mean(1) for c in CHANNELS}
    return {"t": imu["t"][:rows].reshape(-1, ratio)[:, -1], **means}


def moved(samples: np.ndarray, rate: int) -> tuple[float, float]:
    """Drift about the cone's axis [°/h] and downward gain [m/s²] of constant samples (n, 6)."""
    C, v = Rotation.identity(), np.zeros(3)
    for phi, u in zip(samples[:, 3:] / rate, samples[:, :3] / rate):
        once = np.cross(phi, u)
        v = v + C.apply(u + once / 2 + np.cross(phi, once) / 6)
        C = C * Rotation.from_rotvec(phi)
    return math.degrees(C.as_rotvec()[2]) / SECONDS * 3600, v[2] / SECONDS


def closed_forms() -> None:
    """Drift of plain and loaded samples of both motions."""
    print("| sensor → filter | motion | coning, plain [°/h] | loaded [°/h] | sculling, plain [mGal] | loaded [mGal] |")
    print("|:--|:--|--:|--:|--:|--:|")
    for native, rate, hz in ((10, 10, 1), (50, 50, 5), (100, 100, 5), (100, 50, 5), (100, 100, 10), (200, 50, 10)):
        drifts = []
        for motion, part in ((coning, 0), (sculling, 1)):
            imu = sampled(motion(hz), native)
            plain = np.stack([averaged(imu, native // rate)[c] for c in CHANNELS], -1)
            loaded = resample_imu(imu, Grid(0.0, 1.0, SECONDS, rate)).reshape(-1, 6)
            truth = (0.0, PUSH * ROLL / 2)[part]
            drifts += [(moved(x, rate)[part] - truth) * (1, 1e5)[part] for x in (plain, loaded)]
        print(f"| {native} → {rate} Hz | {hz} Hz | " + " | ".join(f"{x:.3g}" for x in drifts) + " |")


def inertial_error(drives: list[Drive]) -> float:
    """RMS of the horizontal error [m] after each 60 s of pure inertial navigation from the truth."""
    batch = make_batch(drives, cut_pieces(drives, 60.0), dtype=torch.float64, start=EXACT)
    end = run_filter(batch, Ins(free=True)).posterior.p_n[:, -1] - batch.truth.p_n[:, -1]
    return float(end[:, :2].square().sum(-1).mean().sqrt())


def simulated(folder: Path) -> None:
    """Pure inertial navigation at lower rates than that of the file."""
    tables = [read_checked(folder, row, reference=True) for row in read_drives(folder)]
    native = load_dataset(folder, rate_hz=100, dtype=torch.float64)
    print(f"\n{folder}, {len(cut_pieces(native, 60.0))} pieces; at 100 Hz {1e3 * inertial_error(native):.2f} mm")
    print("| rate | averaged [mm] | loaded from 100 Hz [mm] | low-rate sensor, loaded [mm] |\n|:--|--:|--:|--:|")

    def loaded(table: DriveTables, rate: int) -> Drive:
        return drive_from_tables(table, "", rate, 1.0, torch.float64)

    for rate in (50, 20, 10):
        means = [replace(d, rate_hz=rate, imu=d.imu.unflatten(1, (rate, -1)).mean(2)) for d in native]
        coarse = [replace(x, imu=averaged(x.imu, 100 // rate)) for x in tables]
        drives = means, [loaded(x, rate) for x in tables], [loaded(x, rate) for x in coarse]
        print(f"| {rate} Hz | " + " | ".join(f"{1e3 * inertial_error(x):.2f}" for x in drives) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="*", type=Path)
    closed_forms()
    for folder in parser.parse_args().datasets:
        simulated(folder)


if __name__ == "__main__":
    main()
