"""Any number of hours of simulated drives as a dataset of the data contract, the same for a seed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from rich.console import Console
from rich.progress import track

from dlkf.base.errors import InputError
from dlkf.base.files import absolute_place, is_url, resolve_place
from dlkf.base.parallel import check_engine, parallel_map
from dlkf.base.ranges import draw_ranges, has_ranges, range_middle
from dlkf.base.settings import settings_from
from dlkf.data.schema import drive_file, new_dataset, write_drive, write_drives_table, write_parquet
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.simulation.drive import DatasetConfig, Seeds, SimulatedTables, simulate_drive
from dlkf.simulation.gnss.almanac import read_almanac
from dlkf.simulation.gnss.receiver import receiver_spec
from dlkf.simulation.imu import ImuUnit, draw_unit
from dlkf.simulation.sensors import SensorsConfig

OF_ALL_DRIVES = ("name", "hours", "drive_minutes", "imu_errors", "unit_seed")


def dataset_config(config: Mapping[str, Any]) -> DatasetConfig:
    """A dataset from a mapping like ``conf/simulated/*.yaml``, of ranges the middle.

    InputError for unknown keys and odd values.
    """
    config = range_middle(config)
    if not isinstance(config, Mapping) or not isinstance(config.get("name"), str):
        raise InputError("dataset: name is missing, give it as in conf/simulated/*.yaml")
    fleet = config.get("fleet") or {}
    if not isinstance(fleet, Mapping):
        raise InputError(f"dataset: fleet is {fleet!r}, must be a mapping of IMU presets")
    return settings_from(DatasetConfig, {**config, "fleet": {key: imu_spec(fleet[key]) for key in fleet}}, "dataset")


@dataclass(frozen=True)
class Recipe:
    """What a dataset is made by: settings of the whole, and those of a drive, which ranges may draw for each.

    ``ranges``: a mapping with ``dataset``, ``imu`` and ``receiver`` as :mod:`dlkf.base.ranges` has them, or none.
    """

    dataset: DatasetConfig
    imu: ImuSpec
    seed: int
    ranges: Mapping[str, Any] | None = None

    def draw_drive(self, seed: np.random.SeedSequence) -> tuple[DatasetConfig, ImuSpec]:
        """The settings of one drive. InputError where what was drawn is impossible."""
        return (self.dataset, self.imu) if self.ranges is None else _settings(draw_ranges(self.ranges, seed))

    @property
    def described(self) -> dict[str, Any]:
        """All of it as plain values, ranges as ranges."""
        plain = self.ranges or {"dataset": _plain(self.dataset), "imu": asdict(self.imu)}
        return {"seed": self.seed, **plain}


def make_recipe(
    dataset: Mapping[str, Any],
    imu: Mapping[str, Any],
    seed: int,
    receiver: Mapping[str, Any] | None = None,
    sensors: Mapping[str, Any] | None = None,
    *,
    raw: bool = False,
) -> Recipe:
    """Of the values of presets, in which ranges may stand; InputError for odd ones."""
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"simulation: seed {seed!r} must be a whole number ≥ 0")
    plain: dict[str, Any] = {"dataset": dataset, "imu": imu, "receiver": receiver, "raw": raw}
    if sensors and any(sensors.values()):
        plain["sensors"] = sensors
    settings, spec = _settings(range_middle(plain))
    if not has_ranges(plain):
        return Recipe(settings, spec, seed)
    for key in OF_ALL_DRIVES:
        if has_ranges(dataset.get(key)):
            raise InputError(f"dataset: {key} is a range, but all drives have the same; give a value")
    if has_ranges(imu) and settings.imu_errors == "one":
        raise InputError("imu: is drawn for every drive, but dataset.imu_errors is one; set dataset.imu_errors=wide")
    return Recipe(settings, spec, seed, plain)


@dataclass(frozen=True, kw_only=True)
class SimulateSettings:
    """``dlkf simulate``; the presets may hold ranges."""

    dataset: Mapping[str, Any]
    imu: Mapping[str, Any]
    receiver: Mapping[str, Any] | None
    seed: int
    out: str
    raw: bool
    source: str | None
    overwrite: bool
    workers: int | None
    parallel: int | str | None
    sensors: Mapping[str, Any] | None = None

    @property
    def recipe(self) -> Recipe:
        """What the drives are made by."""
        return make_recipe(self.dataset, self.imu, self.seed, self.receiver, self.sensors, raw=self.raw)


def _settings(plain: Mapping[str, Any]) -> tuple[DatasetConfig, ImuSpec]:
    settings = dataset_config(plain["dataset"])
    sensors = settings_from(SensorsConfig, plain["sensors"], "sensors") if "sensors" in plain else None
    settings = replace(settings, receiver=receiver_spec(plain["receiver"]), raw=plain["raw"], sensors=sensors)
    return settings, imu_spec(plain["imu"])


def _plain(config: DatasetConfig) -> dict[str, Any]:
    """For a file; a dataset without further sensors is described as it was before there were any."""
    values = asdict(config)
    return values if config.sensors else {key: value for key, value in values.items() if key != "sensors"}


def simulate_dataset(config: DatasetConfig, spec: ImuSpec, seed: int, out: Path, **options: Any) -> Path:
    """Write a dataset without ranges to ``out``, by :func:`simulate`."""
    return simulate(Recipe(config, spec, seed), out, **options)


def simulate(
    made_by: Recipe,
    out: Path,
    *,
    overwrite: bool = False,
    workers: int | None = None,
    parallel: int | str | None = None,
    progress: bool = True,
) -> Path:
    """Write the dataset to ``out``, whole or not at all, and return its path.

    Drive k depends on the seed and k alone, not on the number of ``workers`` (threads; by default one per
    core) or what ``parallel`` asks for (:func:`dlkf.base.parallel.parallel_map`). Memory is that of
    ``workers`` drives, whatever the hours. InputError if ``out`` exists.
    """
    check_engine(parallel, out)
    if workers is not None and workers < 1:
        raise InputError(f"workers={workers} must be at least 1")
    config, threads = made_by.dataset, workers or os.cpu_count() or 1
    jobs = list(enumerate(config.durations))
    with new_dataset(out, overwrite) as folder:
        written = parallel_map(partial(_write_one, made_by, absolute_place(folder)), jobs, parallel, threads=threads)
        unseen, console = not (progress and sys.stderr.isatty()), Console(stderr=True)
        shown = track(written, f"simulating {config.name}", total=len(jobs), disable=unseen, console=console)
        with closing(shown) as rows:  # type: ignore[type-var]
            write_drives_table(folder, list(rows))
        (folder / "simulation.json").write_text(
            json.dumps(made_by.described, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
        )
    return out


def draw_presets(
    made_by: Recipe,
    unit_seed: np.random.SeedSequence,
    type_seed: np.random.SeedSequence,
    ranges_seed: np.random.SeedSequence,
) -> tuple[DatasetConfig, ImuSpec, ImuSpec, ImuUnit]:
    """Of a drive: its settings and IMU preset out of the ranges, the type of its IMU, and the unit."""
    config, spec = made_by.draw_drive(ranges_seed)
    kind = imu_type(config, spec, type_seed)
    if config.imu_errors == "one":
        unit_seed = np.random.SeedSequence(config.unit_seed, spawn_key=(0,))
    return config, spec, kind, draw_unit(np.random.default_rng(unit_seed), kind)


def make_drive(made_by: Recipe, index: int, seconds: int) -> tuple[SimulatedTables, dict[str, Any]]:
    """Drive ``index`` of a dataset, ``seconds`` long: its tables, and its row of ``drives.parquet``."""
    motion, imu, gnss, unit_seed, surroundings, chassis, type_seed, ranges_seed = np.random.SeedSequence(
        made_by.seed, spawn_key=(1, index)
    ).spawn(8)
    config, spec, kind, unit = draw_presets(made_by, unit_seed, type_seed, ranges_seed)
    sensors = np.random.SeedSequence(made_by.seed, spawn_key=(2, index))
    tables = simulate_drive(Seeds(motion, imu, gnss, surroundings, chassis, sensors), seconds, config, kind, unit)
    name = f"{config.name}-{made_by.seed}-{index:05d}"
    row = {
        "drive": name,
        "group": name,
        "source": f"simulation, seed {made_by.seed}, drive {index}",
        "licence": "none: simulated",
        "imu": kind.name,
        "gnss": gnss_text(config),
        "reference": "exact",
        "imu_rate_hz": float(config.imu_rate_hz),
        "gnss_rate_hz": float(config.gnss.rate_hz),
        "duration_s": float(seconds),
        **{f"lever_arm_{axis}_m": float(x) for axis, x in zip("xyz", config.gnss.lever_arm_b)},
        **tables.facts,
    }
    if made_by.ranges is not None:
        row["drawn"] = json.dumps({"dataset": _plain(config), "imu": asdict(spec)}, ensure_ascii=False)
    return tables, row


def _write_one(made_by: Recipe, out: str, job: tuple[int, int]) -> dict[str, Any]:
    """A drive by its index and seconds, in its place; its row of ``drives.parquet``."""
    tables, row = make_drive(made_by, *job)
    folder = resolve_place(out)
    if not is_url(out) and not folder.is_dir():
        raise InputError(f"{out} does not exist: the worker does not share the folder, or the command has ended")
    write_drive(folder, row, tables.imu, tables.gnss, tables.reference, tables.aids)
    if made_by.dataset.raw:
        write_raw(folder, row["drive"], tables.raw)
    return row


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
