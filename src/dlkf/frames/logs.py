"""Drives as frames: simulated ones, and logs in other formats, units and axes."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pandas as pd

from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError
from dlkf.frames.checks import check_above_zero, check_preset, check_switch, check_whole

if TYPE_CHECKING:
    from dlkf.data.intake import IngestResult
    from dlkf.data.readers.frames import DriveFrames

OWN = "own_reader"  # a user's file among the presets of conf/reader
SHORTEST_MIN, LONGEST_MIN = 0.3, 240.0  # of a simulated drive


def simulate(
    preset: str = "lifelike", *, minutes: float = 10.0, drives: int = 1, seed: int = 0, imu_type: str | None = None
) -> list[DriveFrames]:
    """Simulated drives with a reference without error.

    Parameters
    ----------
    preset : str
        Of ``conf/simulated``: ``lifelike``, ``city``, ``highway``, ``tunnel``, ``fleet``, …
    minutes : float
        Length of each drive.
    drives : int
        How many.
    seed : int
        The same seed gives the same drives.
    imu_type : str, optional
        A preset of ``conf/imu``; default: the preset's own. Not for ``fleet`` and ``other_imus``, which draw the IMU
        type of each drive.

    Returns
    -------
    list of DriveFrames
        Each with ``imu``, ``gnss`` and ``reference`` frames and ``meta``: its name, lever arm [m], sensors.

    Raises
    ------
    InputError
        For a preset that does not exist, and ``minutes`` or ``drives`` out of range.
    """
    from dlkf.command.simulated import SEMI_REAL, compose_recipe
    from dlkf.data.readers.frames import DriveFrames
    from dlkf.data.schema import drive_file
    from dlkf.data.tables import read_drives_table
    from dlkf.simulation.dataset import simulate as simulate_dataset

    if preset == SEMI_REAL:
        raise InputError(f"preset={SEMI_REAL!r} needs real drives: dlkf simulate source=<dataset of real drives>")
    check_preset("simulated", preset)
    if imu_type is not None:
        check_preset("imu", imu_type, "imu_type")
    check_above_zero(minutes=minutes)
    if not SHORTEST_MIN <= minutes <= LONGEST_MIN:
        raise InputError(f"minutes is {minutes:g}, must be from {SHORTEST_MIN:g} to {LONGEST_MIN:g} a drive")
    drives, seed = check_whole("drives", drives, 1), check_whole("seed", seed, 0)
    words = [f"simulated@dataset={preset}", f"dataset.hours={minutes * drives / 60}", f"seed={seed}"]
    words += [f"dataset.drive_minutes={minutes}", *([f"imu={imu_type}"] if imu_type else [])]
    recipe = compose_recipe(*words)
    if imu_type is not None and recipe.dataset.imu_errors == "fleet":
        kinds = ", ".join(kind.name for kind in recipe.dataset.fleet.values())
        raise InputError(f"imu_type has no effect on preset={preset!r}: the IMU of each drive is one of {kinds}")
    with TemporaryDirectory(prefix="dlkf-") as folder:
        out = Path(folder) / "simulated"
        simulate_dataset(recipe, out, progress=False)
        made = []
        for row in read_drives_table(out).to_dict("records"):
            files = (drive_file(out, kind, str(row["drive"])) for kind in ("imu", "gnss", "reference"))
            imu, gnss, reference = map(pd.read_parquet, files)
            made.append(DriveFrames({str(key): value for key, value in row.items()}, imu, gnss, reference))
        return made


def read_logs(
    source: str | Path, reader: str | Path = "auto", *settings: str, skip_unsure: bool = False
) -> list[DriveFrames]:
    """Logs in other formats and units as frames in the contract's columns and units, a drive each.

    Parameters
    ----------
    source : str or Path
        A file, a folder with one drive, an app's ``.zip``, or a folder with a subfolder or ``.zip`` per drive.
    reader : str or Path
        A preset of ``conf/reader``; ``auto`` finds format, units, clocks and mounting. Or a YAML file of your own with
        the keys of one, such as ``mine/reader/xsens.yaml``.
    *settings : str
        What is known, as on the command line: ``"reader.imu.accel.unit=g"``, ``"reader.gnss.time.offset_s=0.3"``.
    skip_unsure : bool
        Skip drives that cannot be read, or that have too little motion for the estimates, with a warning; otherwise
        the first one is an error.

    Returns
    -------
    list of DriveFrames
        Each with ``imu``, ``gnss``, ``reference`` (or None), ``aids`` (speed, heading, baro where there are any),
        ``meta`` (its row of ``drives.parquet``) and ``notes``: what was found and what was left out.

    Raises
    ------
    InputError
        For what cannot be read: which file, what is missing, and the setting that mends it.
    """
    from dlkf.base.classes import instantiate
    from dlkf.data.intake import IngestResult, read_together

    if not isinstance(source, (str, Path)):
        raise InputError(f"source is a {type(source).__name__}, must be the path of a file or a folder with logs")
    if not str(source) or "://" in str(source):
        raise InputError(f"source is {str(source)!r}, must be a file or a folder of this machine")
    check_switch("skip_unsure", skip_unsure)
    place = Path(source).expanduser()
    if (place / "drives.parquet").is_file():
        raise InputError(f"{source} is a dataset already: pandas.read_parquet reads its tables, dlkf navigate takes it")
    for word in settings:
        if not isinstance(word, str) or not word.startswith("reader.") or "=" not in word:
            raise InputError(f"{word!r} is no setting of a reader; one is text such as 'reader.imu.accel.unit=g'")
    opened = instantiate(_compose_reader(reader, settings), "reader", ("read",))
    if not hasattr(opened, "places"):
        return list(opened.read(str(place)))
    places = opened.places(place)
    made: dict[str, DriveFrames] = {}

    def keep_frames(drive: DriveFrames) -> IngestResult:
        return IngestResult([{"drive": drive}], [], drive.notes, drive.mapping)

    for result in read_together(opened, keep_frames, places, None, skip_unsure):
        for row in result.rows:
            drive = row["drive"]
            made[drive.name] = replace(drive, notes=result.notes)
        if not result.rows:
            warnings.warn("; ".join(result.notes), UserWarning, stacklevel=2)
    return [made[name] for _, name, _ in places if name in made]


def _compose_reader(reader: str | Path, settings: Sequence[str]) -> Mapping[str, Any]:
    """The settings of a reader: those of a preset, or of a YAML file with the keys of one."""
    from dlkf.command.arguments import quote_argument
    from dlkf.command.composing import compose_command
    from dlkf.command.faults import describe_fault

    file = Path(reader).expanduser() if isinstance(reader, (str, Path)) else Path()
    own = file.suffix in (".yaml", ".yml")
    if not own:
        check_preset("reader", reader)
    elif not file.is_file():
        raise InputError(f"reader is {str(reader)!r}: no such file")
    elif not isinstance(read_yaml(file), dict):
        raise InputError(f"{reader} has no keys of a reader; conf/reader/csv.yaml explains them")
    words = ["source=logs", "out=data", *(f"++{quote_argument(word)}" for word in settings)]
    with TemporaryDirectory(prefix="dlkf-") as folder:
        if own:
            (Path(folder) / "reader").mkdir()
            shutil.copyfile(file, Path(folder) / "reader" / f"{OWN}.yaml")
            words.append(f'hydra.searchpath=["file://{Path(folder).as_posix()}"]')
        try:
            return compose_command("ingest", f"reader={OWN if own else reader}", *words)["reader"]
        except Exception as error:
            if (said := describe_fault(error, "ingest")) is None:
                raise
            raise InputError(f"reader {reader}: {said}") from None
