"""A solution as ROS messages: an MCAP that Foxglove and ROS 2 play, or a ROS 1 bag."""

from __future__ import annotations

import shutil
import tempfile
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.data.readers.formats import library

FIX, ODOMETRY = "/dlkf/fix", "/dlkf/odometry"


def write_bag(path: Path, table: pd.DataFrame, when: list[datetime] | None, poses: tuple[Any, Any]) -> None:
    """``sensor_msgs/NavSatFix`` on /dlkf/fix and ``nav_msgs/Odometry`` on /dlkf/odometry, a message a row.

    The fixes are the solution's: the status of all of them is 0, so that maps show an outage too. Odometry is
    East-North-Up from the first row (``poses``: positions (T, 3), rotations (T, 3, 3) of Forward-Left-Up), its twist in
    the car's axes (REP 103, REP 105). Stamps are UTC, or seconds of the drive where no date is known.
    """
    typesys = library("rosbags.typesys", "an export of ROS messages")
    ros2 = path.suffix == ".mcap"
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE if ros2 else typesys.Stores.ROS1_NOETIC)
    encode = store.serialize_cdr if ros2 else store.serialize_ros1
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        target = Path(folder) / ("bag" if ros2 else path.name)
        with _writer(target, ros2) as writer:
            links = {
                topic: writer.add_connection(topic, kind, typestore=store)
                for topic, kind in ((FIX, "sensor_msgs/msg/NavSatFix"), (ODOMETRY, "nav_msgs/msg/Odometry"))
            }
            for k, message_ns in enumerate(_nanoseconds(table, when)):
                for topic, message in _messages(store, table, k, message_ns, poses, ros2).items():
                    writer.write(links[topic], message_ns, encode(message, message.__msgtype__))
        made = next(target.glob("*.mcap")) if ros2 else target
        shutil.move(made, path)


def _writer(target: Path, ros2: bool) -> Any:
    if not ros2:
        return library("rosbags.rosbag1", "a ROS 1 bag").Writer(target)
    bags = library("rosbags.rosbag2", "an MCAP file")
    return bags.Writer(target, version=9, storage_plugin=bags.StoragePlugin.MCAP)


def _nanoseconds(table: pd.DataFrame, when: list[datetime] | None) -> list[int]:
    if when is not None:
        return [round(w.timestamp() * 1e6) * 1000 for w in when]
    return [round(s * 1e9) for s in table["t"] - min(0.0, table["t"].iloc[0])]


def _messages(store: Any, table: pd.DataFrame, k: int, ns: int, poses: tuple[Any, Any], ros2: bool) -> dict[str, Any]:
    """The two messages of a row, with the filter's covariances; −1 where it has none."""
    from scipy.spatial.transform import Rotation

    row, make = table.iloc[k], store.types

    def head(frame: str) -> Any:
        stamp = make["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return make["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **({} if ros2 else {"seq": k}))

    def xyz(kind: str, values: Any) -> Any:
        return make[f"geometry_msgs/msg/{kind}"](**dict(zip("xyz", map(float, values))))

    std = row[["std_pos_e", "std_pos_n", "std_pos_d"]].to_numpy(float)
    known = bool(np.isfinite(std).all())
    fix = make["sensor_msgs/msg/NavSatFix"](
        header=head("imu"),
        status=make["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=float(row.lat_deg),
        longitude=float(row.lon_deg),
        altitude=float(row.height_m),
        position_covariance=np.diag(std**2).ravel() if known else np.zeros(9),
        position_covariance_type=2 if known else 0,
    )
    position, rotation = poses[0][k], poses[1][k]
    turn = make["geometry_msgs/msg/Quaternion"](**dict(zip("xyzw", Rotation.from_matrix(rotation).as_quat().tolist())))
    pose = make["geometry_msgs/msg/Pose"](position=xyz("Point", position), orientation=turn)
    of_pose = np.zeros((6, 6))
    of_pose[:3, :3] = np.diag(std**2) if known else -np.eye(3)
    velocity = rotation.T @ np.array([row.vel_e, row.vel_n, -row.vel_d])
    twist = make["geometry_msgs/msg/Twist"](linear=xyz("Vector3", velocity), angular=xyz("Vector3", (0, 0, 0)))
    odometry = make["nav_msgs/msg/Odometry"](
        header=head("map"),
        child_frame_id="imu",
        pose=make["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=of_pose.ravel()),
        twist=make["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )
    return {FIX: fix, ODOMETRY: odometry}
