"""Calls and frames that a newcomer gets wrong: one line each, which points the right way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dlkf
from dlkf.data.schema import ACCEL, GYRO
from tests.commands.refusals import read_wrong
from tests.wrong.conftest import Frames

HERE = Path(__file__).parent
LONGEST = 600  # letters of a line
PI = np.pi / 180


class Polars:
    """A frame of a library that knows the way to pandas."""

    def to_pandas(self) -> pd.DataFrame:
        return pd.DataFrame()


def put(frame: pd.DataFrame, column: str, row: int, value: Any) -> pd.DataFrame:
    """A value in one row."""
    values = frame[column].to_numpy(object if isinstance(value, str) else float).copy()
    values[row] = value
    return frame.assign(**{column: values})


def times(frame: pd.DataFrame, factor: float, *columns: str) -> pd.DataFrame:
    """Columns in another unit."""
    return frame.assign(**{c: frame[c] * factor for c in columns})


def plus(frame: pd.DataFrame, seconds: float) -> pd.DataFrame:
    """Another clock."""
    return frame.assign(t=frame.t + seconds)


def ddmm(frame: pd.DataFrame) -> pd.DataFrame:
    """Degrees and minutes as a receiver prints them."""
    return frame.assign(**{c: np.trunc(frame[c]) * 100 + frame[c] % 1 * 60 for c in ("lat_deg", "lon_deg")})


SPOIL = {"np": np, "pd": pd, "PI": PI, "ACCEL": ACCEL, "GYRO": GYRO, "Polars": Polars}
SPOIL |= {"put": put, "times": times, "plus": plus, "ddmm": ddmm}


def names_of_calls(frames: Frames, here: Path) -> dict[str, Any]:
    """What stands in ``calls.txt``: the public functions, the frames, files that are no logs in a folder."""

    def file_of(here: Path, name: str, content: bytes) -> Path:
        (here / name).write_bytes(content)
        return here / name

    def dataset(here: Path) -> Path:
        file_of(here, "drives.parquet", b"")
        return here

    def picture(here: Path) -> Path:
        return file_of(here, "car.png", b"\x89PNG\r\n\x1a\n" + bytes(range(256)))

    def half_a_parquet(here: Path) -> Path:
        """A folder of a drive whose fixes were not copied whole."""
        for kind in ("imu", "gnss"):
            frames[kind].to_parquet(here / f"{kind}.parquet")
        file_of(here, "gnss.parquet", (here / "gnss.parquet").read_bytes()[:500])
        return here

    def zipped(here: Path) -> Path:
        """A folder that holds an archive alone, cut short."""
        file_of(here, "log.zip", b"PK\3\4" + bytes(range(256)))
        return here

    def solved() -> dlkf.Solution:
        """A solution, by the fastest filter."""
        return dlkf.navigate(frames["imu"], frames["gnss"], model="ins", rate_hz=10)

    public = {name: getattr(dlkf, name) for name in dlkf.PUBLIC}
    return {**SPOIL, **public, **frames, **{k: v for k, v in locals().items() if callable(v)}, "here": here}


def check(line: str, said: str) -> None:
    """One line, short, which says this and names no file of the temporary dataset."""
    assert "\n" not in line and len(line) < LONGEST, line
    assert "drive=frames" not in line and "/tmp" not in line.replace("/tmp/pytest", ""), line
    assert said and said in line, line


@pytest.mark.parametrize("wrong", read_wrong(HERE / "calls.txt"))
def test_a_call(wrong: str, frames: Frames, tmp_path: Path) -> None:
    call, said = wrong.split(" -> ")
    with pytest.raises(dlkf.InputError) as error:
        eval(call, names_of_calls(frames, tmp_path))
    check(str(error.value), said)


@pytest.mark.parametrize("wrong", read_wrong(HERE / "frames.txt"))
def test_a_frame(wrong: str, frames: Frames) -> None:
    which, spoil, said = wrong.replace(": ", " -> ", 1).split(" -> ")
    tables = {k: frames[k] for k in ("imu", "gnss")} | {which: eval(spoil, {**SPOIL, "f": frames[which]})}
    with pytest.raises(dlkf.InputError) as error:
        dlkf.navigate(tables.pop("imu"), tables.pop("gnss"), model="mbkf21_nhc", **tables)
    check(str(error.value), said)
