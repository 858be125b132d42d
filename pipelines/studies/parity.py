"""The classical filters beside those of an independent public package, python-ins, on the same files in one run.

    python -m pipelines.studies.parity --drives 3 --out outputs/parity

Car-like drives at 100 Hz whose IMU is made by python-ins' inverse mechanisation, with the errors of the preset
``consumer``, RTK at 1 Hz (0.02 m, 0.05 m/s) and outages of 60 s. Both filters start from the same wrong state with
the same P₀, and have the same Q, R and masks. Theirs, ``pyins.filters.run_feedback_filter``, takes minutes per
drive, and what it found is kept in ``out``; ``--step 0.5`` is five times as fast. ``table.md`` holds the result.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyins
import torch
from numpy.typing import NDArray
from pyins import filters, inertial_sensor, measurements, sim, strapdown
from pyins.util import ACCEL_COLS, GYRO_COLS, LLA_COLS, RPH_COLS, VEL_COLS
from rich.console import Console

from dlkf.base.files import write_into
from dlkf.command.composing import imu_preset
from dlkf.data.drive import Batch
from dlkf.data.masks import withhold_fixes
from dlkf.data.schema import ACCEL, GYRO, new_dataset, write_drive, write_drives_table
from dlkf.data.segments import StartLaw, cut_segments, make_batch
from dlkf.data.store import load_dataset
from dlkf.data.tables import Columns
from dlkf.evaluation.bootstrap import compare
from dlkf.evaluation.table import ResultTable, as_markdown, as_rich, format_number
from dlkf.filters.build import build_causal, build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.model_based import Ins, Mbkf
from dlkf.navigation.attitude import rpy_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.state import NavState
from dlkf.simulation.imu import corrupt, draw_unit
from dlkf.simulation.motion.routes import VehicleConfig
from dlkf.simulation.motion.vehicle import Truth, drive_vehicle
from dlkf.simulation.tables import fix_columns, imu_columns, reference_columns

Array = NDArray[np.floating]
RATE, POSITION_STD, VELOCITY_STD = 100, 0.02, 0.05  # Hz, m, m/s
START = StartLaw(position_m=1.0, velocity_mps=0.1, roll_pitch_deg=1.0, yaw_deg=3.0)
EXACT = StartLaw(0.0, 0.0, 0.0, 0.0)
FIRST_S, EVERY_S, OUTAGE_S = 300, 180, 60  # outages
FILTERS = {15: "mbkf15", 21: "mbkf21", 33: "mbkf33"}


class Result(NamedTuple):
    """Horizontal errors [m] of ours and theirs at the epochs of a drive, and processor seconds."""

    ours: Array
    ours_s: float
    theirs: Array
    theirs_s: float
    hidden: NDArray[np.bool_]


def write_drives(folder: Path, spec: ImuSpec, drives: int, minutes: float) -> None:
    """Drives of python-ins' inverse mechanisation in the data contract."""
    rows = []
    with new_dataset(folder) as beside:
        for seed in range(drives):
            motion, unit, errors, gnss = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4))
            t = np.arange(round(minutes * 60 * RATE) + 1) / RATE
            car = VehicleConfig()
            truth = drive_vehicle(motion, car, t)
            trajectory, imu = sim.generate_imu(
                t, (car.lat_deg, car.lon_deg, car.height_m), np.degrees(truth.rpy), truth.v_n, "increment"
            )
            exact = imu[[*ACCEL_COLS, *GYRO_COLS]].to_numpy()[1:] * RATE
            measured, error = corrupt(errors, exact, spec, draw_unit(unit, spec), RATE)
            at = trajectory.iloc[::RATE]
            fixes = at.iloc[1:]
            position = sim.generate_position_measurements(fixes, POSITION_STD, gnss.integers(2**31))
            velocity = sim.generate_ned_velocity_measurements(fixes, VELOCITY_STD, gnss.integers(2**31))
            meta = {"drive": f"parity-{seed:02d}", "source": f"simulation: python-ins {pyins.__version__}, seed {seed}"}
            rows.append(
                write_drive(
                    beside,
                    meta | {"imu": spec.name, "gnss": "simulated, white noise"},
                    pd.DataFrame(imu_columns(t[1:], measured)),
                    pd.DataFrame(_fixes(fixes.index.to_numpy(), position.to_numpy(), velocity.to_numpy())),
                    pd.DataFrame(reference_columns(_truth(at), _at(error, at))),
                )
            )
        write_drives_table(beside, rows)


def _fixes(t: Array, lla: Array, v_n: Array) -> Columns:
    std = np.tile((POSITION_STD,) * 3 + (VELOCITY_STD,) * 3, (len(t), 1))
    lat, lon = np.radians(lla[:, :2]).T
    return fix_columns(t, lat, lon, lla[:, 2], v_n, std, np.full(len(t), 4))


def _truth(at: pd.DataFrame) -> Truth:
    lla = at[LLA_COLS].to_numpy()
    lat, lon = np.radians(lla[:, :2]).T
    return Truth(at.index.to_numpy(), lat, lon, lla[:, 2], at[VEL_COLS].to_numpy(), np.radians(at[RPH_COLS].to_numpy()))


def _at(error: Array, at: pd.DataFrame) -> Array:
    return np.concatenate((error[:1], error))[::RATE][: len(at)]


def with_outages(batch: Batch) -> Batch:
    """The batch with fixes withheld: ``OUTAGE_S`` every ``EVERY_S`` from ``FIRST_S`` on."""
    end = torch.arange(1, batch.size[1] + 1) * batch.epoch_s
    since = end - FIRST_S
    hidden = (since > 0) & ((since - 1e-6) % EVERY_S < OUTAGE_S)
    return withhold_fixes(batch, hidden)


def start_of(batch: Batch) -> pd.Series:
    """The start state of a batch of one as python-ins wants it: degrees, true local NED."""
    lla, v_n, C = _local(batch, NavState(*(x.unsqueeze(1) for x in batch.start)))
    rph = np.degrees(rpy_from_rotation(C[0]).numpy())
    values = np.concatenate((lla[0], v_n[0], rph))
    return pd.Series(values, index=[*LLA_COLS, *VEL_COLS, *RPH_COLS], name=float(batch.t_start[0]))


def _local(batch: Batch, state: NavState) -> tuple[Array, Array, torch.Tensor]:
    lat, lon, height = geodetic_from_ecef(batch.frame.to_ecef(state.p_n)[0])
    C_local = ned_axes(lat, lon).mT @ batch.frame.C_en[0]
    v_n = (C_local @ state.v_n[0].unsqueeze(-1)).squeeze(-1)
    return torch.stack((lat.rad2deg(), lon.rad2deg(), height), -1).numpy(), v_n.numpy(), C_local @ state.C_nb[0]


def theirs(folder: Path, batch: Batch, spec: ImuSpec, states: int, step_s: float) -> tuple[Array, float]:
    """Horizontal error [m] at the ends of the epochs of python-ins' feedback filter, and seconds."""
    drive = batch.drive[0]
    table = pd.read_parquet(folder / f"imu/drive={drive}/part-0.parquet").set_index("t")
    gnss = pd.read_parquet(folder / f"gnss/drive={drive}/part-0.parquet").set_index("t")
    start = start_of(batch)
    imu = table[[*GYRO, *ACCEL]] / RATE
    first = imu.iloc[:1].copy()  # by convention the sample before the first: the first itself
    first.index = first.index - 1 / RATE
    increments = strapdown.compute_increments_from_imu(pd.concat((first, imu)), "increment")
    increments = increments[increments.index > float(str(start.name)) + 0.5 / RATE]
    end = float(batch.t_start[0]) + batch.epoch_s * np.arange(1, batch.size[1] + 1)
    shown = batch.available[0].numpy()
    offered = gnss.loc[np.round(end[shown], 6).tolist()]
    offered.columns = [{"lat_deg": "lat", "lon_deg": "lon", "height_m": "alt", "vel_n": "VN", "vel_e": "VE",
                        "vel_d": "VD"}.get(c, c) for c in offered.columns]  # fmt: skip
    estimator = build_filter(FILTERS[states], spec)
    assert isinstance(estimator, Mbkf)
    sigma = estimator.begin(batch)[0].P[0].diagonal().sqrt().numpy()
    psd, models = estimator.psd(), []
    for k, sensor, errors in ((9, "accel", spec.accel), (12, "gyro", spec.gyro)):
        matrix = np.full((3, 3), errors.misalignment if states == 33 else 0.0)
        np.fill_diagonal(matrix, errors.scale_factor if states > 15 else 0.0)
        noise, walk = (math.sqrt(psd[f"{sensor}_{x}"]) for x in ("noise", "walk"))
        models.append(inertial_sensor.EstimationModel(sigma[k : k + 3], noise, walk, matrix if states > 15 else None))
    degrees = np.degrees(sigma[6:9])
    began = time.process_time()
    result = filters.run_feedback_filter(
        start, sigma[0], sigma[3], degrees[0], degrees[2], increments, models[1], models[0],
        measurements=[
            measurements.Position(offered, POSITION_STD), measurements.NedVelocity(offered, VELOCITY_STD)
        ],
        time_step=step_s,
    )  # fmt: skip
    took = time.process_time() - began
    nearest = np.searchsorted(result.trajectory.index, end - 0.5 / RATE)
    lla = result.trajectory[LLA_COLS].to_numpy()[nearest]
    return horizontal(batch, lla), took


def ours(batch: Batch, spec: ImuSpec, states: int, score: bool = True) -> tuple[Array, float]:
    """Horizontal error [m] of our filter at the ends of the epochs, and seconds."""
    estimator = build_causal(FILTERS[states], spec, "the loop does not")
    with torch.inference_mode():
        began = time.process_time()
        solution = integrate(batch, estimator)
        took = time.process_time() - began
    return horizontal(batch, _local(batch, solution.posterior)[0]) if score else np.empty(0), took


def horizontal(batch: Batch, lla: Array) -> Array:
    """Horizontal distance [m] of geodetic positions (T, 3) from the truth of a batch of one."""
    truth = _local(batch, batch.truth)[0]
    difference = pyins.transform.compute_lla_difference(lla, truth)
    return np.hypot(difference[:, 0], difference[:, 1])


def outage_ends(hidden: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The last hidden epoch of every whole outage."""
    return np.flatnonzero(hidden[:-1] & ~hidden[1:])


def perfect_drift(folder: Path, rate_hz: float) -> float:
    """Largest horizontal error [m] after 60 s of strapdown of an error-free IMU from the exact start."""
    drives = load_dataset(folder, rate_hz=rate_hz, dtype=torch.float64)
    batch = make_batch(drives, cut_segments(drives, float(OUTAGE_S)), dtype=torch.float64, start=EXACT)
    with torch.inference_mode():
        solution = integrate(batch, Ins(free=True))
    return float((solution.posterior.p_n - batch.truth.p_n)[:, -1, :2].norm(dim=-1).max())


def run(folder: Path, kept: Path, drive: int, spec: ImuSpec, states: int, step_s: float) -> Result:
    """Both filters over one drive; theirs from what is kept of an earlier run, where it was run."""
    loaded = load_dataset(folder, rate_hz=float(RATE), dtype=torch.float64, drives=[f"parity-{drive:02d}"])
    whole = cut_segments(loaded, loaded[0].epochs - 1.0)[:1]
    generator = torch.Generator().manual_seed(drive)
    batch = with_outages(make_batch(loaded, whole, dtype=torch.float64, start=START, generator=generator))
    file = kept / f"drive={drive:02d}-states={states}-step={step_s:g}.npz"
    if not file.is_file():
        error, seconds = theirs(folder, batch, spec, states, step_s)
        with write_into(kept) as beside:
            np.savez(beside / file.name, error=error, seconds=seconds)
    with np.load(file) as x:
        error, seconds = x["error"], float(x["seconds"])
    return Result(*ours(batch, spec, states), error, seconds, ~batch.available[0].numpy())


def rms(x: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


def table_of(results: dict[int, list[Result]], minutes: float) -> ResultTable:
    """Errors in the outages of all drives, ours and theirs, and their ratio with its interval."""
    drives, outages = 0, 0
    rows = []
    for states, runs in results.items():
        ends = [outage_ends(r.hidden) for r in runs]
        drives, outages = len(runs), sum(map(len, ends))
        a, b = (np.concatenate([getattr(r, x)[e] for r, e in zip(runs, ends)]) for x in ("ours", "theirs"))
        inside = [rms(np.concatenate([getattr(r, x)[r.hidden] for r in runs])) for x in ("ours", "theirs")]
        c = compare(a, b, statistic="rms")
        samples = RATE * sum(len(r.hidden) for r in runs)
        speed = [samples / sum(getattr(r, x) for r in runs) for x in ("ours_s", "theirs_s")]
        rows.append(
            [f"{states}", format_number(c.a), format_number(c.b), 
             f"{c.ratio:.3f} [{c.ratio_low:.3f}, {c.ratio_high:.3f}]"]
            + [format_number(float(np.median(x))) for x in (a, b)] + [format_number(x) for x in inside]
            + [f"{x:,.0f}" for x in speed] + [f"{speed[0] / speed[1]:.0f}"]
        )  # fmt: skip
    return ResultTable(
        title=f"{drives} drives of {minutes:g} min, {outages} outages of {OUTAGE_S} s: horizontal error",
        note="End: RMS and median at the end of the outages; inside: RMS over their epochs. Ratio of the RMS at the "
        "end with its 95 % interval by paired bootstrap over outages. Speed: IMU epochs per second of one processor.",
        columns=["States", "End, ours\n[m]", "theirs\n[m]", "ratio", "median, ours\n[m]", "theirs\n[m]",
                 "Inside, ours\n[m]", "theirs\n[m]", "Speed, ours", "theirs", "times"],
        rows=rows,
    )  # fmt: skip


def main() -> int:
    """Simulate, run what was not run, print."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--drives", type=int, default=3)
    arguments.add_argument("--minutes", type=float, default=30.0)
    arguments.add_argument("--states", type=int, nargs="+", default=list(FILTERS), choices=list(FILTERS))
    arguments.add_argument("--step", type=float, default=0.1, help="theirs: step of the covariance [s], up to 1")
    arguments.add_argument("--imu", default="consumer")
    arguments.add_argument("--out", type=Path, default=Path("outputs/parity"))
    arguments.add_argument("--threads", type=int, default=1)
    o = arguments.parse_args()
    torch.set_num_threads(o.threads)
    console, spec = Console(width=150), imu_preset(o.imu)
    kept = o.out / f"{o.imu}-{o.drives}x{o.minutes:g}min"
    folder, perfect = kept / "drives", kept / "perfect"
    if not folder.is_dir():
        write_drives(folder, spec, o.drives, o.minutes)
    if not perfect.is_dir():
        write_drives(perfect, imu_preset("perfect"), 1, o.minutes)
    results: dict[int, list[Result]] = {}
    for drive in range(o.drives):
        for states in o.states:
            r = run(folder, kept, drive, spec, states, o.step)
            results.setdefault(states, []).append(r)
            ends = outage_ends(r.hidden)
            console.print(
                f"drive {drive}, {states} states: {len(ends)} outages, ours {rms(r.ours[ends]):.3f} m, "
                f"theirs {rms(r.theirs[ends]):.3f} m; {r.ours_s:.1f} s and {r.theirs_s:.1f} s"
            )
    table = table_of(results, o.minutes)
    text = as_markdown(table)
    drift = " and ".join(f"{perfect_drift(perfect, hz):.4f} m at {hz} Hz" for hz in (50, 100))
    text += f"\nError-free IMU, exact start, 60 s without GNSS: at most {drift}, horizontal.\n"
    with write_into(o.out) as beside:
        (beside / "table.md").write_text(text)
    console.print(as_rich(table))
    console.print(text.splitlines()[-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
