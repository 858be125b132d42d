"""Columns under the names that people give them: six languages, qualities in numbers, accuracies, dates, no names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.intake import ingest_drives
from dlkf.data.readers import units
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.mapping import Mapped
from dlkf.data.readers.qualities import quality_spec
from dlkf.data.readers.recognise import gnss_spec, imu_spec
from dlkf.data.readers.stamps import choose_clock, epoch_note
from dlkf.data.readers.units import day_order
from dlkf.data.readers.vocabulary import (
    DATE,
    QUANTITIES,
    SENSORS,
    TIME,
    find_column,
    find_triads,
    match_columns,
    split_unit,
    triad,
)
from dlkf.data.schema import ACCEL, GYRO
from dlkf.data.tables import DriveClock, read_drives
from dlkf.running.exports import utc_times
from tests.data.logs.clock import GPS, UNIX
from tests.data.logs.clock import G as GRAVITY
from tests.data.test_validate import hilly

DEG = np.pi / 180
# stamps, accelerometers, gyroscopes; stamps, latitude, longitude, height, speed [km/h], course, accuracy, quality
HEADERS = {
    "English": ("Timestamp (ms)", "Acceleration {} (g)", "Gyroscope {} (deg/s)")
    + ("time_ms", "Latitude", "Longitude", "Altitude (m)", "Speed (km/h)", "Heading", "hacc", "fixtype"),
    "German": ("Zeit_ms", "Beschleunigung {}-Achse [g]", "Drehrate {}-Achse [°/s]")
    + (
        "Zeitstempel [ms]",
        "Breite",
        "Länge",
        "Höhe [m]",
        "Geschwindigkeit [km/h]",
        "Kurs",
        "Genauigkeit [m]",
        "Qualität",
    ),
    "French": ("Temps (ms)", "Accélération {} (g)", "Vitesse angulaire {} (deg/s)")
    + ("Horodatage (ms)", "Latitude", "Longitude", "Hauteur (m)", "Vitesse (km/h)", "Cap", "Précision (m)", "Qualité"),
    "Spanish": ("Tiempo (ms)", "Aceleración {} (g)", "Velocidad angular {} (deg/s)")
    + ("Tiempo (ms)", "Latitud", "Longitud", "Altitud (m)", "Velocidad (km/h)", "Rumbo", "Precisión (m)", "Calidad"),
    "Chinese": ("时间戳(ms)", "加速度{}轴(g)", "角速度{}轴(deg/s)")
    + ("时间(ms)", "纬度", "经度", "高度(m)", "速度(km/h)", "航向角", "水平精度(m)", "定位质量"),
    "Japanese": ("時刻(ms)", "加速度{}(g)", "ジャイロ{}(deg/s)")
    + ("時刻(ms)", "緯度", "経度", "標高(m)", "速度(km/h)", "方位", "水平精度(m)", "測位品質"),
    "nothing": ("c0", "c1{}", "c2{}", *(f"d{k}" for k in range(8))),
    "first letters": ("Zeit_ms", "B{}", "D{}", "Zeit_ms", "Br", "La", "Ho", "Ge", "Ku", "Gen", "Qu"),
}


def write(folder: Path, tables, names, **text) -> None:
    """Two files with these names; g, °/s, ms, km/h and degrees."""
    t, accel, gyro, fix, *rest = names
    imu, gnss = tables["imu"], tables["gnss"]
    axes = "XYZ" if "{}" in accel else ""
    out = {t: np.round(1000 * imu.t).astype(int)}
    out |= {accel.format(a): imu[c] / GRAVITY for a, c in zip(axes, ACCEL)}
    out |= {gyro.format(a): imu[c] / DEG for a, c in zip(axes, GYRO)}
    folder.mkdir(parents=True)
    pd.DataFrame(out).to_csv(folder / "box.csv", index=False, **text)
    course = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    values = (gnss.lat_deg, gnss.lon_deg, gnss.height_m, 3.6 * np.hypot(gnss.vel_n, gnss.vel_e), course, 0.012, 4)
    ticks = np.round(1000 * (UNIX + gnss.t)).astype("int64")
    pd.DataFrame({fix: ticks, **dict(zip(rest, values))}).to_csv(folder / "fixes.csv", index=False, **text)


IN_DAILY_USE = "English", "nothing"  # the others: make test


def test_of_several_columns_of_numbers_the_last_is_the_stamp():
    """As the rows are read; the line on what they count is of it too."""
    table = LogTable(pd.DataFrame({"day": ["2025-07-05"] * 2, "stamp": [UNIX, UNIX + 1]}), Path("fixes.csv"))
    mapped = Mapped(table, {"format": "csv", "time": {"column": ["day", "stamp"]}}, "gnss")
    assert mapped.own_stamps()[0].tolist() == [int(UNIX), int(UNIX) + 1]
    assert "(day, stamp): taken as Unix time (since 1970), of 2025-" in str(epoch_note(mapped))


@pytest.mark.parametrize(
    "language", [pytest.param(x, marks=[pytest.mark.whole] * (x not in IN_DAILY_USE)) for x in HEADERS]
)
def test_headers(language, tmp_path, drive):
    """Positions, velocities in km/h, accuracy and quality; where nothing is named the two that numbers cannot tell are
    said to be unused."""
    german = {"sep": ";", "decimal": ","} if language in ("German", "first letters") else {}
    names = HEADERS[language]
    write(tmp_path / "a", drive, names, **german)
    (got,) = AutoReader().read(tmp_path / "a")
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], drive["imu"][name], atol=0.02, err_msg=name)
    for name in ("vel_n", "vel_e"):
        np.testing.assert_allclose(got.gnss[name], drive["gnss"][name], atol=1e-6, err_msg=name)
    notes = "\n".join(got.notes)
    assert "taken as Unix time (since 1970), of 2025-" in notes
    if language in ("nothing", "first letters"):
        assert f"columns of fixes.csv that are not used: {names[-2]}, {names[-1]}" in notes
        assert f"took {names[4]}, {names[5]}, {names[6]} for latitude, longitude, height" in notes
    else:
        assert "not used" not in notes
        np.testing.assert_allclose(got.gnss.std_pos_n, 0.012)
        assert set(got.gnss.quality) == {4}


def test_every_column_that_is_not_used_is_named(tmp_path, drive):
    write(tmp_path / "a", drive, HEADERS["English"])
    table = pd.read_csv(tmp_path / "a" / "fixes.csv").assign(numSV=12, pdop=1.1, note="x")
    table.to_csv(tmp_path / "a" / "fixes.csv", index=False)
    (got,) = AutoReader().read(tmp_path / "a")
    assert "columns of fixes.csv that are not used: numSV, pdop, note" in got.notes


@pytest.mark.parametrize(
    ("name", "values", "accuracy", "codes"),
    [
        ("fixtype", [4], 0.01, {4: 4}),  # RTK fixed
        ("fixtype", [4], 2.0, {4: 1}),  # u-blox: GNSS and dead reckoning
        ("fix_type", [0, 3], np.nan, {0: 0, 3: 1}),
        ("fix_type", [3, 4, 5, 6], np.nan, {3: 1, 4: 2, 5: 5, 6: 4}),  # MAVLink
        ("gpsFix", [0, 1], np.nan, {0: 0, 1: 1}),
        ("Q", [1, 2, 5], 0.02, {1: 4, 2: 5, 5: 1}),  # RTKLIB
        ("quality", [1, 2, 4, 5], np.nan, {1: 1, 2: 2, 4: 4, 5: 5}),
        ("quality", [4, 5, 9], np.nan, {4: 4, 5: 5, 9: 9}),  # SBAS
        ("quality", [3, 9], np.nan, {3: 3, 9: 9}),  # no receiver but NMEA's has 9, so 3 is PPS
        ("carrSoln", [0, 1, 2], np.nan, {0: 1, 1: 5, 2: 4}),
        ("status", [-1, 0, 2], np.nan, {-1: 0, 0: 1, 2: 2}),  # ROS
    ],
)
def test_qualities_in_numbers(name, values, accuracy, codes):
    frame = pd.DataFrame({name: values * 5})
    spec, notes = quality_spec(frame, name, accuracy)
    assert {v: spec.get("map", {}).get(str(v), v) for v in values} == codes
    assert len(notes) == 1 and "taken as" in notes[0]


def test_two_readings_of_a_quality_are_both_said():
    spec, (note,) = quality_spec(pd.DataFrame({"fixtype": [4, 4]}), "fixtype", np.nan)
    assert spec == {"column": "fixtype"}
    assert "4 is RTK fixed, taken as NMEA's GGA code; as u-blox's fix type" in note
    assert "reader.gnss.quality.map='{4: 1}'" in note
    spec, notes = quality_spec(pd.DataFrame({"quality": [4, 4]}), "quality", 20.0)
    assert "accuracies of 20 m in the median are none of RTK; if they are mm: reader.gnss.std_position.unit=mm" in notes
    for empty in ([np.nan] * 3, ["", " ", ""]):
        assert quality_spec(pd.DataFrame({"fix": empty}), "fix", np.nan)[1] == [
            "quality fix is empty: all count as single"
        ]
    spec, (note,) = quality_spec(pd.DataFrame({"fix": ["rather good"]}), "fix", np.nan)
    assert spec is None and "rather good" in note


def fixes(**columns) -> LogTable:
    base = {"t": 1.751e9 + np.arange(9.0), "lat": 50.0, "lon": 8.0, "alt": 100.0}
    return LogTable(pd.DataFrame({**base, **columns}), Path("a.csv"))


def test_accuracies_and_dilutions():
    found = gnss_spec(fixes(hAcc=12.0, vAcc=20.0, sAcc=0.1, hdop=0.7)).spec
    assert found["std_position"] == {"columns": ["hAcc", "vAcc"]} and found["std_velocity"] == {"columns": ["sAcc"]}
    found = gnss_spec(fixes(**{"h_acc [mm]": 12.0})).spec
    assert found["std_position"] == {"columns": ["h_acc [mm]"], "unit": "mm"}
    found = gnss_spec(fixes(hAcc=1200.0)).spec
    assert found["std_position"]["unit"] == "mm"
    found, notes, _ = gnss_spec(fixes(hdop=0.7, quality=2))
    assert found["std_position"] == {"columns": ["hdop", "hdop"], "unit": 1.0}
    assert any("1 m times hdop" in note for note in notes)
    assert gnss_spec(fixes(hdop=0.7, fix="RTK fixed")).spec["std_position"]["unit"] == 0.02  # a quality in words
    found = gnss_spec(fixes(sdn=0.1, sde=0.1, sdu=0.2, **{"alt_ft": 3.0})).spec
    assert found["std_position"]["columns"] == ["sdn", "sde", "sdu"]


@pytest.mark.parametrize(
    ("day", "time", "order"),
    [
        ("2025-07-05", "%H:%M:%S.%f", None),
        ("05.07.2025", "%H:%M:%S,%f", None),
        ("07/05/2025", "%I:%M:%S.%f %p", "mdy"),
        ("05/07/2025", "%H:%M:%S.%f", "dmy"),
        ("20250705", "%H:%M:%S.%f", None),
        ("2025年7月5日", "%H:%M:%S.%f", None),
    ],
)
def test_date_and_time_in_two_columns(day, time, order):
    """All of them 5 July 2025, 16:00 and on."""
    start = np.datetime64("2025-07-05T16:00:00", "ns")
    when = pd.Series(start + (np.arange(9) * 200).astype("timedelta64[ms]"))
    table = fixes(Datum=day, Uhrzeit=when.dt.strftime(time))
    spec = gnss_spec(LogTable(table.frame.drop(columns="t"), table.path)).spec["time"]
    assert spec["column"] == ["Datum", "Uhrzeit"] and spec["unit"] == "iso" and spec.get("order") == order
    texts = table.frame.Datum.str.cat(table.frame.Uhrzeit, sep=" ").to_numpy()
    whole, part = units.seconds(texts, "iso", None, "utc", "x", None, order)
    want = start.astype(int) / 1e9 - units.GPS_EPOCH_UNIX + 18 + 0.2 * np.arange(9)
    np.testing.assert_allclose(whole + part, want, atol=1e-6)


def test_the_order_of_day_and_month():
    assert day_order(pd.Series(["05/07/2025", "13/07/2025"])) == "dmy"
    assert day_order(pd.Series(["05/07/2025", "05/17/2025"])) == "mdy"
    assert day_order(pd.Series(["2025-07-05"])) is None and day_order(pd.Series(["5/7/2025"])) == ""
    with pytest.raises(InputError, match=r"may have day or month first; set reader\.gnss\.time\.order=dmy or mdy"):
        units.seconds(np.array(["05/07/2025 16:00"]), "iso", None, "utc", "a.csv, reader.gnss.time")


def test_gps_seconds_since_1980_are_no_unix_time(tmp_path, drive):
    """Dates were ten years off; both readings are said, and the export has the right one."""
    folder = tmp_path / "a"
    write(folder, drive, HEADERS["English"])
    table = pd.read_csv(folder / "fixes.csv")
    table["time_ms"] = np.round(1000 * (GPS + drive["gnss"].t)).astype("int64")
    table.to_csv(folder / "fixes.csv", index=False)
    (got,) = AutoReader().read(folder)
    (note,) = (n for n in got.notes if n.startswith("stamps of fixes.csv"))
    assert "GPS seconds since 1980, of 2025-" in note
    assert "as Unix time (since 1970) they would be of 2015-" in note and "reader.gnss.time.clock=unix" in note
    ingest_drives([got], tmp_path / "out")
    (row,) = read_drives(tmp_path / "out")
    clock = DriveClock(got.meta["time_zero_s"], got.meta["gps_zero_s"], got.meta["gps_rate"])
    (first, *_) = utc_times(got.gnss, clock)
    assert abs(first.timestamp() - UNIX) < 1.0 and row.name == "a"


@pytest.mark.parametrize(
    ("name", "seconds", "clock"),
    [
        ("t", 1.436e9, "gps"),
        ("unix_time", 1.436e9, "unix"),
        ("gps_time", 1.436e9, "gps"),
        ("t", 1.75e9, "unix"),
        ("gps_time", 1.75e9, "unix"),  # GPS seconds of 2035 are no log's
        ("t", 400_000.0, None),
    ],
)
def test_from_when_stamps_count(name, seconds, clock):
    assert choose_clock(name, seconds) == clock


def test_more_that_tables_have():
    """Letters of the hemisphere, velocities in mm/s, stamps coarser than the rate."""
    found = gnss_spec(fixes(ns=["N"] * 9, ew=["W"] * 9, velN_mm_s=1, velE_mm_s=2, velD_mm_s=3)).spec
    assert found["position"]["hemispheres"] == ["ns", "ew"]
    assert found["velocity"] == {"columns": ["velN_mm_s", "velE_mm_s", "velD_mm_s"], "frame": "ned"}
    t = np.floor(0.1 * np.arange(200)) / 10
    frame = pd.DataFrame({"t": t, **{f"{s}{a}": 0.0 for s in ("acc_", "gyr_") for a in "xyz"}}).assign(acc_z=-9.8)
    spec = imu_spec(LogTable(frame, Path("a")))
    assert spec is not None and spec.spec["time"]["respace"] is True and "spread evenly" in spec.notes[0]
    of_packets = frame.assign(t=50.0 * (np.arange(200) // 5) + 0.1 * np.arange(200))
    spec = imu_spec(LogTable(of_packets, Path("a")))
    assert spec is not None and spec.spec["time"] == {"column": "t", "unit": "ms", "respace": True}
    assert spec.notes[0].startswith("80 % of the samples came in a packet")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("track.gpx", "<gpx>", "no fixes found in track.gpx (a track of GPX or KML; make it a CSV table"),
        ("fixes.xlsx", "PK", "no fixes found in fixes.xlsx (a spreadsheet; save its sheet as CSV)"),
        ("fixes.json", "[]", "no fixes found in fixes.json (JSON; write it as a CSV table)"),
        ("fixes.csv", "time,lat,lon,alt\n1,40°05'47\",8°1'2\",9\n", "lat has text such as 40°05'47\", must be decimal"),
        ("fixes.csv", "time,lat,lon\n1,50,8\n2,50,8\n", "lacks a height (one number in all rows will do)"),
        ("fixes.csv", "time,lat,lon,alt\n10:00:01,50,8,9\n10:00:02,50,8,9\n", "lacks a date beside the times of day"),
    ],
)
def test_fixes_that_are_no_table_of_them(name, text, said, tmp_path):
    """Beside an IMU: never a log at rest."""
    rest = pd.DataFrame({"t": 0.01 * np.arange(20.0), **{c: 0.0 for c in (*ACCEL, *GYRO)}}).assign(accel_z=-9.8)
    rest.to_csv(tmp_path / "imu.csv", index=False)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as refused:
        list(AutoReader().read(tmp_path))
    assert said in str(refused.value)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("cm", 0.01), ("km", 1e3), ("ft", 0.3048)])
def test_the_unit_of_heights_by_the_vertical_velocity(unit, metres, tmp_path, drive):
    """It is printed, as every estimate is; without a vertical velocity heights above all roads are mm."""
    gnss = hilly(drive["gnss"], metres, 0.02)
    frd = {"accel": {"axes": "frd"}, "gyro": {"axes": "frd"}}
    drive["imu"].to_csv(tmp_path / "imu.csv", index=False)
    for vel_d in (True, False) if unit == "mm" else (True,):
        (gnss if vel_d else gnss.drop(columns="vel_d")).rename(columns={"height_m": "alt"}).to_csv(
            tmp_path / "gnss.csv", index=False
        )
        (got,) = AutoReader(frd, {"time": {"offset_s": 0.0}}).read(tmp_path)
        assert abs(got.gnss.height_m.mean() - 100) < 5
        assert any(note.startswith(f"found reader.gnss.position.height_unit={unit}  (") for note in got.notes)


def test_accelerations_without_gravity_are_refused(tmp_path, drive):
    write(tmp_path / "a", {**drive, "imu": drive["imu"].assign(accel_z=drive["imu"].accel_z + 9.8)}, HEADERS["English"])
    with pytest.raises(InputError, match="there is no gravity in the accelerations"):
        list(AutoReader().read(tmp_path / "a"))


def test_names_mean_one_thing():
    """No name above belongs to two quantities, whatever its language, and none of the usual further columns to any."""
    for language, names in HEADERS.items():
        if language in ("nothing", "first letters"):
            continue
        wanted = ("lat", "lon", "height", "speed", "course", "hacc", "quality")
        for name, key in zip(names[4:], wanted):
            assert [k for k in QUANTITIES if find_column([name], k)] == [key], name
        assert match_columns([names[0], names[3]], TIME) == [names[0], names[3]]
        for key, pattern in zip(SENSORS, names[1:3]):
            assert triad([pattern.format(a) for a in "XYZ"], SENSORS[key]) is not None, pattern
    for name in ("numSV", "sats", "temp", "mag_x", "battery", "Stunde", "卫星数", "x", "id", "roll"):
        assert not [k for k in QUANTITIES if find_column([name], k)], name
        assert not match_columns([name], TIME) and not match_columns([name], DATE)
    assert split_unit("Länge (°)") == ("lange", "deg") and split_unit("alt_ft") == ("alt", "ft")


@pytest.mark.parametrize("prefix", ["", "imu.", "field."])
def test_accelerations_as_ros_calls_them(prefix):
    """Beside the rates of the same message; where nothing else is the accelerometer's, and never alone: a phone's
    linear acceleration has no gravity."""
    linear = [f"{prefix}linear_acceleration.{a}" for a in "xyz"]
    rates = [f"{prefix}angular_velocity.{a}" for a in "xyz"]
    assert find_triads([*linear, *rates]) == {"accel": linear, "gyro": rates}
    assert find_triads([*linear, *rates, "ax", "ay", "az"])["accel"] == ["ax", "ay", "az"]
    assert find_triads(linear) == {}


@pytest.mark.parametrize("name", ["{}rate", "{}_rate", "{}Rate [deg/s]", "gyro_{}"])
def test_rates_of_roll_pitch_and_yaw(name):
    rates = [name.format(angle) for angle in ("roll", "pitch", "yaw")]
    assert find_triads(["roll", "pitch", "yaw", *rates]) == {"gyro": rates}


def test_units_of_rates_with_sec():
    assert find_triads([f"gy_{a}[rad/sec]" for a in "xyz"]) == {"gyro": [f"gy_{a}[rad/sec]" for a in "xyz"]}
    assert split_unit("wx_deg_sec") == ("wx", "deg/s")


def test_a_unit_that_the_header_states_and_gravity_does_not_deny():
    """mg and cm/s² are 2 % apart; a header that is wrong is not taken."""
    t = 0.01 * np.arange(50)
    gyro = {f"gyro_{a}": 0.1 * np.sin(t) for a in "xyz"}
    accel = {"ax_mg": 0.0 * t, "ay_mg": 0.0 * t, "az_mg": -1000.0 + 0 * t}
    frame = pd.DataFrame({"t": t, **accel, **gyro})
    assert imu_spec(LogTable(frame, Path("a"))).spec["accel"]["unit"] == "mg"
    assert "unit" not in imu_spec(LogTable(frame.assign(az_mg=-9.81), Path("a"))).spec["accel"]
