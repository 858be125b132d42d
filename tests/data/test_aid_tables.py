"""Tables of wheel speed, heading and barometer: read as written, left out on request, refused in one clear line."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.aid_tables import STANDARD
from dlkf.data.schema import AIDS, drive_file, write_drive, write_drives_table
from dlkf.data.tables import read_drives, read_table
from dlkf.data.validate import read_drive, validate_dataset


@pytest.fixture(scope="module")
def aids(tables):
    """The exact car's wheel at 20 Hz, 2 % fast and 0.15 s late, its heading and a barometer at 5 Hz."""
    truth = tables["reference"]
    t = np.arange(1.0, 59.5, 0.05)
    at = t - 0.15
    speed = np.hypot(*(np.interp(at, truth["t"], truth[c]) for c in ("vel_n", "vel_e")))
    slow = np.arange(0.5, 59.5, 0.2)
    heading = np.interp(slow, truth["t"], np.unwrap(truth["yaw"]))
    return {
        "speed": pd.DataFrame({"t": t, "speed": 1.02 * speed, "std": 0.1}),
        "heading": pd.DataFrame({"t": slow, "heading": heading}),
        "baro": pd.DataFrame({"t": slow, "pressure": np.full(len(slow), 9.8e4)}),
    }


def _write(folder, tables, aids):
    row = write_drive(folder, {"drive": "a"}, tables["imu"], tables["gnss"], aids=aids)
    write_drives_table(folder, [row])


def test_tables_come_back_as_written_and_only_those_that_are_asked_for(tmp_path, tables, aids):
    _write(tmp_path, tables, aids)
    row = read_drives(tmp_path)[0]
    for name in AIDS:
        back = read_table(tmp_path, name, "a")
        assert all(np.array_equal(back[c], aids[name][c].to_numpy()) for c in aids[name])
    assert set(read_drive(tmp_path, row).aids) == set(AIDS)
    assert set(read_drive(tmp_path, row, aids=[STANDARD["heading"]]).aids) == {"heading"}
    drive_file(tmp_path, "speed", "a").write_bytes(b"broken")
    assert read_drive(tmp_path, row, aids=[]).aids == {}
    with pytest.raises(InputError, match="not a whole Parquet file"):
        validate_dataset(tmp_path)


def test_a_drive_without_them_has_none(town):
    assert read_drive(town, read_drives(town)[0]).aids == {}


def _speed(change):
    return lambda aids: {**aids, "speed": aids["speed"].assign(speed=change(aids["speed"]["speed"].to_numpy().copy()))}


def _late(seconds):
    return lambda aids: {**aids, "speed": aids["speed"].assign(t=aids["speed"]["t"] + seconds)}


def _heading(change):
    return lambda aids: {**aids, "heading": aids["heading"].assign(heading=change(aids["heading"]["heading"]))}


def _rows(name, pick):
    return lambda aids: {**aids, name: pick(aids[name]).reset_index(drop=True)}


BAD = {
    "km/h": (_speed(lambda v: 3.6 * v), r"3.67 times that of GNSS.*divide it by 3.6 \(reader.speed.value.unit=km/h\)"),
    "mph": (_speed(lambda v: 2.237 * v), "looks like mph"),
    "carried, in km/h": (_speed(lambda v: np.where(np.arange(len(v)) < 700, 0.0, 3.6 * v)), "looks like km/h"),
    "doubled": (_speed(lambda v: 2 * v), "2.04 times that of GNSS"),
    "dead": (_speed(lambda v: 0 * v), "stays 0 m/s though the car moves"),
    "stuck": (_speed(lambda v: 0 * v + 7), "stays 7 m/s though the car moves"),
    "backwards": (_speed(lambda v: -v), "negative where the car drives forward; negate it"),
    "unknown": (_speed(lambda v: np.nan * v), "speed is NaN in every row.*aids="),
    "infinite": (_speed(lambda v: np.where(np.arange(len(v)) == 7, np.inf, v)), "row 7: speed is inf"),
    "ahead": (_late(1.5), r"1.6\d? s ahead of that of GNSS; subtract 1.6\d? s from its t"),
    "behind": (_late(-2.15), r"2.0\d? s behind that of GNSS; add 2.0\d? s"),
    "elsewhere": (_late(1e6), "outside the IMU's"),
    "milliseconds": (_rows("speed", lambda f: f.assign(t=1e-3 * f["t"])), "t is not in seconds"),
    "backwards in time": (_rows("speed", lambda f: f.iloc[::-1]), "row 1: t goes back"),
    "no rows": (_rows("speed", lambda f: f.iloc[:0]), "has no rows; remove the table"),
    "negative std": (_rows("speed", lambda f: f.assign(std=-1.0)), "row 0: std is -1.0"),
    "degrees": (_heading(np.degrees), "looks like degrees"),
    "infinite std": (_rows("speed", lambda f: f.assign(std=np.inf)), "row 0: std is inf; must be finite"),
    "from East": (_heading(lambda x: np.pi / 2 - x), "counts from East; use π/2 − heading"),
    "anticlockwise": (_heading(lambda x: -x), "counts anticlockwise; negate it"),
    "across": (_heading(lambda x: x + np.pi / 2), r"\+90° off the course"),
    "hPa": (_rows("baro", lambda f: f.assign(pressure=f["pressure"] / 100)), "must be in Pa: looks like hPa"),
    "neither": (
        _rows("baro", lambda f: f[["t"]]),
        "neither of pressure, height_m; one of them is needed, it has t",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_unusable_is_one_line(tmp_path, tables, aids, case):
    change, expected = BAD[case]
    _write(tmp_path, tables, change(aids))
    with pytest.raises(InputError, match=expected) as error:
        validate_dataset(tmp_path)
    assert "\n" not in str(error.value) and str(error.value).startswith("drive a, ")


GOOD = {
    "gap": _rows("speed", lambda f: f[(f["t"] < 20) | (f["t"] > 50)]),
    "slip": _speed(lambda v: np.where(np.arange(len(v)) % 200 < 40, 1.3 * v, v)),
    "whole km/h": _speed(lambda v: np.round(3.6 * v) / 3.6),
    "half a second late": _late(0.35),
    "NaN now and then": _speed(lambda v: np.where(np.arange(len(v)) % 3 == 0, np.nan, v)),
    "no std": _rows("speed", lambda f: f[["t", "speed"]]),
    "carried for most of the way": _speed(lambda v: np.where(np.arange(len(v)) % 1170 < 700, 0.0, v)),
    "one row a second": _rows("speed", lambda f: f.iloc[::20]),
}


@pytest.mark.parametrize("case", GOOD)
def test_what_a_filter_can_bear_passes(tmp_path, tables, aids, case):
    _write(tmp_path, tables, GOOD[case](aids))
    validate_dataset(tmp_path)
