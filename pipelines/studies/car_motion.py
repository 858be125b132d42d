"""How cars move besides along their way, from any dataset with attitude: slip, springs, arm, mounting, vibration.

    python -m pipelines.studies.car_motion ../shared/data/real/kitti data/lifelike --longest 20

Per dataset, over its longest drives: velocity to the right and down in the axes of the reference, RMS above 2 m/s;
the least-squares fits v_right = yaw · v + arm · r − K v² r with r the yaw rate and v_down = pitch · v − arm · q + s v f
with q the pitch rate and f the specific force forward, the angles (mounting) of each drive its own, the rest one for
all; what they leave, and what is left where every drive has a fit of its own; and the RMS of the IMU's six channels in
bands of frequency.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import uniform_filter1d
from scipy.signal import welch

from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import read_drives
from dlkf.data.validate import DriveTables, read_checked
from dlkf.errors import InputError
from dlkf.navigation.attitude import rotation_from_rpy

BANDS = ((0.5, 3.0), (3.0, 10.0), (10.0, 20.0), (20.0, 45.0))  # Hz
MOVING = 2.0  # m/s
SPRINGS_S = 0.3  # the force forward is averaged over so long


def across(tables: DriveTables) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the car moves: (N, 3) regressors (v, r, −v² r) and (v, −q, v f), (N, 2) velocity to the right and down."""
    reference = tables.reference
    if reference is None or not np.isfinite(reference["yaw"]).any():
        raise InputError(f"drive {tables.row.name}: no attitude in its reference, so no velocity across the car")
    C_nb = rotation_from_rpy(torch.from_numpy(np.stack([reference[c] for c in ("roll", "pitch", "yaw")], -1))).numpy()
    v_b = np.einsum("tij,ti->tj", C_nb, np.stack([reference[c] for c in ("vel_n", "vel_e", "vel_d")], -1))
    t = tables.imu["t"]
    count = max(1, round(SPRINGS_S / float(np.median(np.diff(t)))))
    force = uniform_filter1d(tables.imu["accel_x"], count, origin=(count - 1) // 2)  # of the samples before
    moving = (v_b[:, 0] > MOVING) & reference["valid"].astype(bool)
    r, q, f = (np.interp(reference["t"], t, x)[moving] for x in (tables.imu["gyro_z"], tables.imu["gyro_y"], force))
    v = v_b[moving, 0]
    return np.stack((v, r, -(v**2) * r), -1), np.stack((v, -q, v * f), -1), v_b[moving, 1:]


def fitted(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, float, float]:
    """Coefficients of all columns but the first, RMS of what is left, and of what each drive's own fit leaves.

    The first column has a coefficient for every drive: what it explains is taken off the others and off y first
    (Frisch & Waugh, Econometrica 1, 1933). A mounting angle that all drives shared would be mistaken for springs, since
    f holds g times that angle.
    """
    rest = []
    for x, y in parts:
        own = x[:, 0] / (x[:, 0] @ x[:, 0])
        rest.append((x[:, 1:] - np.outer(x[:, 0], own @ x[:, 1:]), y - x[:, 0] * (own @ y)))
    x, y = (np.concatenate(columns) for columns in zip(*rest))
    fit = np.linalg.lstsq(x, y, rcond=None)[0]
    alone = [b - a @ np.linalg.lstsq(a, b, rcond=None)[0] for a, b in parts]
    return fit, rms(y - x @ fit), rms(np.concatenate(alone))


def bands(imu: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """RMS of each channel in each band [m/s², °/s]."""
    rate = 1 / float(np.median(np.diff(imu["t"])))
    out = {}
    for column in (*ACCEL, *GYRO):
        f, density = welch(imu[column] - imu[column].mean(), rate, nperseg=1024)
        scale = 180 / np.pi if column in GYRO else 1.0
        power = [density[(f >= low) & (f < high)].sum() * f[1] for low, high in BANDS]
        out[column] = [scale * float(np.sqrt(x)) for x in power]
    return out


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def describe(folder: Path, longest: int) -> None:
    drives = [read_checked(folder, row) for row in read_drives(folder)]
    drives = sorted(drives, key=lambda tables: len(tables.imu["t"]))[-longest:]
    parts = [across(tables) for tables in drives]
    v = np.concatenate([part[2] for part in parts])
    fit, left, alone = fitted([(p[0], p[2][:, 0]) for p in parts])
    print(f"\n{folder}: {len(drives)} drives, {sum(len(t.imu['t']) for t in drives)} samples")
    print(f"velocity to the right {rms(v[:, 0]):.3f} m/s, down {rms(v[:, 1]):.3f} m/s")
    print(f"arm {fit[0]:.2f} m, slip {fit[1]:.4f} s²/m; ", end="")
    print(f"left {left:.3f} m/s, fitted by drive {alone:.3f} m/s")
    for stiff in (True, False):
        fit, left, alone = fitted([(p[1][:, : 2 if stiff else 3], p[2][:, 1]) for p in parts])
        print(f"arm {fit[0]:.2f} m", end=", ")
        print("no springs; " if stiff else f"springs {fit[1]:.4f} s²·rad/m; ", end="")
        print(f"left {left:.3f} m/s, fitted by drive {alone:.3f} m/s")
    print(f"| channel | {' | '.join(f'{low:g}–{high:g} Hz' for low, high in BANDS)} |\n|---|{'---|' * len(BANDS)}")
    for column, row in bands(drives[-1].imu).items():
        print(f"| {column} | {' | '.join(f'{value:.3f}' for value in row)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--longest", type=int, default=20, help="how many of the longest drives of each")
    arguments = parser.parse_args()
    try:
        for folder in arguments.datasets:
            describe(folder, arguments.longest)
    except InputError as error:
        print(f"dlkf: error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
