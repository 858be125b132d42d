"""``dlkf.ingest`` as from a shell: what it tells, and one line for each mistake."""

from __future__ import annotations

from datetime import UTC, datetime

import gpxpy
import numpy as np
import pandas as pd
import pytest

from dlkf.data.intake import IngestResult
from dlkf.ingest import _tell
from tests.cars import car
from tests.data.logs import nmea
from tests.data.logs.arrays import STDS
from tests.data.logs.clock import UNIX
from tests.data.logs.receivers import ubx_fixes


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two drives as CSV files, one in NMEA."""
    folder = tmp_path_factory.mktemp("logs")
    tables = car(30)
    for name in ("monday", "tuesday"):
        (folder / "csv" / name).mkdir(parents=True)
        for kind in ("imu", "gnss"):
            tables[kind].to_csv(folder / "csv" / name / f"{kind}.csv", index=False)
    (folder / "nmea").mkdir()
    nmea(folder / "nmea", tables)
    (folder / "bench").mkdir()
    rest = np.random.default_rng(1).normal(0, 0.01, (3000, 7)) + [0, 0, 0, 0, 0, 0, -9.8]
    names = ["t", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    pd.DataFrame(rest, columns=names).assign(t=np.arange(3000) / 100).to_csv(folder / "bench" / "imu.csv", index=False)
    return folder


def test_a_line_for_each_drive(call, logs):
    done = call("ingest", "reader=csv", f"source={logs}/csv", "out=town", *STDS)
    assert done.code == 0, done.err
    for expected in ("monday: 30.0 s, ", " km, IMU 100 Hz, largest gap 10 ms", "GNSS 1 Hz, 31 fixes (RTK fixed 100 %)"):
        assert expected in done.out
    assert "town: 2 drives" in done.out


def test_notes_stand_below_the_line_of_their_drive(capsys):
    _tell(IngestResult([], ["monday: 30.0 s", "tuesday: 20.0 s"], ("found the unit",), {}), 4)
    assert capsys.readouterr().out.split("\n")[:3] == [
        "    3  monday: 30.0 s", "    4  tuesday: 20.0 s", "       found the unit",
    ]  # fmt: skip


def test_nmea_beside_an_imu_in_milliseconds(call, logs):
    done = call("ingest", "reader=nmea", f"source={logs}/nmea", "out=town", "reader.imu.time.unit=ms")
    assert done.code == 0, done.err


def test_a_log_at_rest_needs_no_gnss(call, logs):
    """The logs that dlkf.allan reads."""
    done = call("ingest", "reader=csv", f"source={logs}/bench", "out=bench", "reader.gnss.file=null")
    assert done.code == 0, done.err
    assert "no GNSS" in done.out
    done = call("navigate", "model=ins", "imu=consumer", "dataset=bench", "out=solved")
    assert done.code == 2 and "no GNSS" in done.err


def test_dates_are_the_receivers_where_the_imu_counts_from_nothing(call, tmp_path):
    """UBX beside an IMU that lay on its side, its clock 12.3 s at the receiver's zero: exports bear GPS's own dates.

    The car's path is smooth, so the offset is found to 3 ms (:func:`tests.data.test_discovery.test_any_clock_offset`).
    """
    (tmp_path / "logs").mkdir()
    tables = car(150)
    ubx_fixes(tmp_path / "logs" / "town.ubx", tables)
    imu = tables["imu"]
    own = {"ms": np.round(1000 * (imu.t + 12.3)).astype(int)}
    for s in ("accel", "gyro"):
        own |= {f"{s}_x": imu[f"{s}_y"], f"{s}_y": -imu[f"{s}_x"], f"{s}_z": imu[f"{s}_z"]}
    pd.DataFrame(own).to_csv(tmp_path / "logs" / "box.csv", index=False)
    done = call("ingest", "reader=auto", "source=logs", "out=found")
    assert done.code == 0, done.err
    done = call("navigate", "model=mbkf15", "dataset=found", "imu=consumer", "export=[gpx,nmea,pos,kml]", "out=solved")
    assert done.code == 0, done.err
    folder = tmp_path / "solved" / "drive=logs"
    t = pd.read_parquet(folder / "solution.parquet", columns=["t"])["t"].to_numpy()
    points = gpxpy.parse((folder / "solution.gpx").read_text()).tracks[0].segments[0].points
    seconds = np.array([p.time.timestamp() for p in points])
    np.testing.assert_allclose(seconds - UNIX, t + 12 - 12.3, atol=3e-3)
    day = datetime.fromtimestamp(UNIX, UTC)
    assert f",{day:%d%m%y}," in (folder / "solution.nmea").read_text()
    week, tow = (folder / "solution.pos").read_text().splitlines()[3].split()[:2]
    assert int(week) * 604_800 + float(tow) == pytest.approx(seconds[0] - 315_964_800 + 18, abs=1e-3)
    assert f"<when>{day:%Y-%m-%d}T" in (folder / "solution.kml").read_text()


def test_a_map_from_the_command_line(call, logs):
    """A mapping of texts that no preset has."""
    done = call("ingest", f"source={logs}/csv", "out=town", "reader.gnss.quality={column: quality, map: {four: 4}}")
    assert done.code == 2 and "quality '4' is not in reader.gnss.quality.map" in done.err


MISTAKES = {
    "unknown key": (["reader.imu.acel.unit=g"], "reader.imu: unknown key acel"),
    "unknown setting": (["reader.colour=red"], "takes no colour"),
    "module": (["reader._target_=mine.Reader"], "reader._target_=mine.Reader: No module named"),
    "lever arm": (["reader.lever_arm_m=0.5"], "reader.lever_arm_m is 0.5, must be a list of numbers"),
    "format": (["reader.gnss.format=gpx"], "reader.gnss.format=gpx: unknown"),
    "not a UBX log": (["reader.gnss.format=ubx"], "has no NAV-PVT message"),
    "axes": (["reader.imu.accel.axes=frx"], "axes 'frx' must be three letters"),
    "too short for auto": (["reader=auto", "reader.sure.angle_deg=0.1"], "not sure of reader."),
    "preset": (["reader=tape"], "reader/tape"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(call, logs, tmp_path, case):
    given, expected = MISTAKES[case]
    done = call("ingest", f"source={logs}/csv", "out=town", *given)
    assert done.code == 2 and expected in done.err, done.err
    assert done.err.count("\n") == 1
    assert not [p.name for p in tmp_path.iterdir() if "town" in p.name]  # whole or none
