"""Frames as a dataset of one drive, checked as those on disk are."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError
from dlkf.frames.checks import check_frames, check_lever_arm

DRIVE = "frames"  # the name of the one drive in the temporary dataset
IN_PYTHON = (  # what a line advises for logs on disk, and what it is for frames
    (r"\breader\.[\w.]+=\S+( and [\w.]+=\S+)?, or ", ""),
    (r" \([^()]*(?:reader\.|dlkf\.ingest )[^()]*\)", ""),
    (r" with aids=\[\]", ""),
    (r"; lower align\.min_speed or leave the drive out", "; give a longer part of the drive, with turns and speed"),
    (r"; reference=smoothed or gnss needs none", "; without reference= the drive smoothed with its fixes is one"),
    (r"; give smaller ones, or outage=null", "; give a smaller outage_s, or a longer drive"),
    (r" or give tracking\.uri=…", " or set MLFLOW_TRACKING_URI"),
    (r"^smoother=rts needs", "smoothed=True needs"),
    (r"give prior\.mean and prior\.std (\(.*\)) or let dlkf\.train find them", r"give prior={'mean': …, 'std': …} \1"),
    (r"outage\.first_s=60 and outage\.duration_s=", "60 s with GNSS first and outage_s="),
)
PLACE = re.compile(rf"drive {DRIVE}, (\w+)(/drive={DRIVE})?")


@contextmanager
def drive_folder(
    imu: pd.DataFrame, gnss: pd.DataFrame, reference: pd.DataFrame | None, lever_arm: Sequence[float],
    aids: Mapping[str, pd.DataFrame | None],
) -> Iterator[Path]:  # fmt: skip
    """A temporary dataset of one drive, checked where it is read.

    Error lines name the frames, not its files, and what callers can do, not settings of commands.
    """
    from dlkf.data.schema import ATTITUDE, LEVER_ARM, STD, VELOCITY, write_drive, write_drives_table

    check_frames(imu, gnss, reference, aids)
    arm = check_lever_arm(lever_arm)
    meta = {"drive": DRIVE} | dict(zip(LEVER_ARM, arm))
    fixes = _complete("gnss", gnss, dict.fromkeys((*VELOCITY, *STD), np.nan) | {"quality": 1})
    fixes["quality"] = fixes["quality"].fillna(1).astype(np.int8)
    unknown = dict.fromkeys((*VELOCITY, *ATTITUDE), np.nan) | {"valid": True}
    truth = None if reference is None else _complete("reference", reference, unknown)
    given = {kind: _complete(kind, frame, {}) for kind, frame in aids.items() if frame is not None}
    with in_python(), TemporaryDirectory(prefix="dlkf-") as here:
        folder = Path(here) / "frames"
        row = write_drive(folder, meta, _complete("imu", imu, {}), fixes, truth, given)
        write_drives_table(folder, [row])
        yield folder


@contextmanager
def in_python() -> Iterator[None]:
    """InputErrors that say what to do in Python, not on a command line (:func:`reword`)."""
    try:
        yield
    except InputError as error:
        raise InputError(reword(str(error))) from None


def _complete(kind: str, frame: pd.DataFrame, defaults: Mapping[str, Any]) -> pd.DataFrame:
    """The contract's columns of a frame as numbers; those that it lacks by their defaults."""
    from dlkf.data.schema import AIDS, OPTIONAL, SCHEMAS

    names = (*{**SCHEMAS, **AIDS}[kind].names, *OPTIONAL[kind].names)
    kept = {name: frame[name] for name in names if name in frame}
    mixed = {name: x for name, x in kept.items() if not pd.api.types.is_numeric_dtype(x)}  # objects, categories
    kept |= {name: pd.to_numeric(x.astype(object)) for name, x in mixed.items()}
    return pd.DataFrame({**kept, **{name: value for name, value in defaults.items() if name not in frame}})


def reword(line: str) -> str:
    """``drive frames, imu/drive=frames: row 3: …`` → ``imu: row 3: …``."""
    line = PLACE.sub(r"\1", line).replace(f"drive {DRIVE}: ", "").replace(f"drive {DRIVE}", "this drive")
    for advice, instead in IN_PYTHON:
        line = re.sub(advice, instead, line)
    if "reader." in line:
        line += " (reader.…: keys of dlkf ingest; or change the frame)"
    return line
