"""Whether an exported filter is the filter: both over a drive, row by row, and the time that an epoch takes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dlkf.data.alignment import ALIGN
from dlkf.data.drive import Drive
from dlkf.data.resampling import ON_BOUNDARY_S, Grid, boundary_after, usable_fixes
from dlkf.data.schema import POSITION, STD, VELOCITY
from dlkf.data.segments import whole_drives
from dlkf.data.validate import DriveTables
from dlkf.errors import InputError
from dlkf.filters.integration import Estimator, Fix, advance
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import SEMI_MAJOR
from dlkf.navigation.state import NavState
from dlkf.onboard.carried import Layout
from dlkf.onboard.compiled_filter import CompiledFilter
from dlkf.onboard.functions import FIX, ROW, Begin
from dlkf.onboard.functions import Grid as Samples
from dlkf.onboard.library import Library, build
from dlkf.running.batched import run_filter
from dlkf.running.solution import COLUMNS, solution_columns
from dlkf.running.start import align, aligned_drives

FARTHEST_M = 1e-3  # m: float32 of a network beside its own rounding over minutes
WARM = 20  # epochs that are not timed
TIMED = 600  # epochs at most
KINDS = {  # columns that have one unit
    "position [m]": ("lat_deg", "lon_deg", "height_m"),
    "velocity [m/s]": ("vel_n", "vel_e", "vel_d"),
    "attitude [rad]": ("roll", "pitch", "yaw"),
    "accelerometers [m/s²]": ("accel_error_x", "accel_error_y", "accel_error_z"),
    "gyroscopes [rad/s]": ("gyro_error_x", "gyro_error_y", "gyro_error_z"),
}


class Difference(NamedTuple):
    """Largest difference of an exported filter from its original over a drive."""

    epochs: int
    largest: dict[str, float]  # by KINDS
    std: float  # of 1σ, relative

    def text(self) -> str:
        """One line."""
        parts = [f"{name} {x:.1e}" for name, x in self.largest.items()]
        return f"over {self.epochs} epochs: {', '.join(parts)}, 1σ {self.std:.1e} of themselves"


class Latency(NamedTuple):
    """Time of an epoch [ms]."""

    p50: float
    p99: float

    @classmethod
    def of(cls, seconds: list[float]) -> Latency:
        """From single times."""
        return cls(*(1e3 * float(np.quantile(seconds, q)) for q in (0.5, 0.99)))


def vehicle_run(library: Library, drive: Drive, fixes: np.ndarray, epochs: int) -> tuple[int, np.ndarray]:
    """A drive as a vehicle runs it, through ``step.h`` alone: the first epoch, and its rows (T, :data:`ROW`).

    ``fixes`` (N + 1, :data:`FIX`) are those of the boundaries, ``epochs`` what an alignment takes.
    """
    imu, told = drive.imu.double().contiguous(), torch.from_numpy(fixes)
    memory, rows, first = None, [], 0
    for k in range(drive.epochs):
        if memory is None:
            if k >= epochs:
                memory, ready = library.begin(
                    imu[None, k - epochs : k].contiguous(), told[None, k - epochs : k + 1].contiguous(),
                    drive.lever_arm_b[None].contiguous(),
                )  # fmt: skip
                memory, first = (memory, k) if ready else (None, 0)
            if memory is None:
                continue
        memory, row = library.step(memory, imu[k : k + 1], told[k + 1 : k + 2])
        rows.append(row[0].numpy())
    if not rows:
        raise InputError(f"drive {drive.name}: never moves under GNSS, so nothing can be checked on it")
    return first, np.stack(rows)


def boundary_fixes(tables: DriveTables, drive: Drive) -> np.ndarray:
    """(N + 1, :data:`FIX`) what a receiver said for each boundary; NaN for nothing."""
    gnss, grid = tables.gnss, Grid(drive.t0, drive.epoch_s, drive.epochs, drive.imu.shape[1])
    rows = np.full((drive.epochs + 1, len(FIX)), np.nan)
    place = boundary_after(gnss["t"], grid)
    good = np.flatnonzero(usable_fixes(gnss) & (place >= 0) & (place <= drive.epochs))
    values = np.stack([gnss[c] for c in (*POSITION, *VELOCITY, *STD, "quality")], -1).astype(float)
    lag = grid.boundaries[place[good]] - gnss["t"][good]
    rows[place[good]] = np.column_stack((values[good], np.where(lag <= ON_BOUNDARY_S, 0.0, lag)))
    return rows


def write_log(path: Path, tables: DriveTables, drive: Drive) -> None:
    """A drive as lines for the example: ``imu,t,accel (3),gyro (3)`` and ``gnss,t,…`` in order of time."""
    samples = drive.imu.flatten(0, 1).numpy()
    t = drive.t0 + np.arange(1, len(samples) + 1) / drive.rate_hz
    lines = [(s, 1, "imu", [s, *x]) for s, x in zip(t.tolist(), samples.tolist())]
    gnss = tables.gnss
    values = np.stack([gnss[c] for c in ("t", *POSITION, *VELOCITY, *STD, "quality")], -1)
    inside = usable_fixes(gnss) & (gnss["t"] >= drive.t0 - ON_BOUNDARY_S)
    lines += [(x[0], 0, "gnss", x) for x in values[inside].tolist()]  # before the sample that ends an epoch
    lines.sort(key=lambda line: (line[0] - ON_BOUNDARY_S * (1 - line[1]), line[1]))
    path.write_text("".join(f"{kind},{','.join(f'{v:.17g}' for v in x)}\n" for *_, kind, x in lines))


def difference(estimator: Estimator, library: Library, tables: DriveTables, drive: Drive, epochs: int) -> Difference:
    """The exported filter against a batch run of the original on one drive, each from its own alignment.

    Raises InputError where the drive never moves under GNSS.
    """
    first, rows = vehicle_run(library, drive, boundary_fixes(tables, drive), epochs)
    batch = whole_drives([drive], [align(drive, ALIGN, earliest=first)])
    found = run_filter(batch, estimator)
    state = NavState(*(x[0] for x in found.posterior))
    std = None if found.std is None else found.std[0]
    table = solution_columns(torch.arange(len(rows)), batch.frame, state, found.imu_error[0], std)
    mine = dict(zip(ROW, rows.T))
    apart = {c: np.abs(mine[c] - table[c].numpy()) for c in COLUMNS[1:]}
    apart["lat_deg"] = np.radians(apart["lat_deg"]) * SEMI_MAJOR
    apart["lon_deg"] = np.radians(apart["lon_deg"]) * SEMI_MAJOR * np.cos(np.radians(mine["lat_deg"]))
    for c in ("roll", "pitch", "yaw"):
        apart[c] = np.abs((apart[c] + np.pi) % (2 * np.pi) - np.pi)
    largest = {kind: float(max(apart[c].max() for c in columns)) for kind, columns in KINDS.items()}
    relative = [apart[c] / table[c].numpy() for c in COLUMNS if c.startswith("std_")]
    return Difference(len(rows), largest, float(np.nan_to_num(np.stack(relative)).max()))


def latencies(compiled: CompiledFilter, drive: Drive) -> dict[str, Latency]:
    """:func:`epoch_times` in short."""
    return {name: Latency.of(seconds) for name, seconds in epoch_times(compiled, drive).items()}


def epoch_times(compiled: CompiledFilter, drive: Drive) -> dict[str, list[float]]:
    """Seconds of epochs in Python, as torch runs them and compiled, in turns over one drive; the first few left out."""
    batch = aligned_drives([drive], ALIGN)
    T = min(TIMED, batch.size[1])
    usable = batch.gnss_valid & batch.available.unsqueeze(-1)
    running = {}
    with torch.inference_mode():
        for name, estimator in (("Python, torch", compiled.estimator), ("Python, compiled", compiled)):
            memory, error = estimator.begin(batch)
            running[name] = [estimator, memory, batch.start, ImuError.of(error), []]
        for k in range(T):
            fix = Fix(batch.gnss[:, k], batch.gnss_std[:, k], usable[:, k], batch.gnss_lag[:, k])
            for x in running.values():
                began = time.perf_counter()
                x[1], step = advance(
                    x[0], x[1], x[2], x[3], batch.imu[:, k], fix,
                    dt=batch.dt, frame=batch.frame, lever_arm_b=batch.lever_arm_b,
                )  # fmt: skip
                x[2], x[3] = step.posterior, step.error
                x[4].append(time.perf_counter() - began)
    return {name: x[4][WARM:] for name, x in running.items()}


def checked(
    work: Path, folder: Path, estimator: Estimator, grid: Samples, layout: Layout, tables: DriveTables, drive: Drive,
    latency: bool,
) -> list[str]:  # fmt: skip
    """Compile what was exported, run it beside the original; the findings as lines.

    Raises InputError where they are farther apart than rounding.
    """
    library = Library(build(folder, work), layout.size)
    found = difference(estimator, library, tables, drive, Begin(estimator, grid, layout).epochs)
    lines = [f"against the original {found.text()}"]
    if found.largest["position [m]"] > FARTHEST_M:
        raise InputError(f"the exported filter is not the original: {found.text()}")
    if latency:
        for name, x in latencies(CompiledFilter(estimator, grid, layout, library), drive).items():
            lines.append(f"an epoch in {name}: p50 {x.p50:.3f} ms, p99 {x.p99:.3f} ms")
    return lines
