"""Tables as apps, spreadsheets and other programs leave them: encodings, lines above the header, names, stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.readers.qualities import quality_spec
from dlkf.data.schema import ACCEL, GYRO
from tests.data.logs.clock import DEG, GPS, TOW, UNIX, WEEK, G
from tests.data.logs.phones import phyphox, phyphox_android

Tables = dict[str, pd.DataFrame]


def read(folder: Path, tables: Tables, *, velocity: bool = True) -> tuple[DriveFrames, str]:
    """The drive of a folder and what was found, after a check against what was written."""
    (got,) = AutoReader().read(folder)
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], tables["imu"][name], atol=0.02, err_msg=name)
    for name, within in (("lat_deg", 2e-8), ("lon_deg", 2e-8), ("height_m", 2e-3)):
        np.testing.assert_allclose(got.gnss[name], tables["gnss"][name], atol=within, err_msg=name)
    for name in ("vel_n", "vel_e") if velocity else ():
        np.testing.assert_allclose(got.gnss[name], tables["gnss"][name], atol=3e-3, err_msg=name)
    return got, "\n".join(got.notes)


def box(imu: pd.DataFrame, accel: str = "acc_{}", gyro: str = "gyr_{}", **time: object) -> pd.DataFrame:
    """A table of samples in g and °/s under these names."""
    axes = "XYZ"
    out = dict(time or {"t": imu.t})
    out |= {accel.format(a): imu[c] / G for a, c in zip(axes, ACCEL)}
    return pd.DataFrame(out | {gyro.format(a): imu[c] / DEG for a, c in zip(axes, GYRO)})


def fixes(gnss: pd.DataFrame, names: str, **more: object) -> pd.DataFrame:
    """Latitude, longitude, height, speed [km/h] and course under these names, behind ``more``."""
    course = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    values = (gnss.lat_deg, gnss.lon_deg, gnss.height_m, 3.6 * np.hypot(gnss.vel_n, gnss.vel_e), course)
    return pd.DataFrame({**more, **dict(zip(names.split(";"), values))})


ENGLISH = "lat;lon;height;speed_kmh;course"
WORDS = {  # encoding; samples' time, accelerometers, gyroscopes; fixes' time, place and velocity, quality and its word
    "Chinese of Windows": ("gb18030", "时间(秒)", "加速度{}(g)", "角速度{}(°/s)")
    + ("时间(秒)", "纬度(°);经度(°);海拔(m);地速(km/h);航向(°)", "定位状态", "固定解", 4),
    "Japanese of Windows": ("cp932", "時刻[s]", "加速度{}[G]", "角速度{}[deg/s]")
    + ("時刻[s]", "緯度[度];経度[度];楕円体高[m];対地速度[km/h];進行方向[度]", "測位状態", "FLOAT", 5),
    "Chinese, traditional": ("big5", "時間(s)", "加速度{}(g)", "陀螺儀{}(deg/s)")
    + ("時間(s)", "緯度;經度;高度;速度(km/h);航向", "定位品質", "固定解", 4),
    "French": ("cp1252", "Temps (s)", "Accéléromètre {} (g)", "Gyromètre {} (°/s)")
    + ("Temps (s)", "Latitude;Longitude;Hauteur ellipsoïdale (m);Vitesse (km/h);Cap", "Type de fix", "RTK fixe", 4),
    "Spanish": ("utf-8", "Tiempo (s)", "Acelerómetro {} (g)", "Giróscopo {} (°/s)")
    + ("Tiempo (s)", "Latitud;Longitud;Altura elipsoidal (m);Velocidad (km/h);Rumbo", "Tipo de fix", "RTK fijo", 4),
    "German": ("cp1252", "Zeit (s)", "Beschl. {} (g)", "Gyroskop {} (°/s)")
    + ("Zeit (s)", "Breite;Länge;Ellipsoidische Höhe;Geschwindigkeit (km/h);Fahrtrichtung", "Fixtyp", "RTK Float", 5),
}


@pytest.mark.parametrize("language", WORDS)
def test_words_and_encodings(language: str, tmp_path: Path, drive: Tables) -> None:
    """As spreadsheets of that language save them; nothing is left unused."""
    encoding, t, accel, gyro, stamps, names, quality, word, code = WORDS[language]
    box(drive["imu"], accel, gyro, **{t: drive["imu"].t}).to_csv(tmp_path / "a.csv", index=False, encoding=encoding)
    table = fixes(drive["gnss"], names, **{stamps: UNIX + drive["gnss"].t}).assign(**{quality: word})
    table.to_csv(tmp_path / "b.csv", index=False, encoding=encoding)
    got, notes = read(tmp_path, drive)
    assert set(got.gnss.quality) == {code} and "not used" not in notes


def test_words_of_a_quality() -> None:
    for words, codes in (
        (["RTK fest", "RTK Float", "kein Fix"], [4, 5, 0]),
        (["Float Solution", "Fixed Solution"], [5, 4]),
    ):
        spec, _ = quality_spec(pd.DataFrame({"fix": words}), "fix", np.nan)
        assert spec is not None and list(spec["map"].values()) == codes


STAMPS = {  # seconds since the drive's beginning to columns of stamps; what is reported of them
    "hours, minutes and seconds, and a date, as NMEA has them": (
        lambda t: {
            "date": (when := pd.to_datetime(UNIX + t, unit="s")).dt.strftime("%d%m%y"),
            "utc_time": when.dt.strftime("%H%M%S.%f").str[:-4],
        },
        "(date, utc_time): taken as hours, minutes and seconds (hhmmss) in UTC, from 2025-01-22 on",
    ),
    "years of two digits": (
        lambda t: {"Zeit": pd.to_datetime(UNIX + t, unit="s").dt.strftime("%d.%m.%y %H:%M:%S.%f")},
        "(Zeit): dates taken as UTC",
    ),
    "hours, minutes and seconds alone": (
        lambda t: {"utc": pd.to_datetime(UNIX + t, unit="s").dt.strftime("%H%M%S.%f").str[:-4]},
        "which have no date; reader.gnss.time.day=… gives it",
    ),
    "MATLAB's datenum": (
        lambda t: {"datenum": (UNIX + t) / 86_400 + 719_529},
        "MATLAB's datenum in UTC, of 2025-01-22",
    ),
    "a spreadsheet's date": (lambda t: {"Date": (UNIX + t) / 86_400 + 25_569}, "dates in UTC, of 2025-01-22"),
    "week and time of week": (
        lambda t: {"week": WEEK, "tow": TOW + t},
        "(tow, week): taken as week 2350 of GPS and seconds of it, of 2025-01-23",
    ),
    "seconds of the day": (
        lambda t: {"utc_seconds": 57_600 + t},
        "seconds of a day or of a GPS week, which have no date; reader.gnss.time.day=2025-07-05 or "
        "reader.gnss.time.week_number=… gives it",
    ),
    "time of week": (lambda t: {"tow": 57_600 + t}, "seconds of a GPS week, it seems"),
}


@pytest.mark.parametrize("kind", STAMPS)
def test_stamps(kind: str, tmp_path: Path, drive: Tables) -> None:
    """Which epoch stamps are taken for is reported, and both where two are possible."""
    stamps, said = STAMPS[kind]
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    fixes(drive["gnss"], ENGLISH, **stamps(drive["gnss"].t)).to_csv(tmp_path / "b.csv", index=False)
    got, notes = read(tmp_path, drive)
    np.testing.assert_allclose(got.gnss.t, drive["gnss"].t, atol=0.012)
    assert said in notes and "not used" not in notes
    if any(word in said for word in ("of 2025", "from 2025", "UTC")):
        assert abs(got.meta["gps_zero_s"] - GPS) < 1.0


def test_lines_above_the_header(tmp_path: Path, drive: Tables) -> None:
    """What an app writes about the session before its table."""
    head = 'Created by an app\nFormat,3\nTitle,"town, monday"\n\n'
    (tmp_path / "a.csv").write_text(head + box(drive["imu"]).to_csv(index=False))
    fixes(drive["gnss"], ENGLISH, t=UNIX + drive["gnss"].t).to_csv(tmp_path / "b.csv", index=False)
    read(tmp_path, drive)


def beside(imu: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
    """The last row of a table beside every sample."""
    rows = np.searchsorted(table.t, imu.t, side="right") - 1
    return table.drop(columns="t").iloc[np.maximum(rows, 0)].reset_index(drop=True)


def test_sensor_log_of_a_phone(tmp_path: Path, streets: Tables) -> None:
    """SensorLog (iOS): one table, the last fix beside every sample, the accelerometers' sign turned round."""
    imu, gnss = streets["imu"], streets["gnss"]
    names = ";".join(f"location{x}" for x in ("Latitude(WGS84)", "Longitude(WGS84)", "Altitude(m)"))
    place = fixes(gnss, f"{names};locationSpeed(km/h);locationCourse(°)", t=gnss.t)
    when = pd.to_datetime(UNIX + 7200 + imu.t, unit="s").dt.strftime("%Y-%m-%d %H:%M:%S.%f").str[:-3] + " +0200"
    samples = box(imu, "accelerometerAcceleration{}(G)", "motionRotationRate{}(deg/s)", **{"loggingTime(txt)": when})
    samples.iloc[:, 1:4] *= -1
    pd.concat((samples, beside(imu, place)), axis=1).to_csv(tmp_path / "phone.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], imu[name], atol=0.05, err_msg=name)
    assert "its sign turned round" in "\n".join(got.notes)


def test_xsens_export(tmp_path: Path, drive: Tables) -> None:
    """MT Manager: comments of two letters, ticks of 0.1 ms, positions in the rows that have them."""
    imu, gnss = drive["imu"], drive["gnss"]
    table = pd.DataFrame({"PacketCounter": np.arange(len(imu)), "SampleTimeFine": np.round(1e4 * imu.t).astype(int)})
    for name, columns in (("Acc", ACCEL), ("Gyr", GYRO)):
        table[[f"{name}_{a}" for a in "XYZ"]] = imu[list(columns)]
    for name, column in (("Latitude", "lat_deg"), ("Longitude", "lon_deg"), ("Altitude", "height_m")):
        table[name] = pd.Series(gnss[column].to_numpy()[:-1], index=np.arange(len(gnss) - 1) * 100 + 99)
    (tmp_path / "MT.txt").write_text("// MT Manager\n//  Update Rate: 100Hz\n" + table.to_csv(index=False, sep="\t"))
    (got,) = AutoReader().read(tmp_path)
    assert len(got.imu) == len(imu) and len(got.gnss) == len(gnss) - 1
    notes = "\n".join(got.notes)
    assert "not used: PacketCounter" in notes and "stamps of" not in notes  # a counter is no time of week


def test_velocities_under_names_of_their_own(tmp_path: Path, drive: Tables) -> None:
    """Positions by their names, speed and course by the way between them, and that is reported."""
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    names = "lat;lon;height;how_fast;where_to"
    fixes(drive["gnss"], names, t=UNIX + drive["gnss"].t).to_csv(tmp_path / "b.csv", index=False)
    _, notes = read(tmp_path, drive)
    assert "took how_fast, where_to for the velocities by the way between the positions" in notes


def test_a_receivers_numbers_as_they_are(tmp_path: Path, drive: Tables) -> None:
    """u-blox: 1e-7 degrees, mm and mm/s without units in the names; the carrier solution says RTK."""
    gnss = drive["gnss"]
    box(drive["imu"]).to_csv(tmp_path / "a.csv", index=False)
    table = pd.DataFrame({"iTOW": 1000 * (TOW + gnss.t), "lat": 1e7 * gnss.lat_deg, "lon": 1e7 * gnss.lon_deg})
    table["height"] = 1000 * gnss.height_m
    table[["velN", "velE", "velD"]] = 1000 * gnss[["vel_n", "vel_e", "vel_d"]]
    table[["hAcc", "vAcc", "sAcc", "fixType", "carrSoln"]] = (14, 20, 65, 3, 2)
    table.round().astype("int64").to_csv(tmp_path / "b.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.gnss.height_m, gnss.height_m, atol=2e-3)
    np.testing.assert_allclose(got.gnss.vel_n, gnss.vel_n, atol=2e-3)
    for name, std in (("std_pos_n", 0.014), ("std_pos_d", 0.02), ("std_vel_e", 0.065)):
        np.testing.assert_allclose(got.gnss[name], std, err_msg=name)
    assert set(got.gnss.quality) == {4} and "not used: fixType" in "\n".join(got.notes)


def test_a_quality_beside_a_dilution_is_not_rtklibs() -> None:
    """Q = 1 is RTK fixed there and single in NMEA; RTKLIB writes no HDOP, and 2 cm would be trusted too much."""
    frame = pd.DataFrame({"q": [1] * 9, "hdop": 0.7})
    for table, taken in ((frame, "NMEA's GGA code"), (frame[["q"]], "RTKLIB's Q")):
        _, (note,) = quality_spec(table, "q", np.nan)
        assert f"taken as {taken}" in note


HEADLESS = {  # columns of the fixes
    "longitude before latitude": lambda t, g: (UNIX + t, g.lon_deg, g.lat_deg, g.height_m),
    "1e-7 degrees and millimetres": lambda t, g: (UNIX + t, g.lat_deg * 1e7, g.lon_deg * 1e7, g.height_m * 1000),
    "date and time": lambda t, g: (
        *(pd.to_datetime(UNIX + t, unit="s").dt.strftime(f) for f in ("%Y-%m-%d", "%H:%M:%S.%f")),
        *(g.lat_deg, g.lon_deg, g.height_m),
    ),
}


@pytest.mark.parametrize("order", HEADLESS)
def test_fixes_without_a_header(order: str, tmp_path: Path, drive: Tables) -> None:
    """With velocities, which distinguish latitude from longitude."""
    imu, gnss = drive["imu"], drive["gnss"]
    np.savetxt(tmp_path / "a.txt", np.column_stack((1000 * imu.t, imu[[*ACCEL, *GYRO]])), fmt="%.6f")
    course = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    columns = (*HEADLESS[order](gnss.t, gnss), np.hypot(gnss.vel_n, gnss.vel_e), course)
    table = pd.DataFrame(dict(enumerate(columns)))
    if "1e-7" in order:
        table[[1, 2, 3]] = table[[1, 2, 3]].round().astype("int64")
    table.to_csv(tmp_path / "b.csv", index=False, header=False, float_format="%.10f")
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.gnss.lat_deg, gnss.lat_deg, atol=2e-7)
    np.testing.assert_allclose(got.gnss.vel_n, gnss.vel_n, atol=3e-3)
    np.testing.assert_allclose(got.imu.accel_x, imu.accel_x, atol=0.02)


def sbg(gnss: pd.DataFrame) -> pd.DataFrame:
    """Names of an export by sbgInsCenter, heights above sea level."""
    place = {"Latitude": gnss.lat_deg, "Longitude": gnss.lon_deg, "Altitude": gnss.height_m - 45, "Undulation": 45.0}
    stds = {"Latitude Accuracy": 0.02, "Longitude Accuracy": 0.03, "Altitude Accuracy": 0.04}
    velocity = {"Velocity North": gnss.vel_n, "Velocity East": gnss.vel_e, "Velocity Down": gnss.vel_d}
    return pd.DataFrame({"t": gnss.t, **place, "Position Type": "RTK_INT", **stds, **velocity})


def vectornav(gnss: pd.DataFrame) -> pd.DataFrame:
    place = {"PosLlaLat": gnss.lat_deg, "PosLlaLon": gnss.lon_deg, "PosLlaAlt": gnss.height_m}
    return pd.DataFrame({"t": gnss.t, **place, "VelNedN": gnss.vel_n, "VelNedE": gnss.vel_e, "VelNedD": gnss.vel_d})


def oxts(gnss: pd.DataFrame) -> pd.DataFrame:
    place = {"PosLat (deg)": gnss.lat_deg, "PosLon (deg)": gnss.lon_deg, "PosAlt (m)": gnss.height_m}
    velocity = {"VelNorth (m/s)": gnss.vel_n, "VelEast (m/s)": gnss.vel_e, "VelDown (m/s)": gnss.vel_d}
    return pd.DataFrame({"t": gnss.t, **place, **velocity})


@pytest.mark.parametrize("table", [sbg, vectornav, oxts])
def test_names_of_inertial_systems(table, tmp_path: Path, drive: Tables) -> None:
    """Every column is used; of SBG quality and accuracies too."""
    box(drive["imu"], gyro="AngleRate{} (deg/s)").to_csv(tmp_path / "a.csv", index=False)
    table(drive["gnss"]).to_csv(tmp_path / "b.csv", index=False)
    got, notes = read(tmp_path, drive)
    np.testing.assert_allclose(got.gnss.vel_d, drive["gnss"].vel_d, atol=1e-6)
    assert "not used" not in notes
    if table is sbg:
        assert set(got.gnss.quality) == {4}
        stds = got.gnss[["std_pos_n", "std_pos_e", "std_pos_d"]]
        np.testing.assert_allclose(stds, np.broadcast_to([0.02, 0.03, 0.04], stds.shape))


def test_rates_in_millidegrees(tmp_path: Path, drive: Tables) -> None:
    imu = drive["imu"]
    table = box(imu, "acc_{}_mg", "gyro_{}_mdps")
    table.iloc[:, 1:] *= 1000
    table.to_csv(tmp_path / "a.csv", index=False)
    fixes(drive["gnss"], ENGLISH, t=drive["gnss"].t).to_csv(tmp_path / "b.csv", index=False)
    read(tmp_path, drive)


def test_the_unit_of_rates_without_fixes_is_that_of_their_names(tmp_path: Path, drive: Tables) -> None:
    box(drive["imu"], "acc_{} (g)", "gyr_{} (deg/s)").to_csv(tmp_path / "a.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.imu[list(GYRO)], drive["imu"][list(GYRO)], atol=1e-9)


def test_milliseconds_behind_a_colon(tmp_path: Path, drive: Tables) -> None:
    """AndroSensor: dates such as 2025-01-22 23:57:12:010."""
    for kind, name in (("imu", "a"), ("gnss", "b")):
        when = pd.to_datetime(UNIX + drive[kind].t, unit="s").dt.strftime("%Y-%m-%d %H:%M:%S:%f").str[:-3]
        stamps = {"YYYY-MO-DD HH-MI-SS_SSS": when}
        table = box(drive[kind], **stamps) if kind == "imu" else fixes(drive[kind], ENGLISH, **stamps)
        table.to_csv(tmp_path / f"{name}.csv", index=False)
    got, _ = read(tmp_path, drive)
    np.testing.assert_allclose(got.gnss.t, drive["gnss"].t, atol=2e-3)
    assert abs(got.meta["gps_zero_s"] - GPS) < 1.0


def test_time_since_the_start(tmp_path: Path, drive: Tables) -> None:
    box(drive["imu"], **{"Time since start in ms": np.round(1000 * drive["imu"].t)}).to_csv(tmp_path / "a.csv")
    fixes(drive["gnss"], ENGLISH, t=drive["gnss"].t).to_csv(tmp_path / "b.csv", index=False)
    read(tmp_path, drive)


@pytest.mark.parametrize("app", [phyphox, phyphox_android])
def test_a_phones_export_with_decimal_commas(app, tmp_path: Path, drive: Tables) -> None:
    app(tmp_path, drive)
    for path in tmp_path.glob("*.csv"):
        pd.read_csv(path).to_csv(path, index=False, sep=";", decimal=",", quoting=1)
    read(tmp_path, drive)
