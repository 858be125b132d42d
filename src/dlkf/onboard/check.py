"""Whether an exported filter is the filter: both over a drive, row by row, and the time that an epoch takes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from dlkf.base.angles import wrap_angle
from dlkf.base.errors import InputError
from dlkf.data.aid_tables import STANDARD
from dlkf.data.aids import aid_values
from dlkf.data.alignment import SEARCH
from dlkf.data.drive import Drive
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY
from dlkf.data.segments import whole_drives
from dlkf.data.validate import CheckedTables
from dlkf.filters.integration import Estimator, Fix, advance
from dlkf.navigation.calibration import ImuError
from dlkf.navigation.earth import SEMI_MAJOR
from dlkf.navigation.state import NavState
from dlkf.onboard.c_source import COLUMNS as CORE_COLUMNS
from dlkf.onboard.carried import Layout
from dlkf.onboard.compiled_filter import CompiledFilter
from dlkf.onboard.core import Core
from dlkf.onboard.core_drives import make_core
from dlkf.onboard.functions import Grid, count_output_numbers
from dlkf.onboard.library import Library, build
from dlkf.running.batched import run_filter
from dlkf.running.replay import replay_drive
from dlkf.running.solution import COLUMNS, solution_columns
from dlkf.running.start import align, align_drives

# m: float32 of a network beside its own rounding over minutes; of everything
FARTHEST_M = {torch.float64: 1e-3, torch.float32: 0.05}
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


def run_core(core: Core, tables: CheckedTables) -> np.ndarray:
    """The rows of the core over a drive, fixes and further sensors at their own times (T, columns of the core).

    InputError where there are none.
    """
    sent = replay_drive(core, tables.imu, tables.gnss, None, tables.aids)
    rows = [row for receipt in sent for row in receipt.rows]
    if not rows:
        raise InputError(f"drive {tables.row.name}: never gives a filter a start, so nothing can be checked on it")
    return np.stack(rows)


def write_log(path: Path, tables: CheckedTables) -> None:
    """A drive as lines for the example: ``imu,t,accel (3),gyro (3)``, ``gnss,t,…``, ``speed,t,…`` in order of time."""
    imu, gnss = tables.imu, tables.gnss
    samples = np.stack([imu[c] for c in ("t", *ACCEL, *GYRO)], -1)
    fixes = np.stack([gnss[c] for c in ("t", *POSITION, *VELOCITY, *STD, "quality")], -1)
    lines = [(x[0], kind, x) for kind, rows in (("gnss", fixes), ("imu", samples)) for x in rows.tolist()]
    for name, columns in tables.aids.items():
        value = aid_values(STANDARD[name], columns)
        std = columns.get("std", np.full(len(value), np.nan))
        lines += [(x[0], "aid", (name, *x)) for x in zip(columns["t"].tolist(), value.tolist(), std.tolist())]
    lines.sort(key=lambda line: line[:2])  # a fix before a sample of the same time
    named = ((x[0], x[1:]) if kind == "aid" else (kind, x) for _, kind, x in lines)
    path.write_text("".join(f"{kind},{','.join(f'{v:.17g}' for v in x)}\n" for kind, x in named))


def measure_difference(estimator: Estimator, library: Library, tables: CheckedTables, drive: Drive) -> Difference:
    """The core over a drive as it is against a batch run of the original, each from its own alignment.

    Raises InputError where the drive never moves under GNSS.
    """
    rows = run_core(make_core(library, tables, drive), tables)
    batch = whole_drives([drive], [align(drive, SEARCH)])
    found = run_filter(batch, estimator)
    state = NavState(*(x[0] for x in found.posterior))
    std = None if found.std is None else found.std[0]
    table = solution_columns(torch.arange(len(rows)), batch.frame, state, found.imu_error[0], std)
    later = len(rows) - found.posterior.p_n.shape[1]
    if later:
        raise InputError(f"drive {tables.row.name}: the core starts {abs(later)} update intervals from the original")
    mine = dict(zip(CORE_COLUMNS, rows.T))
    apart = {c: np.abs(mine[c] - table[c].numpy()) for c in COLUMNS[1:]}
    apart["lat_deg"] = np.radians(apart["lat_deg"]) * SEMI_MAJOR
    apart["lon_deg"] = np.radians(apart["lon_deg"]) * SEMI_MAJOR * np.cos(np.radians(mine["lat_deg"]))
    for c in ("roll", "pitch", "yaw"):
        apart[c] = np.abs(wrap_angle(apart[c]))
    largest = {kind: float(max(apart[c].max() for c in columns)) for kind, columns in KINDS.items()}
    relative = [apart[c] / table[c].numpy() for c in COLUMNS if c.startswith("std_")]
    return Difference(len(rows), largest, float(np.nan_to_num(np.stack(relative)).max()))


def time_epochs(compiled: CompiledFilter, drive: Drive) -> dict[str, list[float]]:
    """Seconds of epochs in Python, as torch runs them and compiled, interleaved; without the first few."""
    batch = align_drives([drive])
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


def check_export(
    work: Path, folder: Path, estimator: Estimator, grid: Grid, layout: Layout, tables: CheckedTables, drive: Drive,
    latency: bool,
) -> list[str]:  # fmt: skip
    """Compile what was exported, run it beside the original; the findings as lines.

    Raises InputError where they are further apart than rounding.
    """
    library = Library(build(folder, work), layout.size, count_output_numbers(estimator))
    found = measure_difference(estimator, library, tables, drive)
    lines = [f"against the original {found.text()}"]
    if found.largest["position [m]"] > FARTHEST_M[grid.dtype]:
        raise InputError(f"the exported filter is not the original: {found.text()}")
    if latency:
        for name, seconds in time_epochs(CompiledFilter(estimator, grid, layout, library), drive).items():
            x = Latency.of(seconds)
            lines.append(f"an epoch in {name}: p50 {x.p50:.3f} ms, p99 {x.p99:.3f} ms")
    return lines
