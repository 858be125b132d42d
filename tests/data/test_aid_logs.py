"""Wheel speed, heading and barometer out of people's logs, of any unit and clock; a receiver's speed is no wheel's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dlkf.base.errors import InputError
from dlkf.data.discovery.motion import find_motion
from dlkf.data.discovery.wheel import find_wheel
from dlkf.data.intake import IngestOptions, ingest, ingest_drives
from dlkf.data.readers import formats
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.recognise import aid_specs
from dlkf.data.tables import read_table
from tests.cars import car
from tests.data.logs.bags import _Bag, ros2
from tests.data.logs.clock import GPS, TOW, UNIX, nanoseconds
from tests.data.logs.phones import phyphox, sensor_logger
from tests.data.logs.receivers import sentences, ubx_fixes
from tests.data.test_auto import _hidden
from tests.data.test_csv import log_reader
from tests.data.test_formats import read

SCALE = 0.972  # of the wheel: what it shows is less than the way


@pytest.fixture(scope="module")
def drive():
    """A hundred seconds with the wheels' speed at 10 Hz."""
    tables = car(100)
    fine = car(100, gnss_hz=10)["gnss"]
    speed = np.hypot(fine.vel_n, fine.vel_e)
    yaw = np.degrees(np.arctan2(fine.vel_e, fine.vel_n))
    wheel = pd.DataFrame({"t": fine.t, "speed": SCALE * speed, "way": np.cumsum(SCALE * speed * 0.1), "yaw": yaw})
    return {**tables, "wheel": wheel}


def wheel_agrees(table: pd.DataFrame, drive, atol: float = 0.02, scale: float = 1.0) -> None:
    """The table's speed at its times is that of the drive."""
    want = np.interp(table.t, drive["wheel"].t, drive["wheel"].speed)
    inside = (table.t > 1) & (table.t < 98)
    np.testing.assert_allclose(table.speed[inside] * scale, want[inside], atol=atol)


@pytest.mark.parametrize(
    ("name", "column", "unit", "offset"),
    [
        ("obd.csv", "Geschwindigkeit [km/h]", 1 / 3.6, 0.0),
        ("wheels.csv", "speed_mph", 0.44704, -3.3),
        ("can.csv", "vehicle speed", 0.514444, 7200.0),
        ("log3.csv", "wheel_speed", 1.0, 0.15),
        ("odo.csv", "速度", 1 / 3.6, 0.0),
    ],
)
def test_a_wheel_of_any_unit_on_any_clock(tmp_path, drive, name, column, unit, offset):
    """Its clock to 20 ms, its unit by name or by GNSS, its scale kept."""
    _hidden(tmp_path / "a", drive)
    wheel = drive["wheel"]
    pd.DataFrame({"time_s": wheel.t - offset, column: wheel.speed / unit}).to_csv(tmp_path / "a" / name, index=False)
    notes = []
    count = ingest(AutoReader(), tmp_path / "a", tmp_path / "out", IngestOptions(), parallel=None,
                   progress=lambda one, _: notes.extend((*one.notes, *one.lines)))  # fmt: skip
    assert count == 1 and any(f"found speed in {name}: {column}" in n for n in notes)
    table = pd.DataFrame(read_table(tmp_path / "out", "speed", "a"))
    wheel_agrees(table, drive, atol=0.03)
    if abs(offset) > 0.1:
        (said,) = (n for n in notes if "reader.speed.time.offset_s" in n)
        assert float(said.partition("=")[2].split()[0]) == pytest.approx(offset, abs=0.02)
    assert any("wheel speed 10 Hz" in n for n in notes)
    preset = (tmp_path / "out" / "reader" / "found.yaml").read_text()
    assert "auto" not in preset and name in preset


def test_the_receivers_own_speed_is_no_wheel(tmp_path, drive):
    """Of a logger that has both, in one table; without the wheel's column there is none."""
    _hidden(tmp_path / "a", drive)
    path = tmp_path / "a" / "receiver.csv"
    table = pd.read_csv(path)
    (got,) = AutoReader().read(tmp_path / "a")
    assert got.aids == {}
    wheel = np.interp(drive["gnss"].t, drive["wheel"].t, drive["wheel"].speed)
    table.assign(**{"Speed (OBD)(km/h)": 3.6 * wheel}).to_csv(path, index=False)
    (got,) = AutoReader().read(tmp_path / "a")
    wheel_agrees(got.aids["speed"], drive, atol=0.02)
    np.testing.assert_allclose(
        np.hypot(got.gnss.vel_n, got.gnss.vel_e), np.hypot(*drive["gnss"][["vel_n", "vel_e"]].T.values)
    )
    (got,) = AutoReader(speed={"file": None}).read(tmp_path / "a")
    assert got.aids == {} and any("Speed (OBD)(km/h)" in n for n in got.notes if "not used" in n)


def test_a_torque_log(tmp_path, drive):
    """Torque's CSV: dates with the month's name, GPS beside OBD, whole km/h, engine speed, dashes where unknown."""
    gnss, imu = drive["gnss"], drive["imu"]
    folder = tmp_path / "a"
    folder.mkdir()
    imu.assign(t=UNIX + imu.t).to_csv(folder / "imu.csv", index=False)
    when = pd.to_datetime(np.round((UNIX + gnss.t) * 1000), unit="ms")
    speed = np.hypot(gnss.vel_n, gnss.vel_e)
    wheel = np.interp(gnss.t, drive["wheel"].t, drive["wheel"].speed)
    torque = pd.DataFrame(
        {"GPS Time": "Sat Jul 05 16:00:00 GMT+02:00 2025", "Device Time": when.dt.strftime("%d-%b-%Y %H:%M:%S.%f")}
    )
    torque = torque.assign(Longitude=gnss.lon_deg, Latitude=gnss.lat_deg, **{"GPS Speed (Meters/second)": speed})
    torque["Horizontal Dilution of Precision"], torque["Altitude"] = "-", gnss.height_m
    torque["Bearing"] = np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360
    torque["Engine RPM(rpm)"], torque["Speed (GPS)(km/h)"] = 2000, 3.6 * speed
    torque["Speed (OBD)(km/h)"] = np.floor(3.6 * wheel).astype(int)
    torque["GPS vs OBD Speed difference(km/h)"] = 1
    torque.to_csv(folder / "trackLog.csv", index=False)
    (got,) = AutoReader().read(folder)
    assert any("found speed in trackLog.csv: Speed (OBD)(km/h)" in n for n in got.notes)
    wheel_agrees(got.aids["speed"], drive, atol=0.3)
    np.testing.assert_allclose(got.gnss.vel_n, gnss.vel_n, atol=1e-6)


@pytest.mark.parametrize(
    ("value", "made"),
    [
        ({"columns": ["n"], "unit": "ticks", "per_metre": 40.0}, lambda w: np.round(40 * w.way)),
        (
            {"columns": ["n"], "unit": "ticks", "per_turn": 96, "radius_m": 0.3},
            lambda w: np.round(96 * w.way / (0.6 * np.pi)),
        ),
        ({"columns": ["n"], "unit": "ticks", "per_metre": 40.0}, lambda w: np.round(40 * w.way) % 4096),
        ({"columns": ["n"], "unit": "auto", "counts": True}, lambda w: np.round(40 * w.way)),
        ({"columns": ["n"], "unit": "rpm", "radius_m": 0.3}, lambda w: w.speed / (0.6 * np.pi) * 60),
        ({"columns": ["n"], "unit": "m"}, lambda w: w.way),
        ({"columns": ["n", "n2"], "unit": "km/h"}, lambda w: 3.6 * w.speed),
    ],
)
def test_ticks_turns_and_ways(tmp_path, drive, value, made):
    """By what is said of the wheel; by GNSS the scale is GNSS's, and said."""
    for kind in ("imu", "gnss"):
        drive[kind].to_csv(tmp_path / f"{kind}.csv", index=False)
    out = drive["wheel"][["t"]].assign(n=made(drive["wheel"]))
    out.assign(n2=out.n).to_csv(tmp_path / "wheel.csv", index=False)
    speed = {"file": "wheel.csv", "time": {"column": "t"}, "value": value}
    (got,) = log_reader(speed=speed).read(tmp_path)
    found = value["unit"] == "auto"
    # a tick of 25 mm in 100 ms is 0.25 m/s
    wheel_agrees(got.aids["speed"], drive, atol=0.3, scale=SCALE if found else 1.0)
    assert abs(np.mean(got.aids["speed"].speed) / np.mean(drive["wheel"].speed) * (SCALE if found else 1) - 1) < 0.01
    assert any("a number by GNSS" in n for n in got.notes) == found
    assert ingest_drives([got], tmp_path / "out") == 1


MISTAKES = {
    "rpm without a radius": ({"unit": "rpm"}, "radius_m is missing; unit=rpm needs radius_m"),
    "ticks without anything": ({"unit": "ticks"}, r"needs radius_m and per_turn \(or per_metre\), or auto"),
    "a unit of one's own": ({"unit": "warp"}, "unknown unit 'warp'"),
    "no speed at all": ({"unit": "auto", "columns": ["noise"]}, "not sure that this is the speed of a wheel"),
    "a key of one's own": ({"wheels": 4}, "unknown key wheels"),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes(tmp_path, drive, case):
    changes, said = MISTAKES[case]
    for kind in ("imu", "gnss"):
        drive[kind].to_csv(tmp_path / f"{kind}.csv", index=False)
    noise = np.random.default_rng(1).uniform(0, 9, len(drive["wheel"]))
    drive["wheel"].assign(noise=noise).to_csv(tmp_path / "wheel.csv", index=False)
    speed = {"file": "wheel.csv", "time": {"column": "t"}, "value": {"columns": ["speed"], **changes}}
    with pytest.raises(InputError, match=said) as error:
        list(log_reader(speed=speed).read(tmp_path))
    assert "\n" not in str(error.value)


def ubx_log(folder, drive, messages):
    """The fixes of a drive as UBX with other messages between them, and the IMU as text."""
    ubx_fixes(folder / "town.ubx", drive)
    content = (folder / "town.ubx").read_bytes()
    parts = content.split(b"\xb5b\x01\x07")
    out = [parts[0]]
    for part, more in zip(parts[1:], messages):
        out += [b"\xb5b\x01\x07", part, *(m.serialize() for m in more)]
    (folder / "town.ubx").write_bytes(b"".join(out))
    drive["imu"].assign(t=UNIX + drive["imu"].t).to_csv(folder / "imu.csv", index=False)


@pytest.mark.parametrize("kind, lacks", [("speed", "wheels"), ("heading", "RELPOSNED"), ("baro", "barometer")])
def test_ubx_without_a_sensor_says_which(tmp_path, drive, kind, lacks):
    ubx_fixes(tmp_path / "town.ubx", drive)
    with pytest.raises(InputError, match=rf"has no .*{lacks}.*; set reader\.{kind}\.file=null"):
        formats.read("ubx", tmp_path / "town.ubx", kind=kind, table=None, text={}, where="")


@pytest.mark.parametrize("ticks", [False, True], ids=["speed", "ticks"])
def test_ubx_with_wheels_and_a_moving_base(tmp_path, drive, ticks):
    """ESF-MEAS with speed in mm/s or ticks of the rear wheels; NAV-RELPOSNED."""
    from pyubx2 import GET, UBXMessage

    wheel, every = drive["wheel"], []
    for k, fix in drive["gnss"].iterrows():
        more = [UBXMessage("NAV", "NAV-RELPOSNED", GET, version=1, iTOW=round(1000 * (TOW + fix.t)), accHeading=0.2,
                           relPosHeading=float(wheel.yaw[10 * k] % 360), relPosHeadingValid=1)]  # fmt: skip
        for row in wheel.iloc[10 * k : 10 * k + 10].itertuples():
            counts = round(100 * row.way) & 0x7FFFFF
            words = [(8, counts), (9, counts)] if ticks else [(11, round(1000 * row.speed))]
            head = (
                round(1000 * row.t + 5000).to_bytes(4, "little") + (len(words) << 11).to_bytes(2, "little") + bytes(2)
            )
            payload = head + b"".join((value | kind << 24).to_bytes(4, "little") for kind, value in words)
            more.append(UBXMessage("ESF", "ESF-MEAS", GET, payload=payload))
        every.append(more)
    ubx_log(tmp_path, drive, every)
    (got,) = AutoReader(imu={"file": "imu.csv"}).read(tmp_path)
    # the time of a tag is known to a sample of 100 ms, at 0.6 m/s²
    wheel_agrees(got.aids["speed"], drive, atol=0.15 if ticks else 0.08, scale=SCALE if ticks else 1.0)
    heading = got.aids["heading"]
    want = np.radians(np.interp(heading.t, wheel.t, np.degrees(np.unwrap(np.radians(wheel.yaw)))))
    assert np.abs(np.angle(np.exp(1j * (heading.heading - want)))).max() < 0.01
    np.testing.assert_allclose(heading["std"], np.radians(0.2), rtol=1e-3)
    assert ingest_drives([got], tmp_path / "out") == 1


@pytest.mark.parametrize("kind", ["HDT", "THS"])
def test_nmea_with_a_heading(tmp_path, drive, kind):
    from pynmeagps import GET, NMEAMessage

    yaw = dict(zip(drive["wheel"].t.round(3), drive["wheel"].yaw % 360))
    out, last = [], None
    for t, message in sentences(drive):
        if last is not None and t != last:
            angle = round(float(yaw[round(last, 3)]), 2)
            more = {"headingT": angle, "headingTu": "T"} if kind == "HDT" else {"headt": angle, "mi": "A"}
            out.append(NMEAMessage("GN", kind, GET, **more).serialize())
        out.append(message.serialize())
        last = t
    (tmp_path / "town.nmea").write_bytes(b"".join(out))
    drive["imu"].assign(t=UNIX + drive["imu"].t).to_csv(tmp_path / "imu.csv", index=False)
    (got,) = AutoReader().read(tmp_path)
    heading = got.aids["heading"]
    want = np.interp(heading.t, drive["wheel"].t, np.degrees(np.unwrap(np.radians(drive["wheel"].yaw))))
    assert len(heading) == len(drive["gnss"]) - 1
    assert np.abs(np.angle(np.exp(1j * (heading.heading - np.radians(want))))).max() < 0.01


@pytest.mark.parametrize("stamped", [False, True], ids=["Odometry", "TwistStamped"])
def test_a_bag_with_wheels(tmp_path, drive, stamped):
    """Beside the velocities of GNSS, which are TwistStamped too."""

    class Both(_Bag):
        def imu(self, tables, base):
            super().imu(tables, base)
            for t, row in zip(nanoseconds(drive["wheel"].t, GPS), drive["wheel"].itertuples()):
                twist = self.make(
                    "geometry_msgs/msg/Twist", linear=self.xyz(row.speed, 0.0, 0.0), angular=self.xyz(0.0, 0.0, 0.0)
                )
                head = self.header(int(t), "base_link")
                if stamped:
                    message = self.make("geometry_msgs/msg/TwistStamped", header=head, twist=twist)
                else:
                    point, turn = self.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0), self.make(
                        "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)  # fmt: skip
                    pose = self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)
                    pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
                    twist = self.make(
                        "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.eye(6).ravel() * 0.01
                    )
                    message = self.make(
                        "nav_msgs/msg/Odometry", header=head, child_frame_id="base_link", pose=pose, twist=twist
                    )
                self.write("/vehicle/wheel_odometry", int(t), message)

    import tests.data.logs.bags as bags

    usual, bags._Bag = bags._Bag, Both
    try:
        (tmp_path / "y").mkdir()
        ros2(tmp_path / "y", drive)
    finally:
        bags._Bag = usual
    (got,) = AutoReader().read(tmp_path / "y" / "drive")
    wheel_agrees(got.aids["speed"], drive, atol=0.02)
    assert np.isfinite(got.gnss.vel_n).all()
    if not stamped:
        np.testing.assert_allclose(got.aids["speed"]["std"], 0.1)


def test_barometers_of_phones(tmp_path, drive):
    """Sensor Logger in mbar, phyphox in hPa, a table of one's own in hPa."""
    pressure = 950.0 + 0.1 * np.sin(drive["wheel"].t)
    for writer, file, table in (
        (
            sensor_logger,
            "Barometer.csv",
            {"time": nanoseconds(drive["wheel"].t, UNIX), "relativeAltitude": 0.0, "pressure": pressure},
        ),
        (phyphox, "Pressure.csv", {"Time (s)": drive["wheel"].t, "Pressure (hPa)": pressure}),
    ):
        folder = tmp_path / writer.__name__
        folder.mkdir()
        writer(folder, drive)
        pd.DataFrame(table).to_csv(folder / file, index=False)
        (got,) = AutoReader().read(folder)
        np.testing.assert_allclose(got.aids["baro"].pressure, 100 * pressure)
        assert ingest_drives([got], tmp_path / f"out-{folder.name}") == 1
        assert not [note for note in got.notes if "baro.time" in note]  # the phone's own clock
    _hidden(tmp_path / "a", drive)
    box = pd.read_csv(tmp_path / "a" / "box.txt", sep=";").assign(Luftdruck=950.0)
    box.to_csv(tmp_path / "a" / "box.txt", index=False, sep=";")
    (got,) = AutoReader().read(tmp_path / "a")
    assert set(got.aids["baro"].pressure) == {95000.0}


def test_an_odometer_of_kf_gins(tmp_path, drive):
    """Two columns, seconds of the week and speed."""
    imu, gnss = drive["imu"], drive["gnss"]
    increments = imu[["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]].to_numpy() * 0.01
    np.savetxt(tmp_path / "ADIS16465.txt", np.column_stack((TOW + imu.t, increments)), fmt="%.10g")
    place = gnss[["lat_deg", "lon_deg", "height_m"]].to_numpy()
    np.savetxt(tmp_path / "GNSS_RTK.txt", np.column_stack((TOW + gnss.t, place, 0 * place + 0.02)), fmt="%.12g")
    wheel = drive["wheel"]
    np.savetxt(tmp_path / "odo.txt", np.column_stack((TOW + wheel.t, wheel.speed)), fmt="%.10g")
    (got,) = read(tmp_path, ["reader=kfgins", "reader.speed.file=odo.txt"])
    wheel_agrees(got.aids["speed"], drive, atol=1e-6)


def test_what_a_wheel_cannot_tell(drive):
    """A constant speed has no clock; noise agrees with nothing."""
    moved = find_motion(drive["gnss"])
    t = drive["wheel"].t.to_numpy()
    assert find_wheel(t, np.full(len(t), 10.0), moved) is None
    noise = find_wheel(t, np.random.default_rng(0).uniform(0, 20, len(t)), moved)
    assert noise is None or not noise.clear
    for offset in (0.0, 0.37, -64.0):
        found = find_wheel(t - offset, drive["wheel"].speed.to_numpy(), moved)
        assert found is not None and found.lag_s == pytest.approx(offset, abs=0.01)
        assert found.scale == pytest.approx(1 / SCALE, rel=1e-3)


@pytest.mark.parametrize(
    "called, names, taken",
    [
        ("phone", ["locationTrueHeading(°)", "locationMagneticHeading(°)"], None),
        ("phone", ["trueHeading"], None),
        ("heading", ["trueHeading", "magneticHeading"], None),
        ("heading", ["heading"], "heading"),
        ("receiver", ["dual_heading"], "dual_heading"),
    ],
)
def test_a_compass_is_no_heading_of_antennas(called, names, taken):
    """It points where the phone does, and magnets of the car turn it."""
    frame = pd.DataFrame({"t": 0.1 * np.arange(50), **{name: 90.0 + np.arange(50) for name in names}})
    spec = aid_specs(LogTable(frame, Path("a.csv")), called)
    assert ("heading" in spec) == (taken is not None)
    assert taken is None or spec["heading"]["value"] == {"columns": [taken], "unit": "deg"}
