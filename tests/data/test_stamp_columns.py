"""Which columns of a table are its stamps, and rows that repeat those of the row before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.readers.auto import AutoReader
from dlkf.data.schema import ACCEL, GYRO
from tests.data.logs.clock import DEG, UNIX
from tests.data.test_csv import log_reader
from tests.data.test_foreign_tables import ENGLISH, Tables, beside, box, fixes, read


def test_fixes_written_several_times_with_their_own_stamp(tmp_path: Path, drive: Tables) -> None:
    """Three or four rows of each; no fix is lost where the car stands."""
    gnss = drive["gnss"].copy()
    gnss.loc[40:50, ["lat_deg", "lon_deg", "height_m"]] = gnss.loc[40, ["lat_deg", "lon_deg", "height_m"]].to_numpy()
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    table = fixes(gnss, ENGLISH, timestamps=UNIX + gnss.t)
    again = table.loc[np.repeat(table.index, 3 + table.index % 2)]
    again.to_csv(tmp_path / "b.csv", index=False)
    got, notes = read(tmp_path, {**drive, "gnss": gnss})
    assert f"took {len(gnss)} of {len(again)} rows for fixes: the others repeat the stamp and position before" in notes
    assert got.mapping["gnss"]["rows"] == "once"


def test_the_stamps_that_settings_name_count(tmp_path: Path, drive: Tables) -> None:
    """Of two columns that rise, under any name; without the settings the table is refused."""
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    t = drive["gnss"].t
    fixes(drive["gnss"], ENGLISH, beat=t, drum=3 * t).to_csv(tmp_path / "b.csv", index=False)
    with pytest.raises(InputError, match="lacks stamps that can be read"):
        list(AutoReader().read(tmp_path))
    for named in ({"column": "beat"}, {"column": "beat", "unit": "s"}):
        (got,) = AutoReader(gnss={"time": named}).read(tmp_path)
        np.testing.assert_allclose(got.gnss.t, t, atol=0.012)


def test_repeated_rows_of_any_reader(tmp_path: Path, drive: Tables) -> None:
    for kind in ("imu", "gnss"):
        drive[kind].loc[np.repeat(drive[kind].index, 2)].to_csv(tmp_path / f"{kind}.csv", index=False)
    (got,) = log_reader(imu__rows="once", gnss__rows="once").read(tmp_path)
    for kind, table in (("imu", got.imu), ("gnss", got.gnss)):
        pd.testing.assert_frame_equal(table[["t"]], drive[kind][["t"]], check_exact=False, rtol=0, atol=1e-6)


def in_two(t: pd.Series, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Whole seconds and the ticks beside them."""
    return np.divmod(np.round((UNIX + t) * ticks).astype(np.int64), ticks)


PARTS = {
    ("seconds", "nanoseconds"): 10**9,
    ("header.stamp.secs", "header.stamp.nsecs"): 10**9,
    ("time_sec", "time_usec"): 10**6,
    ("Zeit (s)", "Zeit (ms)"): 1000,
}


@pytest.mark.parametrize("names", PARTS)
def test_seconds_and_the_rest_of_them_in_two_columns(names: tuple[str, str], tmp_path: Path, drive: Tables) -> None:
    """As exports of ROS have them, also where the sensors are known by their numbers alone behind a count of rows."""
    imu, gnss = drive["imu"], drive["gnss"]
    parts = {kind: dict(zip(names, in_two(drive[kind].t, PARTS[names]))) for kind in ("imu", "gnss")}
    table = pd.DataFrame({"Header": np.arange(len(imu)), **parts["imu"], **{f"q.{x}": 0.5 for x in "xyzw"}})
    for name, columns in (("Linear", ACCEL), ("Angular", GYRO)):
        table[[f"{name}.{axis}" for axis in "xyz"]] = imu[list(columns)]
    table.to_csv(tmp_path / "a.csv", index=False)
    fixes(gnss, ENGLISH, **parts["gnss"]).to_csv(tmp_path / "b.csv", index=False)
    got, notes = read(tmp_path, drive)
    np.testing.assert_allclose(got.gnss.t, gnss.t, atol=0.012)
    assert f"({', '.join(names)}): taken as Unix time" in notes
    time = {"column": list(names), "offset_s": 0.0}
    (again,) = AutoReader(imu={"time": time}, gnss={"time": time}).read(tmp_path)
    np.testing.assert_allclose(again.imu.t, got.imu.t, atol=1e-6)


FAULTY_PARTS = {
    "no unit": (
        ["whole", "rest"],
        None,
        r"time\.unit is s, must be ms, us or ns: of 'rest', beside the seconds in 'whole'",
    ),
    "another unit": (["whole", "rest"], "us", r"line 2: column 'rest' is \d+, must be below 1000000 \(us beside"),
    "exchanged": (["part", "rest"], "ns", "line 2: column 'part' is 0.01, must be whole seconds beside 'rest'"),
}


@pytest.mark.parametrize("case", [None, *FAULTY_PARTS])
def test_seconds_and_the_rest_that_settings_name(case: str | None, tmp_path: Path, drive: Tables) -> None:
    whole, rest = in_two(drive["imu"].t, 10**9)
    imu = drive["imu"].assign(whole=whole, rest=rest, part=drive["imu"].t)
    imu.to_csv(tmp_path / "imu.csv", index=False)
    drive["gnss"].assign(t=UNIX + drive["gnss"].t).to_csv(tmp_path / "gnss.csv", index=False)
    column, unit, said = FAULTY_PARTS[case] if case else (["whole", "rest"], "ns", "")
    reader = log_reader(imu__time={"column": column, "unit": unit})
    if case:
        with pytest.raises(InputError, match=said):
            list(reader.read(tmp_path))
        return
    (got,) = reader.read(tmp_path)
    np.testing.assert_allclose(got.imu.t, drive["imu"].t, atol=1e-6)


def test_the_stamps_of_fixes_beside_samples_in_local_time(tmp_path: Path, streets: Tables) -> None:
    """SensorLog without a zone in its texts: fixes have their own times, also where they repeat a position, and the
    samples' dates are brought to theirs, as is a pressure beside them."""
    imu, gnss = streets["imu"], streets["gnss"].copy()
    gnss.loc[20:23, ["lat_deg", "lon_deg", "height_m"]] = gnss.loc[20, ["lat_deg", "lon_deg", "height_m"]].to_numpy()
    names = ";".join(f"location{x}" for x in ("Latitude(WGS84)", "Longitude(WGS84)", "Altitude(m)"))
    stamps = {"t": gnss.t, "locationTimestamp_since1970(s)": (UNIX + gnss.t).round(6)}
    place = fixes(gnss, f"{names};locationSpeed(km/h);locationCourse(°)", **stamps)
    when = pd.to_datetime(UNIX - 5 * 3600 + imu.t, unit="s").dt.strftime("%Y-%m-%d %H:%M:%S.%f").str[:-3]
    samples = box(imu, "accelerometerAcceleration{}(G)", "gyroRotation{}(rad/s)", **{"loggingTime(txt)": when})
    samples.iloc[:, 4:] *= DEG
    samples["pressure(kPa)"] = 95.0
    pd.concat((samples, beside(imu, place)), axis=1).to_csv(tmp_path / "phone.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    notes = "\n".join(got.notes)
    assert "-5 h from UTC by the fixes' stamps, so they are local time" in notes
    assert "the others repeat the stamp and position before" in notes and len(got.gnss) in (len(gnss), len(gnss) - 1)
    assert got.mapping["gnss"]["time"]["column"] == "locationTimestamp_since1970(s)"
    assert abs(got.gnss.t.iloc[30] - got.gnss.t.iloc[0] - 30 * np.median(np.diff(gnss.t))) < 1e-3
    assert abs(got.mapping["gnss"]["time"]["offset_s"]) < 0.1 and got.imu.t.iloc[0] < 1.0
    assert abs(got.aids["baro"].t.iloc[0] - got.imu.t.iloc[0]) < 1e-6
