"""Is the simulated fleet wider than the world? Real drives among the drives of a fleet, number by number.

    python -m dlkf.simulate dataset=wide dataset.hours=10 dataset.drive_minutes=3 seed=11 out=data/wide
    python -m pipelines.studies.fleet_realism data/wide data/{kitti,rtkx,comma2k19} --figure docs/figures/fleet.png

Per drive: the RMS of the IMU in bands of frequency (1 s windows, median over those of a class of speed), how far its
level tells the speed, how it is spread and how impulsive it is; velocity across and down, and what is left of them
without a constant angle; innovations of ``mbkf15`` with one and the same preset; the delay of the velocity of GNSS.
A real number is inside when it lies within 5 to 95 % of the fleet's drives. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
import torch
import yaml
from scipy.signal import detrend
from scipy.stats import kurtosis, spearmanr

from dlkf.config import config_dir
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, VELOCITY
from dlkf.data.segments import whole_drives
from dlkf.data.store import drive_from_tables
from dlkf.data.tables import Columns, read_drives
from dlkf.data.validate import DriveTables, read_checked
from dlkf.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.integration import Estimator, integrate
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.start import align

BANDS = ((1.0, 3.0), (3.0, 6.0), (6.0, 12.0), (12.0, 25.0), (25.0, 45.0))  # Hz
SPEEDS = {"standing": (0.0, 0.3), "slow": (2.0, 8.0), "medium": (8.0, 16.0), "fast": (16.0, 60.0)}  # m/s
GROUPS = {"accel level": (0, 1), "accel down": (2,), "gyro level": (3, 4), "gyro down": (5,)}
FEWEST = 5  # windows of a class of speed, below which a drive says nothing of it
SHORTEST_S, SETTLE = 45.0, 20
INSIDE = (5.0, 95.0)  # percentiles


def speed_of(reference: Columns, at: np.ndarray) -> np.ndarray:
    """Speed of the reference [m/s] at some times, NaN where it is not valid."""
    speed = np.linalg.norm([reference[c] for c in VELOCITY], axis=0)
    speed = np.where(reference["valid"].astype(bool), speed, np.nan)
    return np.interp(at, reference["t"], speed)


def band_levels(imu: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of each second [s], RMS of the channels in the bands (W, 6, bands), and kurtosis above 6 Hz (W, 6)."""
    rate = 1 / float(np.median(np.diff(imu["t"])))
    n = round(rate)
    windows = len(imu["t"]) // n
    x = np.stack([imu[c] for c in (*ACCEL, *GYRO)])[:, : windows * n].reshape(6, windows, n)
    x = detrend(x, axis=-1)  # gravity, and turns of more than a second
    spectrum = np.fft.rfft(x * np.hanning(n), axis=-1)
    f = np.fft.rfftfreq(n, 1 / rate)
    power = 2 * np.abs(spectrum) ** 2 / (n * np.sum(np.hanning(n) ** 2))
    bands = [power[..., (f > low - 0.1) & (f < high - 0.1)].sum(-1) for low, high in BANDS]
    quick = np.fft.irfft(np.where(f > BANDS[2][0], np.fft.rfft(x, axis=-1), 0), n, axis=-1)
    middle = imu["t"][: windows * n].reshape(windows, n).mean(-1)
    peaked = np.asarray(kurtosis(quick, axis=-1, fisher=False))
    return middle, np.sqrt(np.stack(bands, -1)).transpose(1, 0, 2), peaked.T


def of_spectra(tables: DriveTables) -> dict[str, float]:
    """Band levels by speed; their spread; the rank correlation of the level above 6 Hz with speed."""
    t, level, peaked = band_levels(tables.imu)
    assert tables.reference is not None
    speed = speed_of(tables.reference, t)
    out: dict[str, float] = {}
    for name, (low, high) in SPEEDS.items():
        rows = (speed >= low) & (speed < high)
        if rows.sum() < FEWEST:
            continue
        for group, axes in GROUPS.items():
            by_band = np.median(np.sqrt(np.mean(level[rows][:, axes] ** 2, 1)), 0)
            out |= {f"{group}, {name}, {a:g}–{b:g} Hz": x for (a, b), x in zip(BANDS, by_band)}
    driving = speed > SPEEDS["slow"][0]
    if driving.sum() >= 4 * FEWEST:
        loud = np.log(np.sqrt(np.sum(level[driving][:, :3, 2:] ** 2, (1, 2))))
        if np.ptp(speed[driving]) > 5:
            out["rank correlation of vibration and speed"] = float(spearmanr(loud, speed[driving])[0])
        out["spread of vibration from second to second, log-std"] = float(loud.std())
        out["kurtosis of accel above 6 Hz, median"] = float(np.median(peaked[driving][:, :3]))
        out["kurtosis of accel above 6 Hz, 95 %"] = float(np.quantile(peaked[driving][:, :3], 0.95))
    return out


def of_motion(tables: DriveTables) -> dict[str, float]:
    """Velocity to the right and down in the axes of the reference, and without a constant angle, above 2 m/s."""
    reference = tables.reference
    assert reference is not None
    rpy = np.stack([reference[c] for c in ATTITUDE], -1)
    known = reference["valid"].astype(bool) & np.isfinite(rpy).all(-1)
    if not known.any():
        return {}
    C_nb = rotation_from_rpy(torch.from_numpy(rpy[known])).numpy()
    v = np.einsum("tij,ti->tj", C_nb, np.stack([reference[c] for c in VELOCITY], -1)[known])
    v = v[v[:, 0] > 2.0]
    if len(v) < 100:
        return {}
    left = [v[:, k] - v[:, 0] * (v[:, 0] @ v[:, k]) / (v[:, 0] @ v[:, 0]) for k in (1, 2)]
    numbers = (v[:, 1], v[:, 2], *left)
    names = ("velocity to the right", "velocity down", "to the right without a yaw", "down without a pitch")
    return {f"{name} [m/s]": float(np.sqrt(np.mean(x**2))) for name, x in zip(names, numbers)}


def of_innovations(tables: DriveTables) -> dict[str, float]:
    """NIS per degree of freedom and lag-1 correlations of ``mbkf15`` with one preset, and the velocity's delay.

    The delay is the regression of the velocity's innovation on the acceleration over the second, −z·a/a·a.
    """
    spec = imu_spec(yaml.safe_load((config_dir() / "imu" / "automotive_mems.yaml").read_text()))
    drive = drive_from_tables(tables, "realism", 50.0, 1.0, torch.float64)
    batch = whole_drives([drive], [align(drive)])
    if batch.size[1] < 2 * SETTLE:
        return {}
    with torch.inference_mode():
        solution = integrate(batch, cast(Estimator, build_filter("mbkf15", spec)), keep_covariances=True)
    assert solution.covariances is not None
    z, S = solution.innovation[0, SETTLE:], solution.covariances.innovation[0, SETTLE:]
    used = (batch.gnss_valid & batch.available.unsqueeze(-1))[0, SETTLE:].all(-1)
    unit = z / S.diagonal(dim1=-2, dim2=-1).sqrt()
    both = used[1:] & used[:-1]
    out = {}
    for name, columns in (("position", [0, 1]), ("velocity", [3, 4])):
        u = unit[:, columns]
        out[f"{name} innovation, mean square over its variance"] = float(u[used].square().mean())
        lagged = (u[1:] * u[:-1])[both].mean() / u[used].square().mean()
        out[f"{name} innovation, lag-1 correlation"] = float(lagged)
    v = solution.posterior.v_n[0, SETTLE - 1 :, :2]
    a = ((v[1:] - v[:-1]) / batch.epoch_s)[used]
    if float(a.square().mean()) > 0.05:
        out["velocity's delay by its innovations [s]"] = -float((z[used][:, 3:5] * a).sum() / a.square().sum())
    return out


def numbers(folder: Path) -> pd.DataFrame:
    """A row per drive of a dataset that is long enough, a column per number."""
    rows = {}
    for row in read_drives(folder):
        tables = read_checked(folder, row)
        if tables.reference is None or np.ptp(tables.imu["t"]) < SHORTEST_S:
            continue
        found = of_spectra(tables) | of_motion(tables)
        with suppress(InputError):  # no start can be found: nothing to say of innovations
            found |= of_innovations(tables)
        rows[row.name] = found
    if not rows:
        raise InputError(f"{folder}: no drive of at least {SHORTEST_S:g} s with a reference")
    return pd.DataFrame(rows).T.astype(float)


def compared(fleet: pd.DataFrame, real: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Per number: the fleet's 5, 50, 95 %; per real dataset its median and the share of the fleet below that."""
    out = pd.DataFrame({f"fleet {p:g} %": fleet.quantile(p / 100) for p in (INSIDE[0], 50, INSIDE[1])})
    for name, drives in real.items():
        middle = drives.median().reindex(out.index)
        below = (fleet.lt(middle).sum() / fleet.notna().sum()).where(middle.notna())
        out[name], out[f"{name}, fleet below [%]"] = middle, 100 * below
    return out


def is_inside(table: pd.DataFrame, name: str) -> pd.Series:
    """Which numbers of a real dataset lie inside, NaN where it has none."""
    below = table[f"{name}, fleet below [%]"]
    return below.between(*INSIDE).where(below.notna())


def markdown(table: pd.DataFrame, names: Sequence[str]) -> str:
    """The numbers that lie outside for any dataset, and all that are no spectra; then how many are inside."""
    is_spectrum = table.index.str.contains(" Hz", regex=False) & ~table.index.str.contains("kurtosis")
    outside = pd.concat([is_inside(table, name).eq(False) for name in names], axis=1).any(axis=1)
    head = ["number", "fleet 5 / 50 / 95 %", *names]
    lines = ["| " + " | ".join(head) + " |", "|:--|" + "--:|" * (len(head) - 1)]
    for key, row in table[outside | ~is_spectrum].iterrows():
        cells = [" / ".join(f"{row[f'fleet {p:g} %']:.3g}" for p in (INSIDE[0], 50, INSIDE[1]))]
        for name in names:
            value, below = float(row[name]), float(row[f"{name}, fleet below [%]"])
            star = "" if INSIDE[0] <= below <= INSIDE[1] else "**"
            cells.append("–" if np.isnan(value) else f"{star}{value:.3g}{star} ({below:.0f} %)")
        lines.append(f"| {key} | " + " | ".join(cells) + " |")
    for name in names:
        inside = is_inside(table, name).dropna().astype(bool)
        lines.append(f"\n{name}: {int(inside.sum())} of {len(inside)} numbers inside")
    return "\n".join(lines)


def draw(path: Path, table: pd.DataFrame, names: Sequence[str]) -> None:
    """Band levels of the fleet and of the real drives, a panel per sensor and class of speed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 9), layout="constrained")
    panels = figure.subplots(len(GROUPS), len(SPEEDS), sharex=True, sharey="row")
    middle = [np.sqrt(a * b) for a, b in BANDS]
    colours = ("#D55E00", "#009E73", "#CC79A7", "#56B4E9")
    for row, group in zip(panels, GROUPS):
        for axes, speed in zip(row, SPEEDS):
            keys = [f"{group}, {speed}, {a:g}–{b:g} Hz" for a, b in BANDS]
            rows = table.reindex(keys)
            axes.fill_between(
                middle, rows[f"fleet {INSIDE[0]:g} %"], rows[f"fleet {INSIDE[1]:g} %"], color="#0072B2", alpha=0.2,
                linewidth=0, label="fleet, 5 to 95 %",
            )  # fmt: skip
            axes.plot(middle, rows["fleet 50 %"], color="#0072B2", linewidth=1, label="fleet, median")
            for name, colour in zip(names, colours):
                axes.plot(middle, rows[name], "o-", color=colour, markersize=3, linewidth=1, label=name)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xticks((2, 5, 10, 20, 40), ("2", "5", "10", "20", "40"))
            axes.minorticks_off()
            axes.grid(alpha=0.25)
        row[0].set_ylabel(f"{group}\n[{'m/s²' if group.startswith('accel') else 'rad/s'}, RMS in band]")
    for axes, (speed, (low, high)) in zip(panels[0], SPEEDS.items()):
        axes.set_title(f"{speed}, {low:g}–{high:g} m/s", fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel("Frequency [Hz]")
    figure.legend(*panels[0, 1].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fleet", type=Path)
    parser.add_argument("real", type=Path, nargs="+")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    try:
        real = {folder.name: numbers(folder) for folder in arguments.real}
        table = compared(numbers(arguments.fleet), real)
    except InputError as error:
        print(f"dlkf: error: {error}", file=sys.stderr)
        sys.exit(2)
    print(markdown(table, list(real)))
    if arguments.figure:
        draw(arguments.figure, table, list(real))


if __name__ == "__main__":
    main()
