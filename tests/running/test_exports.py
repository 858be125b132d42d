"""Every export is read back by the library or program of its format and holds the solution."""

from __future__ import annotations

import json
import struct
from datetime import UTC, datetime, timedelta
from xml.etree import ElementTree

import gpxpy
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pymap3d
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from pynmeagps import NMEAReader
from scipy.spatial.transform import Rotation

from dlkf.base.errors import InputError
from dlkf.data.readers.units import GPS_EPOCH_UNIX
from dlkf.data.tables import DriveClock
from dlkf.running.exports import FORMATS, choose_formats, export, find_row_qualities, poses, utc_times
from dlkf.running.solution import COLUMNS, SCHEMA, write_solution

KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"
MONDAY = datetime(2025, 7, 7, 12, 0, 0, tzinfo=UTC).timestamp()


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """A minute on a circle west of Greenwich and south of the equator, climbing, with an outage in the middle."""
    t = np.arange(1.0, 61.0)
    angle = 0.05 * t
    east, north = 200 * np.sin(angle), 200 - 200 * np.cos(angle)
    lat, lon, height = pymap3d.enu2geodetic(east, north, 0.1 * t, -33.9, -0.0005, 40.0)
    found = dict.fromkeys(COLUMNS, np.full(60, np.nan)) | {"t": t, "lat_deg": lat, "lon_deg": lon, "height_m": height}
    found |= {"vel_n": 10 * np.sin(angle), "vel_e": 10 * np.cos(angle), "vel_d": np.full(60, -0.1)}
    found |= {"roll": np.full(60, 0.02), "pitch": np.full(60, 0.01), "yaw": np.pi / 2 - angle}
    found |= {f"std_pos_{a}": np.full(60, 0.5) for a in "ned"}
    return pd.DataFrame(found | {"gnss_used": (t < 20) | (t > 40)})


@pytest.fixture(scope="module")
def folder(table, tmp_path_factory):
    """All formats, with a known date."""
    out = tmp_path_factory.mktemp("exports")
    when, fixes = utc_times(table, DriveClock(MONDAY), "unix"), table["t"].to_numpy() - 0.2
    quality = find_row_qualities(table, fixes, np.where(fixes < 10, 1, np.where(fixes < 45, 5, 4)))
    export(out, table, choose_formats("all"), when, "town & country", quality)
    return out


def test_geojson(folder, table):
    content = json.loads((folder / "solution.geojson").read_text())
    line, *points = content["features"]
    assert line["geometry"]["type"] == "LineString" and line["properties"]["name"] == "town & country"
    wanted = table[["lon_deg", "lat_deg", "height_m"]].to_numpy()
    assert np.allclose(line["geometry"]["coordinates"], wanted, atol=5e-4)  # a millimetre of height, less in degrees
    assert len(points) == 60 and points[0]["properties"]["time"] == "2025-07-07T12:00:01Z"
    assert points[30]["properties"]["std_horizontal_m"] == pytest.approx(0.7071, abs=1e-4)


def test_gpx(folder, table):
    track = gpxpy.parse((folder / "solution.gpx").read_text()).tracks[0]
    assert track.name == "town & country" and track.get_points_no() == 60
    point = track.segments[0].points[9]
    assert point.time == datetime(2025, 7, 7, 12, 0, 10, tzinfo=UTC)
    assert (point.latitude, point.longitude) == pytest.approx((table.lat_deg[9], table.lon_deg[9]), abs=1e-9)
    assert track.length_2d() == pytest.approx(10 * 59, rel=0.01)


def test_kml(folder, table):
    """A gx:Track as its schema has it: all <when> before all <gx:coord>, as many as rows, in UTC."""
    root = ElementTree.parse(folder / "solution.kml").getroot()
    (track,) = root.iter(f"{GX}Track")
    kinds = [child.tag for child in track if child.tag in (f"{KML}when", f"{GX}coord")]
    assert kinds == [f"{KML}when"] * 60 + [f"{GX}coord"] * 60
    when = [datetime.fromisoformat(child.text) for child in track.iter(f"{KML}when")]
    assert when == utc_times(table, DriveClock(MONDAY), "unix") and when[0].utcoffset() == timedelta(0)
    found = np.array([[float(x) for x in child.text.split()] for child in track.iter(f"{GX}coord")])
    assert np.allclose(found, table[["lon_deg", "lat_deg", "height_m"]], rtol=0, atol=1e-9)
    assert [name.text for name in root.iter(f"{KML}name")].count("town & country") == 2


def test_tenths_of_a_second_are_kept_in_dated_tracks(table, tmp_path):
    """Rows every 0.1 s, across midnight."""
    fast = table.assign(t=0.1 * np.arange(60))
    when = utc_times(fast, DriveClock(datetime(2025, 7, 6, 23, 59, 57, tzinfo=UTC).timestamp()), "unix")
    export(tmp_path, fast, ["kml", "gpx"], when, "town", np.ones(60, int))
    points = gpxpy.parse((tmp_path / "solution.gpx").read_text()).tracks[0].segments[0].points
    assert [p.time for p in points] == when
    stamps = ElementTree.parse(tmp_path / "solution.kml").getroot().iter(f"{KML}when")
    assert [datetime.fromisoformat(s.text) for s in stamps] == when
    assert when[-1].isoformat() == "2025-07-07T00:00:02.900000+00:00"


def test_nmea(folder, table):
    with (folder / "solution.nmea").open("rb") as file:
        read = [message for _, message in NMEAReader(file)]
    assert [m.msgID for m in read[:3]] == ["GGA", "RMC", "GST"] and len(read) == 180
    gga, rmc, gst = read[:3]
    # minutes have seven digits: 0.2 mm; the library gives degrees to 1e-10
    assert (gga.lat, gga.lon) == pytest.approx((table.lat_deg[0], table.lon_deg[0]), abs=3e-9)
    assert gga.alt == pytest.approx(table.height_m[0], abs=1e-3) and rmc.posMode == "A"
    assert [m.quality for m in read[::3]] == [1] * 10 + [5] * 9 + [6] * 21 + [5] * 5 + [4] * 15
    assert str(rmc.date) == "2025-07-07" and rmc.spd == pytest.approx(10 / (1852 / 3600), abs=1e-3)
    assert gst.stdLat == 0.5


def test_pos(folder, table):
    names = ["week", "tow", "lat", "lon", "height", "Q"]
    rows = pd.read_csv(folder / "solution.pos", comment="%", sep=r"\s+", header=None)
    rows.columns = names + list(rows.columns[6:])
    assert (rows.lat - table.lat_deg).abs().max() < 1e-9 and (rows.height - table.height_m).abs().max() < 1e-4
    # 7 July 2025 is the Monday of GPS week 2374; GPS time was 18 s ahead of UTC
    assert rows.week[0] == 2374 and rows.tow[0] == pytest.approx(86400 + 12 * 3600 + 1 + 18)
    assert list(rows.Q) == [5] * 10 + [2] * 9 + [7] * 21 + [2] * 5 + [1] * 15  # RTKLIB counts otherwise than NMEA


def test_nmea_has_milliseconds(table, tmp_path):
    late = table.assign(t=table["t"] + 0.9991)
    export(tmp_path, late, ["nmea"], None, "town", np.ones(60, int))
    assert [x.split(",")[1] for x in (tmp_path / "solution.nmea").open()][:4] == ["000001.999"] * 3 + ["000002.999"]


def test_trajectories_for_evo(folder, table):
    tum = file_interface.read_tum_trajectory_file(str(folder / "solution.tum"))
    kitti = file_interface.read_kitti_poses_file(str(folder / "solution.kitti"))
    position, rotation = poses(table)
    assert np.allclose(tum.positions_xyz, position, atol=1e-5) and tum.check()[0] and kitti.check()[0]
    assert tum.path_length == pytest.approx(590, rel=0.01)
    one, other = sync.associate_trajectories(tum, tum)
    error = metrics.APE(metrics.PoseRelation.full_transformation)
    error.process_data((one, other))
    assert error.get_statistic(metrics.StatisticsType.rmse) < 1e-9  # the file against itself: rounding of evo
    assert np.allclose([p[:3, :3] for p in kitti.poses_se3], rotation, atol=1e-8)
    # the nose (first column) points along the motion, the third axis up
    along = np.diff(position, axis=0) / np.linalg.norm(np.diff(position, axis=0), axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", along, rotation[:-1, :, 0]) > 0.99).all() and (rotation[:, 2, 2] > 0.99).all()
    w, x, y, z = tum.orientations_quat_wxyz[5]
    assert np.allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), rotation[5], atol=1e-8)


def test_mcap(folder, table):
    """By mcap's own decoder of ROS 2; the way, the heading and the speed along the car are the solution's."""
    from mcap_ros2.reader import read_ros2_messages

    read = list(read_ros2_messages(folder / "solution.mcap"))
    fixes = [m.ros_msg for m in read if m.channel.topic == "/dlkf/fix"]
    odometry = [m.ros_msg for m in read if m.channel.topic == "/dlkf/odometry"]
    assert len(fixes) == len(odometry) == 60
    np.testing.assert_allclose([f.latitude for f in fixes], table.lat_deg, atol=0)
    np.testing.assert_allclose([f.altitude for f in fixes], table.height_m, atol=0)
    assert fixes[9].position_covariance[0] == pytest.approx(0.25) and fixes[9].position_covariance_type == 2
    stamp = fixes[9].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(MONDAY + 10, abs=1e-6)
    position, rotation = poses(table)
    place = [[getattr(o.pose.pose.position, a) for a in "xyz"] for o in odometry]
    np.testing.assert_allclose(place, position, atol=1e-9)
    turn = [[getattr(o.pose.pose.orientation, a) for a in "xyzw"] for o in odometry]
    np.testing.assert_allclose(Rotation.from_quat(turn).as_matrix(), rotation, atol=1e-9)
    # the car looks along its way, but for 0.01 and 0.02 rad of pitch and roll
    np.testing.assert_allclose([o.twist.twist.linear.x for o in odometry], 10.0, atol=0.01)


def test_ros1_bag(folder, table):
    from rosbags.highlevel import AnyReader

    with AnyReader([folder / "solution.bag"]) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        count = sum(1 for _ in reader.messages())
    assert kinds == {"/dlkf/fix": "sensor_msgs/msg/NavSatFix", "/dlkf/odometry": "nav_msgs/msg/Odometry"}
    assert count == 120


def test_csv(folder, table):
    rows = pd.read_csv(folder / "solution.csv")
    assert list(rows) == ["utc", *table] and rows.utc[0] == "2025-07-07T12:00:01Z"
    assert np.allclose(rows[["lat_deg", "yaw"]], table[["lat_deg", "yaw"]], atol=1e-9)
    assert rows.accel_error_x.isna().all()


def test_geoparquet(table, tmp_path):
    write_solution(tmp_path / "solution.parquet", table)
    schema = pq.read_schema(tmp_path / "solution.parquet")
    assert schema.names == [*SCHEMA.names, "geometry"]
    geo = json.loads(schema.metadata[b"geo"])
    assert geo["version"] == "1.1.0" and geo["columns"][geo["primary_column"]]["encoding"] == "WKB"
    first = pq.read_table(tmp_path / "solution.parquet")["geometry"][0].as_py()
    assert struct.unpack("<BI3d", first) == (1, 1001, table.lon_deg[0], table.lat_deg[0], table.height_m[0])


def test_without_a_date(table, tmp_path):
    """Tracks have no times; what cannot do without counts from the start of GPS time."""
    dated = DriveClock(MONDAY)
    for clock, counts in ((None, "auto"), (DriveClock(), "gps"), (DriveClock(0.0), "auto"), (dated, "none")):
        assert utc_times(table, clock, counts) is None
    export(tmp_path, table, list(FORMATS), None, "town", np.ones(60, int))
    assert gpxpy.parse((tmp_path / "solution.gpx").read_text()).tracks[0].segments[0].points[0].time is None
    assert "<LineString" in (tmp_path / "solution.kml").read_text()
    assert (tmp_path / "solution.pos").read_text().splitlines()[3].split()[:2] == ["0", "1.000"]


def test_gps_seconds_are_told_from_unix_seconds(table):
    gps, unix = DriveClock(MONDAY - GPS_EPOCH_UNIX + 18), DriveClock(MONDAY)
    assert utc_times(table, gps) == utc_times(table, unix) == utc_times(table, gps, "gps")


def test_the_receivers_date_is_believed_before_that_of_the_files(table):
    """An IMU whose computer thinks it is 2024, 1000 ppm fast: the receiver, unless one asks for the files' clock."""
    clock = DriveClock(MONDAY - 366 * 86_400, MONDAY - GPS_EPOCH_UNIX + 18, 1 / 1.001)
    when = utc_times(table, clock)
    assert when is not None
    late = [(w - datetime(2025, 7, 7, 12, tzinfo=UTC)).total_seconds() for w in when]
    np.testing.assert_allclose(late, table["t"] / 1.001, atol=1e-6)  # a microsecond is what a date holds
    assert utc_times(table, clock, "unix") == utc_times(table, DriveClock(clock.file_s))


def test_mistakes():
    with pytest.raises(InputError, match="known: geojson, kml"):
        choose_formats(["kml", "shp"])
    with pytest.raises(InputError, match="export_clock"):
        utc_times(pd.DataFrame({"t": [0.0]}), DriveClock(0.0), "tai")
