"""Files that are not what their reader reads: one line that says which and why, without a warning beside it."""

from __future__ import annotations

import gzip
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from dlkf.base.errors import InputError
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.formats import columnar
from tests.cars import car
from tests.data.logs.receivers import ubx
from tests.data.test_formats import read


def _text(folder: Path, **options) -> None:
    tables = car(12)
    for kind in ("imu", "gnss"):
        tables[kind].to_csv(folder / f"{kind}.csv", index=False, **options)


def _bytes(name: str, content: bytes) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_bytes(content)

    return write


def _parquet(folder: Path) -> None:
    for kind in ("imu", "gnss"):
        pd.DataFrame({"a": [1.0, 2.0]}).to_parquet(folder / f"{kind}.parquet")


def _half_gzip(folder: Path) -> None:
    _text(folder)
    (folder / "imu.csv.gz").write_bytes(gzip.compress((folder / "imu.csv").read_bytes())[:500])


GZ = "reader.imu.file=imu.csv.gz"
WRONG: dict[str, tuple[Callable[[Path], None], list[str], str]] = {
    "an empty file": (_bytes("imu.csv", b""), ["reader=csv"], "imu.csv: is empty; leave"),
    "a folder": (lambda f: (f / "imu.csv").mkdir(), ["reader=csv"], "Is a directory"),
    "semicolons": (lambda f: _text(f, sep=";"), ["reader=csv"], "set reader.separator=';'"),
    "commas": (_text, ["reader=csv", "reader.separator=';'"], "set reader.separator=',' (+reader.imu.text.separator"),
    "decimal commas": (
        lambda f: _text(f, sep=";", decimal=","),
        ["reader=csv", "reader.separator=';'"],
        "not a number; set reader.decimal=','",
    ),
    "semicolons and commas": (
        lambda f: _text(f, sep=";", decimal=","),
        ["reader=csv"],
        "set reader.separator=';' reader.decimal=','",
    ),
    "no gzip": (_bytes("imu.csv.gz", b"t,gyro_x"), ["reader=csv", GZ], "Not a gzipped file"),
    "half a gzip": (_half_gzip, ["reader=csv", GZ], "ended before"),
    "a Parquet of other columns": (_parquet, ["reader=parquet"], "no column 't'; has a"),
    "a MATLAB file of words": (_bytes("x.mat", b"nonsense"), ["reader=navego"], "cannot be read as a MATLAB file"),
    "a bag of words": (_bytes("x.bag", b"nonsense"), ["reader=rosbag"], "cannot be read as a bag"),
    "UBX of zeros": (_bytes("x.ubx", b"\0" * 99), ["reader=ubx"], "no NAV-PVT"),
    "a map without its column": (_text, ["reader=csv", "reader.gnss.quality.map={RTK: 4}"], "give quality.column"),
    "a quality of words": (_text, ["reader=csv", "reader.gnss.quality.default=best"], "must be a code of NMEA"),
    "a drift of words": (_text, ["reader=csv", "reader.gnss.time.drift_ppm=fast"], "must be a number"),
    "a week of words": (_text, ["reader=csv", "reader.imu.time.week_number=last"], "time.week_number is 'last', must"),
    "a thinning to nothing": (_text, ["reader=csv", "reader.gnss.every_s=0"], "every_s is 0, must be above 0"),
    "a switch of words": (_text, ["reader=csv", "reader.imu.time.respace=often"], "respace is 'often', must be true"),
    "rows before the first": (_text, ["reader=csv", "reader.skip_rows=-1"], "skip_rows is -1, must be"),
    "a misspelt key": (_text, ["reader=csv", "reader.gnss.time.dirft_ppm=3"], "unknown key dirft_ppm"),
    "less than sure": (_text, ["reader=csv", "reader.sure.angle_deg=-2"], "angle_deg"),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.filterwarnings("error::pandas.errors.ParserWarning")
def test_a_wrong_file_is_one_line(name, tmp_path):
    make, options, said = WRONG[name]
    make(tmp_path)
    source = next(iter(sorted(tmp_path.glob("x.*"))), tmp_path)
    with pytest.raises(InputError) as refused:
        read(source, options)
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_an_error_without_a_message_is_named_by_its_class(tmp_path, monkeypatch):
    def fail(_):
        raise OSError

    monkeypatch.setattr(columnar.pq, "ParquetFile", fail)
    with pytest.raises(InputError, match=r"not a whole Parquet or Feather file \(OSError\)"):
        columnar.read(tmp_path / "x.parquet", kind="imu", table=None, text={})


def test_marks_and_letters_of_windows(tmp_path):
    """A byte order mark, Windows' ends of lines, semicolons and decimal commas together."""
    _text(tmp_path, sep=";", decimal=",")
    for file in tmp_path.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_text().replace("\n", "\r\n").encode())
    (drive,) = read(tmp_path, ["reader=csv", "reader.separator=';'", "reader.decimal=','"])
    pd.testing.assert_frame_equal(drive.imu, car(12)["imu"], check_exact=False, atol=1e-9)


@pytest.mark.parametrize("setting", [r"reader.separator='\t'", r"reader.separator='\s*\t'"])
def test_a_tab_as_a_shell_passes_it_and_a_regular_expression(setting, tmp_path):
    _text(tmp_path, sep="\t", decimal=",")
    (drive,) = read(tmp_path, ["reader=csv", setting, "reader.decimal=','"])
    pd.testing.assert_frame_equal(drive.imu, car(12)["imu"], check_exact=False, atol=1e-9)


@pytest.fixture(scope="module")
def logged(tmp_path_factory) -> Path:
    """A UBX log of 90 s beside a table of its IMU."""
    folder, tables = tmp_path_factory.mktemp("logged"), car(90)
    ubx(folder, tables)
    tables["imu"].to_csv(folder / "imu.csv", index=False)
    return folder


def cut(logged: Path, folder: Path, keep: int) -> Path:
    """The log as it ends at a byte, counted from the end where below zero, with the table."""
    shutil.copytree(logged, folder, dirs_exist_ok=True)
    log = folder / "drive.ubx"
    log.write_bytes(log.read_bytes()[:keep])
    return log


@pytest.mark.whole
def test_a_ubx_log_without_its_last_bytes_says_so(logged, tmp_path):
    """It is read but for the last message: as the receiver leaves it when the power goes."""
    (drive,) = read(cut(logged, tmp_path, -5), ["reader=ubx"])
    assert len(drive.gnss) == len(car(90)["gnss"])  # the last message is a NAV-COV
    said = re.compile(r"drive.ubx: the last message is cut off or damaged: \d+ bytes left out")
    assert any(map(said.fullmatch, drive.notes))


@pytest.mark.parametrize(
    ("keep", "said"),
    [
        (50, "drive.ubx: has no NAV-PVT message; .* message cut off, so copy the log again"),
        (4000, "drive.ubx has [12] fix.*, which are not the motion of a car; drive.ubx: the last message is cut off"),
    ],
)
def test_hardly_anything_of_a_ubx_log_is_one_line(keep, said, logged, tmp_path):
    cut(logged, tmp_path, keep)
    with pytest.raises(InputError, match=said) as refused:
        list(AutoReader(imu={"file": "imu.csv"}).read(tmp_path))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("lacking", [["time"], ["altitude"]])
def test_positions_that_make_no_fixes_are_no_log_at_rest(tmp_path, lacking):
    """In a structure of their own, and beside the samples; without GNSS only where the settings say so."""
    t = 0.01 * np.arange(400)
    imu = {"time": t, **{f"{stem}_{axis}": 0 * t for stem in ("acc", "gyr") for axis in "xyz"}}
    imu["acc_z"] = imu["acc_z"] - 9.8
    place = {"time": t, "latitude": 50 + 1e-6 * t, "longitude": 8 + 1e-6 * t, "altitude": 90.0 + 0 * t}
    place = {name: values for name, values in place.items() if name not in lacking}
    scipy.io.savemat(tmp_path / "drive.mat", {"imu": imu, "gps": place})
    with pytest.raises(InputError, match=r"no fixes found in drive\.mat \(gps: .*has positions, lacks"):
        list(AutoReader().read(tmp_path))
    for named in ({"table": "gps"}, {"position": {"columns": ["latitude", "longitude", "altitude"]}}):
        with pytest.raises(InputError, match=r"no GNSS found for reader\.gnss\.(table|position).* \(gps: .*lacks"):
            list(AutoReader(gnss=named).read(tmp_path))
    (got,) = AutoReader(gnss={"file": None}).read(tmp_path)
    assert got.gnss is None
    if lacking == ["altitude"]:
        (tmp_path / "drive.mat").unlink()
        pd.DataFrame({**imu, **place}).to_csv(tmp_path / "drive.csv", index=False)
        with pytest.raises(InputError, match=r"no fixes found in drive\.csv \(.*lacks a height"):
            list(AutoReader().read(tmp_path))
