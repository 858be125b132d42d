"""Any number of hours of simulated drives as a dataset of the data contract, the same for a seed."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from rich.console import Console
from rich.progress import track

from dlkf.data.schema import drive_file, new_dataset, write_drive, write_drives_table, write_parquet
from dlkf.errors import InputError
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.settings import built
from dlkf.simulation.drive import Rates, Seeds, simulate_drive
from dlkf.simulation.gnss.almanac import read_almanac
from dlkf.simulation.gnss.receiver import Receiver, receiver_spec
from dlkf.simulation.gnss.surroundings import Surroundings
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.imu import draw_unit
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import VehicleConfig

LONGEST_DRIVE = 240.0  # minutes; a drive is held in memory as a whole
MOST_EPOCHS = 100_000  # of a drive with satellites, 2 GB


@dataclass(frozen=True)
class DatasetConfig:
    """What to simulate. ``imu_errors``: ``one`` unit for all drives, a new one ``per_drive``, or a ``fleet``.

    With ``one``, turn-on bias, scale factors and misalignment are drawn once, from ``unit_seed``: the same
    IMU on other roads is another seed with the same ``unit_seed``. White noise and the in-run bias belong to
    each drive either way. With ``fleet``, each drive has a new unit of a type drawn from ``fleet``.
    Fixes come from the satellites that a ``receiver`` sees, or have white noise without one; ``raw`` keeps its
    observations as well.
    """

    name: str
    hours: float = 5.0
    drive_minutes: float = 10.0
    imu_rate_hz: int = 100
    reference_rate_hz: int = 10
    imu_errors: str = "one"
    unit_seed: int = 0
    fleet: Mapping[str, ImuSpec] = field(default_factory=dict)
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    chassis: ChassisConfig = field(default_factory=ChassisConfig)
    surroundings: Surroundings = field(default_factory=Surroundings)
    gnss: GnssConfig = field(default_factory=GnssConfig)
    receiver: Receiver | None = None
    raw: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise InputError(f"dataset: name {self.name!r} must be letters, digits, _ . - ")
        if not 0.005 <= self.hours <= 1e5:
            raise InputError(f"dataset: hours {self.hours} is outside 0.005 (18 s) to 100000")
        if not 0.25 <= self.drive_minutes <= LONGEST_DRIVE:
            raise InputError(
                f"dataset: drive_minutes {self.drive_minutes} is outside 0.25 to {LONGEST_DRIVE:g}"
            )
        for name in ("imu_rate_hz", "reference_rate_hz"):
            rate = getattr(self, name)
            if rate != round(rate) or not 1 <= rate <= 2000:
                raise InputError(f"dataset: {name} {rate} must be a whole number from 1 to 2000")
        if self.imu_rate_hz < 10:
            raise InputError(f"dataset: imu_rate_hz {self.imu_rate_hz} is below 10, too slow for a car")
        rates = {"gnss.rate_hz": self.gnss.rate_hz, "reference_rate_hz": self.reference_rate_hz}
        for name, rate in rates.items():
            samples = self.imu_rate_hz / rate if rate > 0 else 0.0
            if samples < 1 or abs(samples - round(samples)) > 1e-9:
                raise InputError(
                    f"dataset: imu_rate_hz {self.imu_rate_hz} is not a multiple of {name} {rate}"
                )
        if self.imu_errors not in ("one", "per_drive", "fleet"):
            raise InputError(f"dataset: imu_errors {self.imu_errors!r} must be one, per_drive or fleet")
        if self.imu_errors == "fleet" and not self.fleet:
            raise InputError("dataset: imu_errors is fleet, but fleet names no IMU presets (see simulated/fleet.yaml)")
        if not isinstance(self.unit_seed, int) or self.unit_seed < 0:
            raise InputError(f"dataset: unit_seed {self.unit_seed!r} must be a whole number ≥ 0")
        if not isinstance(self.raw, bool) or (self.raw and self.receiver is None):
            raise InputError(f"raw={self.raw}: there are raw observations with a satellite receiver=<preset> only")
        epochs = self.gnss.rate_hz * self.drive_minutes * 60
        if self.receiver is not None and epochs > MOST_EPOCHS:
            raise InputError(
                f"dataset: gnss.rate_hz {self.gnss.rate_hz} over drive_minutes {self.drive_minutes:g} are {epochs:.0f} "
                f"epochs of satellites, more than {MOST_EPOCHS}; make the drives shorter or the rate lower"
            )

    @property
    def durations(self) -> list[int]:
        """Whole seconds of every drive: the hours shared out evenly over drives of at most drive_minutes."""
        total = round(self.hours * 3600)
        drives = math.ceil(total / (self.drive_minutes * 60) - 1e-9)
        return [total // drives + (k < total % drives) for k in range(drives)]


def dataset_config(config: Mapping[str, Any]) -> DatasetConfig:
    """A dataset from a mapping like ``conf/simulated/*.yaml``. InputError for unknown keys and odd values."""
    if not isinstance(config, Mapping) or not isinstance(config.get("name"), str):
        raise InputError("dataset: name is missing, give it as in conf/simulated/*.yaml")
    fleet = config.get("fleet") or {}
    if not isinstance(fleet, Mapping):
        raise InputError(f"dataset: fleet is {fleet!r}, must be a mapping of IMU presets")
    return built(DatasetConfig, {**config, "fleet": {key: imu_spec(fleet[key]) for key in fleet}}, "dataset")


def simulate_from_config(
    config: Mapping[str, Any], out: str | Path, *, overwrite: bool = False, progress: bool = True
) -> Path:
    """Simulate what a mapping with ``dataset``, ``imu``, ``seed`` and perhaps ``workers`` says into ``out``.

    InputError as of :func:`dataset_config`, :func:`imu_spec` and :func:`simulate_dataset`.
    """
    settings, spec, seed = simulation_settings(config)
    workers = config.get("workers")
    if workers is not None and (not isinstance(workers, int) or workers < 1):
        raise InputError(f"simulation: workers {workers!r} must be a whole number ≥ 1")
    return simulate_dataset(
        settings, spec, seed, Path(out), overwrite=overwrite, workers=workers, progress=progress
    )


def simulation_settings(config: Mapping[str, Any]) -> tuple[DatasetConfig, ImuSpec, int]:
    """Dataset, IMU and seed from a mapping with ``dataset``, ``imu``, ``seed``, perhaps ``receiver`` and ``raw``."""
    for key in ("dataset", "imu", "seed"):
        if config.get(key) is None:
            raise InputError(f"simulation: {key} is missing")
    seed = config["seed"]
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"simulation: seed {seed!r} must be a whole number ≥ 0")
    gnss = {"receiver": receiver_spec(config.get("receiver")), "raw": config.get("raw", False)}
    return replace(dataset_config(config["dataset"]), **gnss), imu_spec(config["imu"]), seed


def simulate_dataset(
    config: DatasetConfig,
    spec: ImuSpec,
    seed: int,
    out: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> Path:
    """Write the dataset to ``out``, whole or not at all, and return its path.

    Drive k depends on the seed and k alone, whatever the number of ``workers`` (threads; by default one per
    core). Memory is that of ``workers`` drives, whatever the hours. InputError if ``out`` exists.
    """
    with new_dataset(out, overwrite) as folder:
        _write_drives(config, spec, seed, folder, workers or os.cpu_count() or 1, progress)
    return out


def _write_drives(
    config: DatasetConfig, spec: ImuSpec, seed: int, folder: Path, workers: int, progress: bool
) -> None:
    durations = config.durations
    shared = draw_unit(np.random.default_rng(np.random.SeedSequence(config.unit_seed, spawn_key=(0,))), spec)
    rates = Rates(int(config.imu_rate_hz), config.gnss.rate_hz, int(config.reference_rate_hz))

    def one(index: int) -> dict[str, Any]:
        motion, imu, gnss, unit_seed, *others, type_seed = np.random.SeedSequence(seed, spawn_key=(1, index)).spawn(7)
        kind = imu_type(config, spec, type_seed)
        unit = shared if config.imu_errors == "one" else draw_unit(np.random.default_rng(unit_seed), kind)
        seconds = durations[index]
        tables = simulate_drive(
            Seeds(motion, imu, gnss, *others), seconds, rates, config.vehicle, config.chassis, config.surroundings,
            kind, unit, config.gnss, config.receiver,
        )  # fmt: skip
        name = f"{config.name}-{seed}-{index:05d}"
        row = {
            "drive": name,
            "group": name,
            "source": f"simulation, seed {seed}, drive {index}",
            "licence": "none: simulated",
            "imu": kind.name,
            "gnss": gnss_text(config),
            "reference": "exact",
            "imu_rate_hz": float(rates.imu_hz),
            "gnss_rate_hz": float(rates.gnss_hz),
            "duration_s": float(seconds),
            **{f"lever_arm_{axis}_m": float(x) for axis, x in zip("xyz", config.gnss.lever_arm_b)},
            **tables.facts,
        }
        write_drive(folder, row, tables.imu, tables.gnss, tables.reference)
        if config.raw:
            write_raw(folder, name, tables.raw)
        return row

    with ThreadPoolExecutor(workers) as pool:
        try:  # from here on, so that an interrupt never waits for drives that have not begun
            jobs = [pool.submit(one, index) for index in range(len(durations))]
            shown = track(
                as_completed(jobs), f"simulating {config.name}", total=len(jobs),
                disable=not progress, console=Console(stderr=True),
            )  # fmt: skip
            for job in shown:
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    write_drives_table(folder, [job.result() for job in jobs])
    described = {"seed": seed, "dataset": asdict(config), "imu": asdict(spec)}
    (folder / "simulation.json").write_text(json.dumps(described, indent=2, ensure_ascii=False) + "\n")


def gnss_text(config: DatasetConfig) -> str:
    """How the fixes were made, for ``drives.parquet``."""
    if config.receiver is None:
        return f"simulated, white noise, quality {config.gnss.quality}"
    almanac = read_almanac(config.receiver.almanac)
    return f"simulated from satellites, receiver {config.receiver.name}, GPS almanac of week {almanac.week}"


def write_raw(folder: Path, drive: str, raw: pd.DataFrame | None) -> None:
    """Raw observations of a drive beside its other tables, ``raw/drive=<id>/part-0.parquet``."""
    if raw is not None:
        write_parquet(drive_file(folder, "raw", drive), pa.Table.from_pandas(raw, preserve_index=False))


def imu_type(config: DatasetConfig, spec: ImuSpec, seed: np.random.SeedSequence) -> ImuSpec:
    """The IMU preset of a drive: the dataset's, or one of the fleet's."""
    if config.imu_errors != "fleet":
        return spec
    types = list(config.fleet.values())
    return types[np.random.default_rng(seed).integers(len(types))]
