"""Recorders of vehicles: MCAP of Foxglove and ROS 2, PX4's and ArduPilot's logs."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from dlkf.base.errors import InputError
from dlkf.data.intake import ingest_drives
from dlkf.data.readers.auto import AutoReader
from dlkf.data.readers.formats import rosbag
from dlkf.data.readers.offers import recognise_file
from dlkf.data.schema import ACCEL, GYRO, STD
from tests.cars import car
from tests.data.logs import metres
from tests.data.logs.autopilots import ardupilot, px4
from tests.data.logs.clock import UNIX, imu_table, nanoseconds
from tests.data.logs.receivers import sentences
from tests.data.test_formats import read


@pytest.fixture(scope="module")
def tables():
    return car(20)


@pytest.mark.parametrize("writer", [px4, ardupilot])
def test_an_autopilots_log(tmp_path, tables, writer):
    """The drive that was written, in single precision; ArduPilot's positions have 1 cm; both tell the date."""
    (got,) = read(tmp_path, [*writer(tmp_path, tables), f"reader.baro.file={'*.ulg' if writer is px4 else '*.bin'}"])
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], tables["imu"][name], atol=1e-6, err_msg=name)
    gnss, shift = got.gnss, round(got.gnss.t[0])
    np.testing.assert_allclose(got.imu.t - shift, tables["imu"].t, atol=1e-5)
    np.testing.assert_allclose(gnss.t - shift, tables["gnss"].t, atol=1e-5)
    assert metres(gnss, tables["gnss"]).max() < (1e-3 if writer is px4 else 0.015)
    for name in ("vel_n", "vel_e", "vel_d"):
        np.testing.assert_allclose(gnss[name], tables["gnss"][name], atol=1e-4)
    np.testing.assert_allclose(gnss.std_pos_e, 0.02, rtol=1e-6)
    np.testing.assert_allclose(gnss.std_vel_e, 0.05, rtol=1e-6)
    assert set(gnss.quality) == {4} and set(got.aids["baro"].pressure) == {95_000.0}
    assert got.meta["gps_zero_s"] + shift == pytest.approx(UNIX - 315_964_800 + 18, abs=1e-3)
    assert ingest_drives([got], tmp_path / "out") == 1


@pytest.mark.parametrize("writer", [px4, ardupilot])
def test_an_autopilots_log_by_auto(tmp_path, drive, writer):
    """Pose, clock and barometer found."""
    writer(tmp_path, drive)
    (got,) = AutoReader().read(tmp_path)
    np.testing.assert_allclose(got.imu.accel_z, drive["imu"].accel_z, atol=0.02)
    assert set(got.aids) == {"baro"}


@pytest.mark.parametrize("writer", [px4, ardupilot])
def test_a_damaged_log_is_one_line(tmp_path, tables, writer):
    options = writer(tmp_path, tables)
    (path,) = tmp_path.glob("drive.*")
    whole = path.read_bytes()
    random = np.random.default_rng(1)
    for content in (whole[:60], whole[:200] + random.bytes(500), whole[:8] + random.bytes(3000)):
        path.write_bytes(content)
        with pytest.raises(InputError) as error:
            list(read(tmp_path, options))
        assert "\n" not in str(error.value)


def foxglove(path, tables, *, with_imu: bool = True) -> None:
    """mcap's writer: foxglove.LocationFix and sensor_msgs/Imu as JSON."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic, kind in (("/gps", "foxglove.LocationFix"), ("/imu", "sensor_msgs/msg/Imu")):
            schema = writer.register_schema(kind, "jsonschema", json.dumps({"type": "object"}).encode())
            channels[topic] = writer.register_channel(topic, "json", schema)

        def put(topic: str, ns: int, values: dict) -> None:
            writer.add_message(channels[topic], ns, json.dumps(values).encode(), ns)

        for ns, r in zip(nanoseconds(tables["gnss"].t, UNIX), tables["gnss"].itertuples()):
            stamp = {"sec": int(ns // 10**9), "nsec": int(ns % 10**9)}
            put("/gps", int(ns), {"timestamp": stamp, "frame_id": "gps", "latitude": r.lat_deg, "longitude": r.lon_deg,
                                  "altitude": r.height_m, "position_covariance_type": 2,
                                  "position_covariance": np.diag([0.0004] * 3).ravel().tolist()})  # fmt: skip
        for ns, r in zip(nanoseconds(tables["imu"].t, UNIX), tables["imu"].itertuples()):
            head = {"stamp": {"sec": int(ns // 10**9), "nanosec": int(ns % 10**9)}, "frame_id": "imu"}
            rates, force = (
                {"x": a, "y": -b, "z": -c}
                for a, b, c in ((r.gyro_x, r.gyro_y, r.gyro_z), (r.accel_x, r.accel_y, r.accel_z))
            )
            if with_imu:
                put("/imu", int(ns), {"header": head, "angular_velocity": rates, "linear_acceleration": force})
        writer.finish()


def test_an_mcap_of_foxglove(tmp_path, tables):
    """JSON messages: read as a bag's; one without an IMU says what is in it."""
    foxglove(tmp_path / "drive.mcap", tables)
    (got,) = read(tmp_path, ["reader=rosbag"])
    for name in (*ACCEL, *GYRO):
        np.testing.assert_allclose(got.imu[name], tables["imu"][name], atol=1e-12, err_msg=name)
    assert metres(got.gnss, tables["gnss"]).max() < 1e-6
    np.testing.assert_allclose(got.gnss.std_pos_n, 0.02)
    assert rosbag.holds(tmp_path / "drive.mcap", "imu")
    foxglove(tmp_path / "drive.mcap", tables, with_imu=False)
    with pytest.raises(InputError, match="topic /imu has no messages"):
        read(tmp_path, ["reader=rosbag"])


def test_an_mcap_of_ros_2(tmp_path, tables):
    """rosbags' writer; the file alone, without metadata.yaml."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    from tests.data.logs import bags

    class McapBag(bags._Bag):
        def __init__(self, path, ros2, definitions=None):
            super().__init__(path, ros2, definitions)
            self.writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)

    usual, bags._Bag = bags._Bag, McapBag
    try:
        bags.ros2(tmp_path, tables)
    finally:
        bags._Bag = usual
    (path,) = (tmp_path / "drive").glob("*.mcap")
    path = path.rename(tmp_path / "town.mcap")
    (got,) = read(path, ["reader=rosbag", "reader.gnss.velocity.table=/gnss/vel"])
    np.testing.assert_allclose(got.imu.accel_x, tables["imu"].accel_x, atol=1e-9)
    np.testing.assert_allclose(got.gnss.vel_n, tables["gnss"].vel_n, atol=1e-9)
    assert "imu" in recognise_file(path).offers[0].specs
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match="cannot be read as a bag"):
        read(path, ["reader=rosbag"])


@pytest.mark.parametrize(("modes", "quality"), [("AAN", 1), ("DAN", 2), ("RRN", 4), ("FFA", 5), ("NNN", 0)])
def test_nmea_gns(tmp_path, tables, modes, quality):
    """Receivers of several systems write GNS in the place of GGA; its letters say the mode of each system."""
    from pynmeagps import GET, NMEAMessage

    out = []
    for _, message in sentences(tables):
        if message.msgID == "GGA":
            fix = {"lat": message.lat, "lon": message.lon, "alt": message.alt, "sep": message.sep}
            more = {"time": message.time, "posMode": modes, "numSV": 20, "HDOP": 0.6}
            message = NMEAMessage("GN", "GNS", GET, hpnmeamode=True, **more, **fix)
        out.append(message.serialize())
    (tmp_path / "drive.nmea").write_bytes(b"".join(out))
    imu_table(tmp_path, tables["imu"], UNIX * 1000 + (1000 * tables["imu"]["t"]).round(6))
    (got,) = read(tmp_path, ["reader=nmea", "reader.imu.time.unit=ms"])
    assert set(got.gnss.quality) == {quality} and metres(got.gnss, tables["gnss"]).max() < 1e-3


@pytest.mark.parametrize(("variance", "std"), [(-1.0, np.nan), (0.0, 0.0), (0.25, 0.5)])
def test_a_covariance_that_a_driver_does_not_know_is_unknown(variance, std):
    """A variance of −1 is unknown (sensor_msgs); one of 0 stays, and the table of the fixes takes it for unknown."""
    linear, covariance = SimpleNamespace(x=1.0, y=2.0, z=3.0), np.full(36, variance)
    twist = SimpleNamespace(twist=SimpleNamespace(linear=linear), covariance=covariance)
    of_twist = rosbag.VELOCITIES["geometry_msgs/TwistWithCovarianceStamped"](SimpleNamespace(twist=twist))
    fix = SimpleNamespace(latitude=52.0, longitude=10.0, altitude=80.0, position_covariance_type=1)
    fix.position_covariance = covariance[:9]
    of_fix = rosbag.FIX["sensor_msgs/NavSatFix"](fix)
    np.testing.assert_array_equal([(of_fix | of_twist)[name] for name in STD], [std] * 6)
