"""Formats of log files: each module has ``read(path, table, kind, text) -> Table`` and needs one library at most."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dlkf.base.errors import InputError
from dlkf.data.readers.frames import LogTable

FORMATS = {
    "csv": "text",
    "parquet": "columnar",
    "feather": "columnar",
    "ubx": "ubx",
    "nmea": "nmea",
    "rosbag": "rosbag",
    "matlab": "matlab",
    "kitti": "oxts",
    "rtklib": "rtklib",
    "novatel": "novatel",
    "autopilot": "autopilot",
}


def read(format: str, path: Path, *, kind: str, table: str | None, text: Mapping[str, Any], where: str) -> LogTable:
    """The table of a file that holds ``kind`` (imu, gnss, reference), the one called ``table`` if there are several.

    ``text`` holds the options of text files. InputError if the format is unknown, its library is not there, or the
    file is none of that format.
    """
    if format not in FORMATS:
        raise InputError(f"{where}.format={format}: unknown; known are {', '.join(FORMATS)}")
    module = importlib.import_module(f"{__name__}.{FORMATS[format]}")
    return module.read(path, kind=kind, table=table, text=text)


def library(name: str, what: str) -> Any:
    """A third-party module of the extra ``readers``, or an InputError with how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise InputError(f"{what} needs the package {package}; install it with: pip install 'dlkf[readers]'") from None
