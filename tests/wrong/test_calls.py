"""Calls of the public functions that a newcomer gets wrong: one line each, which points the right way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dlkf
from tests.wrong.spoiling import PI, Frames, check, plus, times

KALMAN = {"model": "mbkf15"}

CALLS: dict[str, tuple[Callable[[Frames, Path], Any], str]] = {
    "imu and gnss exchanged": (lambda d, _: dlkf.navigate(d["gnss"], d["imu"]), "imu and gnss look exchanged"),
    "imu twice": (lambda d, _: dlkf.navigate(d["imu"], d["imu"]), "imu and gnss are the same frame"),
    "no such filter": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="mbkf16"),
        "unknown model 'mbkf16'; did you mean mbkf15?",
    ),
    "plus misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="pluss"),
        "unknown model 'pluss'; did you mean plus?",
    ),
    "a suffix misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model="mbkf21_nch"),
        "unknown model 'mbkf21_nch'; did you mean mbkf21_nhc?",
    ),
    "two filters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model=["mbkf15", "plus"]),
        "model is a list, must be a name",
    ),
    "a filter that is none": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], model=None),
        "model is a NoneType, must be a name",
    ),
    "a preset misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type="consumr", **KALMAN),
        "unknown imu preset 'consumr'; did you mean consumer? known are",
    ),
    "a preset that is a number": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type=5, **KALMAN),
        "imu_type is 5, must be the name of a preset",
    ),
    "half a preset": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type={"name": "x"}, **KALMAN),
        "IMU preset x: accel, gyro missing",
    ),
    "imu_type=auto": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], imu_type="auto", **KALMAN),
        "imu_type='auto': only the command dlkf navigate finds the noise",
    ),
    "a tuning misspelt": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], tuning="any_care", **KALMAN),
        "unknown tuning preset 'any_care'; did you mean any_car?",
    ),
    "a factor that is none": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], tuning={"accel_nois": 2.0}, **KALMAN),
        "tuning: unknown key accel_nois; did you mean accel_noise? known are",
    ),
    "an arm of two": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(1, 2)),
        "lever_arm is (1, 2), must be three numbers",
    ),
    "an arm of letters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm="abc"),
        "lever_arm is 'abc', must be three numbers",
    ),
    "an arm of nine": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=np.zeros((3, 3))),
        "lever_arm is array([[0., 0., 0.], [0., 0., 0.], [0., 0., 0.]]), must be three numbers",
    ),
    "an arm of one": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=1.2),
        "lever_arm is 1.2, must be three numbers",
    ),
    "an arm in mm": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(1000, 0, -1200)),
        "an antenna 1200 m away; metres are meant",
    ),
    "an arm of NaN": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], lever_arm=(np.nan, 0, 0)),
        "lever_arm is (nan, 0, 0), must be three numbers",
    ),
    "a rate below 0": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz=-50, **KALMAN),
        "rate_hz is -50, must be a number above 0",
    ),
    "a rate of letters": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz="50", **KALMAN),
        "rate_hz is '50', must be a number above 0",
    ),
    "a rate mistyped": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], rate_hz=5e6, **KALMAN),
        "rate_hz is 5000000.0, must be above 0 and at most 10000",
    ),
    "no interval": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], epoch_s=0, **KALMAN),
        "epoch_s is 0, must be a number above 0",
    ),
    "an interval of a third": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], epoch_s=0.33, rate_hz=50, **KALMAN),
        "an epoch must hold a whole number of samples",
    ),
    "smoothed, perhaps": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], smoothed="maybe", **KALMAN),
        "smoothed is 'maybe', must be True or False",
    ),
    "ins smoothed": (
        lambda d, _: dlkf.smooth(d["imu"], d["gnss"], model="ins"),
        "needs a filter with a covariance: mbkf15",
    ),
    "smooth's options": (
        lambda d, _: dlkf.smooth(d["imu"], d["gnss"], leverarm=(0, 0, 0)),
        "smooth has no option leverarm; did you mean lever_arm?",
    ),
    "no outage": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=0),
        "outage_s is 0, must be a number above 0",
    ),
    "an outage of letters": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s="30 s"),
        "outage_s is '30 s', must be a number above 0",
    ),
    "an outage of NaN": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=float("nan")),
        "outage_s is nan, must be a number above 0",
    ),
    "an outage of a day": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"], models="ins", outage_s=86400),
        "give a smaller outage_s, or a longer drive",
    ),
    "no filters": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=[]),
        "models is [], must be a name or a list of names",
    ),
    "filters of a number": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=5),
        "models is 5, must be a name or a list of names",
    ),
    "one of two misspelt": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models=["mbkf15", "plsu"]),
        "unknown model 'plsu'; did you mean plus?",
    ),
    "a reference of names": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], "truth.csv"),
        "reference is a str, must be a pandas DataFrame",
    ),
    "a reference without places": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"][["t", "roll"]]),
        "reference: column lat_deg, lon_deg, height_m missing",
    ),
    "a reference of another day": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], plus(86_400.0)(d["reference"]), models="mbkf15", outage_s=10),
        "without reference= the drive smoothed with its fixes is one",
    ),
    "a reference in degrees": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], times(1 / PI, "roll", "pitch", "yaw")(d["reference"])),
        "reference: yaw reaches 180.0: looks like degrees",
    ),
    "a reference of another place": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"].assign(lat_deg=d["reference"].lat_deg + 1)),
        "reference: lies 111 km from the fixes in the median; give the reference of this drive",
    ),
    "a reference of NaN": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"].assign(lat_deg=np.nan), models="ins"),
        "has no valid reference to score against; without reference= the drive smoothed",
    ),
    "a car misspelt": (
        lambda d, _: dlkf.simulate("lifelik"),
        "unknown simulated preset 'lifelik'; did you mean lifelike?",
    ),
    "a car of a number": (lambda d, _: dlkf.simulate(5), "simulated is 5, must be the name of a preset"),
    "no minutes": (lambda d, _: dlkf.simulate(minutes=0), "minutes is 0, must be a number above 0"),
    "minutes in words": (lambda d, _: dlkf.simulate(minutes="ten"), "minutes is 'ten', must be a number above 0"),
    "no drives": (lambda d, _: dlkf.simulate(drives=0), "drives is 0, must be a whole number from 1 on"),
    "half a drive": (lambda d, _: dlkf.simulate(drives=1.5), "drives is 1.5, must be a whole number"),
    "a seed below 0": (lambda d, _: dlkf.simulate(seed=-1), "seed is -1, must be a whole number from 0 on"),
    "a seed in words": (lambda d, _: dlkf.simulate(seed="a"), "seed is 'a', must be a whole number"),
    "an imu misspelt": (lambda d, _: dlkf.simulate(imu_type="automotiv_mems"), "did you mean automotive_mems?"),
    "logs of nowhere": (lambda d, here: dlkf.read_logs(here / "nowhere"), "nowhere: no such file or folder"),
    "logs of nothing": (
        lambda d, here: dlkf.read_logs(None),
        "source is a NoneType, must be the path of a file or a folder",
    ),
    "an empty folder": (lambda d, here: dlkf.read_logs(here), "holds no log that can be recognised"),
    "half a table of fixes": (
        lambda d, here: dlkf.read_logs(half_a_parquet(d, here)),
        "gnss.parquet: not a whole Parquet or Feather file",
    ),
    "an archive among the files": (
        lambda d, here: dlkf.read_logs(zipped(here)),
        "log.zip (a .zip; give it as source, or unpack it)",
    ),
    "a picture": (
        lambda d, here: dlkf.read_logs(picture(here)),
        "no IMU found in car.png (of no format that is known)",
    ),
    "a web page in the place of a log": (
        lambda d, here: dlkf.read_logs(file_of(here, "log.csv", b"<!DOCTYPE html><html><body>404</body></html>\n")),
        "no IMU found in log.csv (a web page, not the log itself; download the file behind it)",
    ),
    "raw observations": (
        lambda d, here: dlkf.read_logs(file_of(here, "base.obs", b"     3.04           OBSERVATION DATA\n" * 9)),
        "base.obs (raw GNSS observations (RINEX); RTKLIB makes a solution of them, .pos)",
    ),
    "an archive of another kind": (
        lambda d, here: dlkf.read_logs(file_of(here, "log.tar.gz", b"\x1f\x8b")),
        "log.tar.gz (an archive; unpack it and give the folder)",
    ),
    "a measurement of a CAN bus": (
        lambda d, here: dlkf.read_logs(file_of(here, "drive.mf4", b"MDF     4.10")),
        "drive.mf4 (a CAN or measurement log; export its signals as CSV)",
    ),
    "a track of GeoJSON": (
        lambda d, here: dlkf.read_logs(file_of(here, "a.geojson", b'{"type": "FeatureCollection"}')),
        "a.geojson (JSON; write it as a CSV table)",
    ),
    "a header alone": (
        lambda d, here: dlkf.read_logs(file_of(here, "imu.csv", b"t,ax,ay,az,gx,gy,gz\n")),
        "no IMU found in imu.csv (has no rows",
    ),
    "a preset for a simulated car as values": (
        lambda d, _: dlkf.simulate(imu_type={"name": "x"}),
        "imu_type is {'name': 'x'}, must be the name of a preset",
    ),
    "filters as a set": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models={"mbkf15"}),
        "models is {'mbkf15'}, must be a name or a list of names",
    ),
    "a switch for an outage": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=True),
        "outage_s is True, must be a number above 0",
    ),
    "factors as words": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], tuning={"accel_noise": "much"}, **KALMAN),
        "tuning.accel_noise is 'much', must be a number",
    ),
    "an interval of minutes": (
        lambda d, _: dlkf.navigate(d["imu"], d["gnss"], epoch_s=1000, **KALMAN),
        "epoch_s is 1000, must be above 0 and at most 60",
    ),
    "a file of weights": (
        lambda d, here: dlkf.load(file_of(here, "weights.safetensors", b"xx")),
        "weights.safetensors is a file; give the folder with weights.safetensors and config.yaml",
    ),
    "a reader misspelt": (
        lambda d, here: dlkf.read_logs(here, "atuo"),
        "unknown reader preset 'atuo'; did you mean auto?",
    ),
    "a reader's preset of another kind": (lambda d, here: dlkf.read_logs(here, "ubx"), "no file *.ubx"),
    "no model of that name": (lambda d, _: dlkf.load("mbkf99"), "unknown model 'mbkf99'"),
    "a model of a number": (lambda d, _: dlkf.load(5), "model is a int, must be a name"),
    "a folder without weights": (
        lambda d, here: dlkf.load(str(here)),
        "has no config.yaml; a model is weights.safetensors beside config.yaml",
    ),
    "a stream at no rate": (lambda d, _: dlkf.Stream("mbkf15", rate_hz=0), "rate_hz is 0, must be a number above 0"),
    "a stream's option": (
        lambda d, _: dlkf.Stream("mbkf15", historys=3),
        "Stream has no option historys; did you mean history_s?",
    ),
    "a stream's history": (
        lambda d, _: dlkf.Stream("mbkf15", history_s=-1),
        "history_s is -1, must be a finite number ≥ 0",
    ),
    "a stream that looks ahead": (
        lambda d, _: dlkf.Stream("mbkf21_rts"),
        "looks ahead, which a stream cannot; take it without _rts",
    ),
    "a stream's arm": (
        lambda d, _: dlkf.Stream("mbkf15", lever_arm=(1, 2, "x")),
        "lever_arm is (1, 2, 'x'), must be three numbers",
    ),
    "a format": (lambda d, here: solved(d).export(here, "shp"), "export=shp: unknown format; known: geojson"),
    "no format": (lambda d, here: solved(d).export(here, []), "formats is [], must be a name or a list of names"),
    "a format that is nothing": (lambda d, here: solved(d).export(here, None), "formats is None, must be a name"),
    "an export to nowhere": (lambda d, _: solved(d).export(None, "gpx"), "folder is None, must be a path"),
    "a date": (
        lambda d, here: solved(d).export(here, "gpx", start_utc="yesterday at noon"),
        "start_utc is 'yesterday at noon', must be a date and time",
    ),
    "a folder that is a file": (lambda d, here: solved(d).export(picture(here), "gpx"), "car.png cannot be written to"),
    "a model of capitals": (lambda d, _: dlkf.load("PLUS"), "unknown model 'PLUS'; did you mean plus?"),
    "no model at all": (lambda d, _: dlkf.load(""), "model= is empty; give a name such as plus, or a folder"),
    "the network of the paper": (
        lambda d, _: dlkf.load("dlkf"),
        "has no weights here, it is trained on drives of its IMU",
    ),
    "a model's folder that is not there": (
        lambda d, _: dlkf.load("outputs/none/best"),
        "outputs/none/best: no such folder",
    ),
    "a model's folder as a path": (lambda d, here: dlkf.load(here), "has no config.yaml"),
    "a loaded filter": (lambda d, _: dlkf.load(dlkf.load("ins")), "model is a Ins, must be a name such as 'plus'"),
    "two names in one": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], models="mbkf15,plus"),
        "unknown model 'mbkf15,plus'; did you mean mbkf15?",
    ),
    "outages of two lengths": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], outage_s=[30, 60]),
        "outage_s is [30, 60], must be a number above 0",
    ),
    "a reference 5 s late": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], plus(5.0)(d["reference"]), models="ins"),
        "m from the fixes in the median; give the reference of this drive, on the same clock and datum",
    ),
    "the IMU as reference": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["imu"], models="ins"),
        "reference: column lat_deg, lon_deg, height_m missing",
    ),
    "a reference in words": (
        lambda d, _: dlkf.evaluate(d["imu"], d["gnss"], d["reference"].assign(valid="yes"), models="ins"),
        "reference: valid: row 0 has 'yes', must be a number",
    ),
    "an arm of words": (lambda d, _: dlkf.Stream("ins", lever_arm="1, 0, -1.2"), "lever_arm is '1, 0, -1.2', must be"),
    "an arm by name": (lambda d, _: dlkf.Stream("ins", lever_arm={"x": 1}), "lever_arm is {'x': 1}, must be three"),
    "no tuning": (lambda d, _: dlkf.load("mbkf15", tuning=None), "tuning is None, must be the name of a preset"),
    "a factor in words": (
        lambda d, _: dlkf.load("mbkf15", tuning={"accel_noise": "high"}),
        "is 'high', must be a number",
    ),
    "a factor of NaN": (lambda d, _: dlkf.load("mbkf15", tuning={"accel_noise": np.nan}), "is nan, must be a number"),
    "a preset's file": (lambda d, _: dlkf.load("mbkf15", imu_type="consumer.yaml"), "did you mean consumer?"),
    "a thousand years": (lambda d, _: dlkf.simulate(minutes=1e9), "minutes is 1e+09, must be from 0.3 to 240 a drive"),
    "a second": (lambda d, _: dlkf.simulate(minutes=0.01), "minutes is 0.01, must be from 0.3 to 240 a drive"),
    "a seed of NaN": (lambda d, _: dlkf.simulate(seed=float("nan")), "seed is nan, must be a whole number from 0 on"),
    "two files": (lambda d, _: dlkf.read_logs(["a.csv", "b.csv"]), "source is a list, must be the path of a file"),
    "an empty path": (lambda d, _: dlkf.read_logs(""), "source is '', must be a file or a folder of this machine"),
    "a page": (lambda d, _: dlkf.read_logs("https://example.com/a.csv"), "must be a file or a folder of this machine"),
    "a dataset as logs": (lambda d, here: dlkf.read_logs(dataset(here)), "is a dataset already: pandas.read_parquet"),
    "a preset's file as reader": (lambda d, here: dlkf.read_logs(here, "my.yaml"), "unknown reader preset 'my.yaml'"),
    "a setting that is none": (
        lambda d, here: dlkf.read_logs(here, "auto", "imu.accel"),
        "'imu.accel' is no setting of a reader; one is text such as 'reader.imu.accel.unit=g'",
    ),
    "a setting misspelt": (
        lambda d, here: dlkf.read_logs(here, "csv", "reader.imu.acel.unit=g"),
        "reader.imu: unknown key acel; did you mean accel? known are",
    ),
    "perhaps without the unsure": (
        lambda d, here: dlkf.read_logs(here, skip_unsure="maybe"),
        "skip_unsure is 'maybe', must be True or False",
    ),
    "a history in words": (
        lambda d, _: dlkf.Stream("ins", history_s="10"),
        "history_s is '10', must be a finite number",
    ),
    "a step back in a stream": (lambda d, _: dlkf.Stream("ins", imu_step_s=-1), "imu_step_s is -1, must be a finite"),
    "a phase of NaN": (
        lambda d, _: dlkf.Stream("ins", phase_s=float("nan")),
        "phase_s is nan, must be a finite number",
    ),
    "an anchor in words": (
        lambda d, _: dlkf.Stream("ins", anchor_m="far"),
        "anchor_m is 'far', must be a finite number",
    ),
    "an alignment in words": (
        lambda d, _: dlkf.Stream("ins", align="coarse"),
        "align is 'coarse', must be a dlkf.data",
    ),
    "limits of a number": (
        lambda d, _: dlkf.Stream("ins", limits=5),
        "limits is 5, must be a dlkf.data.validate.Limits",
    ),
}


def dataset(here: Path) -> Path:
    """A folder with the table of a dataset's drives."""
    (here / "drives.parquet").touch()
    return here


def file_of(here: Path, name: str, content: bytes) -> Path:
    """A file that is no log."""
    (here / name).write_bytes(content)
    return here / name


def picture(here: Path) -> Path:
    """A file that is no log."""
    file = here / "car.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    return file


def half_a_parquet(frames: Frames, here: Path) -> Path:
    """A folder of a drive whose fixes were not copied whole."""
    for kind in ("imu", "gnss"):
        frames[kind].to_parquet(here / f"{kind}.parquet")
    (here / "gnss.parquet").write_bytes((here / "gnss.parquet").read_bytes()[:500])
    return here


def zipped(here: Path) -> Path:
    """A folder that holds an archive alone, cut short."""
    (here / "log.zip").write_bytes(b"PK\3\4" + bytes(range(256)))
    return here


def solved(frames: Frames) -> dlkf.Solution:
    """A solution, by the fastest filter."""
    return dlkf.navigate(frames["imu"], frames["gnss"], model="ins", rate_hz=10)


@pytest.mark.parametrize("case", CALLS)
def test_a_call(case: str, frames: Frames, tmp_path: Path) -> None:
    act, said = CALLS[case]
    with pytest.raises(dlkf.InputError) as error:
        act(frames, tmp_path)
    check(str(error.value), said)
