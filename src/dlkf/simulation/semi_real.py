"""Semi-real drives: a real car's motion and its high-grade IMU, with the errors of another IMU and GNSS simulated.

Truth stays the source's reference. GNSS exists only where the reference is known: a fix is made of it, and claims
no more than the reference holds.
"""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from dlkf.base.errors import InputError
from dlkf.data.resampling import SampleGrid, interpolate_reference
from dlkf.data.schema import ACCEL, GYRO, IMU_ERROR, VELOCITY, new_dataset, write_drive, write_drives_table
from dlkf.data.tables import Columns, read_drives, read_drives_table
from dlkf.data.validate import CheckedTables, read_drive, validate_dataset
from dlkf.navigation.attitude import rpy_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.simulation.dataset import DatasetConfig, Recipe, draw_presets, gnss_text, write_raw
from dlkf.simulation.gnss.satellite_fixes import Received, receive
from dlkf.simulation.gnss.surroundings import Sky, sky_along
from dlkf.simulation.imu import ImuUnit, corrupt
from dlkf.simulation.motion.vehicle import Truth

Array = NDArray[np.floating]
KIND = "semi-real"
INJECTED = "the injected part only: the source's own IMU errors remain and are not known"


def simulate_semi_real(
    source: str | Path, made_by: Recipe, out: Path, *, overwrite: bool = False, progress: bool = True
) -> Path:
    """Write every drive of the dataset ``source`` to ``out`` with IMU errors injected and GNSS simulated.

    Of the recipe the IMU errors, surroundings, gnss, receiver and raw count; motion, rates and lengths are the
    source's. The columns of the true IMU error hold the injected part only. InputError for a drive without a
    usable reference, or whose IMU errors are known already (it is no real drive).
    """
    rows = read_drives(source)
    described = read_drives_table(source).to_dict("records")
    shown = track(rows, f"semi-real {made_by.dataset.name}", disable=not progress, console=Console(stderr=True))
    with closing(iter(shown)) as drives, new_dataset(out, overwrite) as folder:  # type: ignore[type-var]
        written = []
        for index, drive in enumerate(drives):
            tables = read_drive(source, drive)
            *streams, unit_seed, type_seed, ranges_seed = np.random.SeedSequence(
                made_by.seed, spawn_key=(2, index)
            ).spawn(6)
            config, _, kind, unit = draw_presets(made_by, unit_seed, type_seed, ranges_seed)
            imu_rng, gnss_rng, sky_rng = (np.random.default_rng(stream) for stream in streams)
            imu, reference = inject_errors(imu_rng, tables, kind, unit)
            received, rough = simulate_gnss(gnss_rng, sky_rng, tables, config)
            row = _row(described[index], config, kind, rough)
            written.append(write_drive(folder, row, imu, received.fixes, reference))
            if config.raw:
                write_raw(folder, drive.name, received.raw)
        write_drives_table(folder, written)
        validate_dataset(folder)
        settings = {"source": str(source), **made_by.described}
        (folder / "simulation.json").write_text(
            json.dumps(settings, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
        )
    return out


def inject_errors(
    rng: np.random.Generator, tables: CheckedTables, spec: ImuSpec, unit: ImuUnit
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """IMU table with the errors of a unit added to the source's samples, and the reference with those errors.

    White noise and in-run bias are those of the source's median rate. A row of the reference has the error of the
    sample that covers its time. InputError without a reference, or if the reference states IMU errors already.
    """
    name, imu, reference = tables.row.name, tables.imu, tables.reference
    if reference is None:
        raise InputError(f"drive {name}: no reference, so there is no truth to make GNSS of; leave the drive out")
    if any(np.isfinite(reference[c]).any() for c in IMU_ERROR if c in reference):
        raise InputError(
            f"drive {name}: its IMU errors are known, so it is simulated or semi-real; source= takes real drives"
        )
    t = imu["t"]
    samples = np.stack([imu[c] for c in (*ACCEL, *GYRO)], -1)
    measured, error = corrupt(rng, samples, spec, unit, 1 / float(np.median(np.diff(t))))
    covering = np.minimum(np.searchsorted(t, reference["t"], side="left"), len(t) - 1)
    return (
        pd.DataFrame({"t": t, **dict(zip((*ACCEL, *GYRO), measured.T))}),
        pd.DataFrame({**reference, **dict(zip(IMU_ERROR, error[covering].T))}),
    )


def simulate_gnss(
    rng: np.random.Generator, sky_rng: np.random.Generator, tables: CheckedTables, config: DatasetConfig
) -> tuple[Received, Array]:
    """GNSS at whole multiples of 1/rate where the reference is known, and the reference's roughness (3,) [m].

    Known is between valid samples close enough to interpolate; elsewhere there is no fix, as under a roof. The
    :func:`roughness` is added in square to the position's std. Late fixes (``position_lag_s``, ``velocity_lag_s``) are
    of the reference that long before, the lever arm as at the velocity's time. InputError if it is never known, or
    has no attitude while the configuration asks for a lever arm.
    """
    name, reference, gnss = tables.row.name, tables.reference, config.gnss
    assert reference is not None  # :func:`inject_errors` raises for that
    t = _epochs(tables.imu["t"], reference["t"], gnss.rate_hz, name)
    at, moving = (
        interpolate_reference(reference, SampleGrid(t[0] - lag, 1 / gnss.rate_hz, len(t) - 1, 1))
        for lag in (gnss.position_lag_s, gnss.velocity_lag_s)
    )
    valid = at.valid & moving.valid
    known = np.flatnonzero(valid)
    if not len(known):
        raise InputError(f"drive {name}: its reference is valid at no GNSS epoch; leave the drive out")
    # elsewhere the last known state before: of no use, but finite
    filled = known[np.maximum(np.searchsorted(known, np.arange(len(t)), side="right") - 1, 0)]
    r_e, v_e, C_eb = (torch.from_numpy(x[filled]) for x in (at.r_e, moving.v_e, moving.C_eb))
    lat, lon, height = geodetic_from_ecef(r_e)
    C_ne = ned_axes(lat, lon).mT
    v_n = (C_ne @ v_e[..., None])[..., 0].numpy()
    rpy = rpy_from_rotation(C_ne @ C_eb).numpy()
    if np.isnan(rpy).any() and any(gnss.lever_arm_b):
        raise InputError(f"drive {name}: its reference has no attitude, which gnss.lever_arm_b needs; give [0, 0, 0]")
    course = np.unwrap(np.arctan2(v_n[:, 1], v_n[:, 0]))
    rpy = np.where(np.isnan(rpy).any(-1, keepdims=True), np.stack((0 * course, 0 * course, course), -1), rpy)
    truth = Truth(t, lat.numpy(), lon.numpy(), height.numpy(), v_n, rpy)
    speed = np.where(valid, np.hypot(v_n[:, 0], v_n[:, 1]), 0.0)
    sky = sky_along(sky_rng, config.surroundings, np.cumsum(speed) / gnss.rate_hz)
    sky = Sky(sky.mask_left, sky.mask_right, sky.blocked | ~valid)
    middle = tables.imu["t"] - 0.5 * float(np.median(np.diff(tables.imu["t"])))
    rate_b = np.stack([np.interp(t - gnss.velocity_lag_s, middle, tables.imu[c]) for c in GYRO], -1)
    received = receive(rng, truth, rate_b, gnss, config.receiver, sky)
    rough = roughness(reference, t - gnss.position_lag_s, C_ne.numpy(), np.where(valid[:, None], at.r_e, np.nan))
    claimed = {f"std_pos_{a}": np.hypot(received.fixes[f"std_pos_{a}"], x) for a, x in zip("ned", rough)}
    return Received(received.fixes.assign(**claimed), received.raw), rough


def roughness(reference: Columns, t: Array, C_ne: Array, r_e: Array) -> Array:
    """By how much [m, 1σ, (3,) in NED] the reference's positions jump from epoch to epoch ``t`` (T,).

    RMS of the change of position ``r_e`` (T, 3), NaN where unknown, less the integral of the reference's velocities,
    over √2: a fix made of such a position is no better, however small its own noise, since the car did not jump.
    """
    way = np.stack([np.interp(t, reference["t"], _integral(reference["t"], reference[c])) for c in VELOCITY], -1)
    moved = (C_ne[:-1] @ np.diff(r_e, axis=0)[..., None])[..., 0]
    jump = moved - np.diff(way, axis=0)
    known = np.isfinite(jump).all(1)
    return np.sqrt(np.mean(jump[known] ** 2, 0) / 2) if known.any() else np.zeros(3)


def _integral(t: Array, rate: Array) -> Array:
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(t)
    return np.concatenate(((0.0,), np.cumsum(np.nan_to_num(steps))))


def _epochs(t_imu: Array, t_reference: Array, rate_hz: float, name: str) -> Array:
    """Multiples of 1/rate [s] that both IMU and reference span."""
    first = np.ceil(max(t_imu[0], t_reference[0]) * rate_hz)
    last = np.floor(min(t_imu[-1], t_reference[-1]) * rate_hz)
    if last < first + 1:
        raise InputError(f"drive {name}: IMU and reference have less than two GNSS epochs in common; leave it out")
    return np.arange(first, last + 1) / rate_hz


def _row(described: dict[Any, Any], config: DatasetConfig, spec: ImuSpec, rough: Array) -> dict[str, Any]:
    """The drive's row of ``drives.parquet``: what it was, what was done to it, and the source's licence."""
    return {
        **described,
        "kind": KIND,
        "source": f"{KIND}, motion of: {described.get('source') or 'not stated'}",
        "licence": described.get("licence") or "not stated by the source",
        "imu": f"{spec.name} errors injected into: {described.get('imu') or 'not stated'}",
        "imu_error": INJECTED,
        "gnss": f"{gnss_text(config)}, made of the reference",
        "gnss_rate_hz": config.gnss.rate_hz,
        "reference_roughness_m": float(np.sqrt(np.mean(rough**2))),
        **{f"lever_arm_{axis}_m": float(x) for axis, x in zip("xyz", config.gnss.lever_arm_b)},
    }
