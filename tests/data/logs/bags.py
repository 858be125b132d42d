"""ROS 1 and 2 bags by the writers of rosbags."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from tests.cars import Tables
from tests.data.logs.clock import GPS, UNIX, nanoseconds
from tests.data.logs.receivers import sentences


class _Bag:
    """A bag in writing, with the types of a distribution and others by their definitions."""

    def __init__(self, path: Path, ros2: bool, definitions: dict[str, str] | None = None) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros2, self.store = ros2, get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
        for name, text in (definitions or {}).items():
            self.store.register(get_types_from_msg(text, name))
        self.writer = Writer2(path, version=9) if ros2 else Writer1(path)
        self.links: dict[str, Any] = {}

    def __enter__(self) -> _Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, t: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=t // 10**9, nanosec=t % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({} if self.ros2 else {"seq": 0}))

    def xyz(self, x: float, y: float, z: float) -> Any:
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def write(self, topic: str, t: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self.links:
            self.links[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        encode = self.store.serialize_cdr if self.ros2 else self.store.serialize_ros1
        self.writer.write(self.links[topic], t, encode(message, kind))

    def imu(self, tables: Tables, base: int) -> None:
        """sensor_msgs/Imu in Forward-Left-Up, written 5 ms late."""
        unit, none = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0), np.zeros(9)
        for t, row in zip(nanoseconds(tables["imu"]["t"], base), tables["imu"].to_dict("records")):
            f, w = (np.array([1.0, -1, -1]) * [row[f"{s}_{a}"] for a in "xyz"] for s in ("accel", "gyro"))
            fields = {"orientation": unit, "orientation_covariance": none, "angular_velocity": self.xyz(*w)}
            fields |= {"angular_velocity_covariance": none, "linear_acceleration": self.xyz(*f)}
            fields |= {"linear_acceleration_covariance": none, "header": self.header(int(t), "imu")}
            self.write("/imu/data", int(t) + 5_000_000, self.make("sensor_msgs/msg/Imu", **fields))


def _usual_bag(path: Path, tables: Tables, ros2: bool) -> list[str]:
    """Imu, NavSatFix, TwistStamped; in ROS 2 TwistWithCovarianceStamped."""
    with _Bag(path, ros2) as bag:
        bag.imu(tables, GPS)
        for t, row in zip(nanoseconds(tables["gnss"]["t"], GPS), tables["gnss"].to_dict("records")):
            fields = {"header": bag.header(int(t), "gnss"), "position_covariance_type": 2}
            fields["status"] = bag.make("sensor_msgs/msg/NavSatStatus", status=2, service=1)
            fields["position_covariance"] = np.diag([row[f"std_pos_{a}"] ** 2 for a in "end"]).ravel()
            fields |= {"latitude": row["lat_deg"], "longitude": row["lon_deg"], "altitude": row["height_m"]}
            bag.write("/gnss/fix", int(t), bag.make("sensor_msgs/msg/NavSatFix", **fields))
            v = bag.xyz(row["vel_e"], row["vel_n"], -row["vel_d"])
            twist = bag.make("geometry_msgs/msg/Twist", linear=v, angular=bag.xyz(0.0, 0.0, 0.0))
            kind = "TwistStamped"
            if ros2:
                kind, variances = "TwistWithCovarianceStamped", [row[f"std_vel_{a}"] ** 2 for a in "end"]
                covariance = np.diag([*variances, 0.0, 0.0, 0.0]).ravel()
                twist = bag.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance)
            stamped = bag.make(f"geometry_msgs/msg/{kind}", header=bag.header(int(t), "gnss"), twist=twist)
            bag.write("/gnss/vel", int(t), stamped)
    return ["reader=rosbag", "reader.gnss.velocity.table=/gnss/vel", "reader.gnss.quality={default: 4, column: null}"]


def ros1(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 1."""
    return _usual_bag(folder / "drive.bag", tables, ros2=False)


def ros2(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 2."""
    return _usual_bag(folder / "drive", tables, ros2=True)


def ros1_nmea(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 1 with nmea_msgs/Sentence, which came 80 ms late."""
    kind = "nmea_msgs/msg/Sentence"
    with _Bag(folder / "drive.bag", ros2=False, definitions={kind: "std_msgs/Header header\nstring sentence"}) as bag:
        bag.imu(tables, UNIX)
        for seconds, message in sentences(tables):
            t = round((UNIX + seconds) * 1e9) + 80_000_000
            text = message.serialize().decode().strip()
            bag.write("/nmea_sentence", t, bag.make(kind, header=bag.header(t, "gnss"), sentence=text))
    return ["reader=rosbag"]


NAV_PVT = """uint8 CLASS_ID = 1
uint32 {i_tow}
uint16 year
uint8 month
uint8 day
uint8 hour
uint8 min
uint8 sec
uint8 valid
uint8 VALID_DATE = 1
uint32 {t_acc}
int32 nano
uint8 {fix_type}
uint8 FIX_TYPE_3D = 3
uint8 flags
uint8 flags2
uint8 {num_sv}
int32 lon
int32 lat
int32 height
int32 {h_msl}
uint32 {h_acc}
uint32 {v_acc}
int32 {vel_n}
int32 {vel_e}
int32 {vel_d}
int32 {g_speed}
int32 heading
uint32 {s_acc}
uint32 {head_acc}
uint16 {p_dop}
uint8[6] reserved1
int32 {head_veh}
int16 {mag_dec}
uint16 {mag_acc}"""


def _ublox(path: Path, tables: Tables, ros2: bool) -> list[str]:
    """ublox_msgs/NavPVT, which came 80 ms late; fields in snake_case, or as the first versions had them."""
    kind = "ublox_msgs/msg/NavPVT"
    names = {k: k if ros2 else k.title().replace("_", "") for k in re.findall(r"{(\w+)}", NAV_PVT)}
    names = {k: v[0].lower() + v[1:] for k, v in names.items()}
    with _Bag(path, ros2, {kind: NAV_PVT.format(**names)}) as bag:
        bag.imu(tables, UNIX)
        for row in tables["gnss"].to_dict("records"):
            date = np.datetime64(UNIX + int(row["t"]), "s").astype(object)
            fields = dict.fromkeys(re.findall(r"int\d+ (\w+)$", NAV_PVT.format(**names), re.M), 0)
            fields |= {"year": date.year, "month": date.month, "day": date.day, "hour": date.hour, "min": date.minute}
            fields |= {"sec": date.second, "valid": 7, names["fix_type"]: 3, "flags": 1 | 128}
            fields |= {n: round(row[f"{n}_deg"] * 1e7) for n in ("lat", "lon")} | {
                "height": round(1000 * row["height_m"])
            }
            fields |= {names[f"vel_{a}"]: round(1000 * row[f"vel_{a}"]) for a in "ned"}
            fields |= {names["h_acc"]: round(20 * 2**0.5), names["v_acc"]: 20, names["s_acc"]: round(50 * 3**0.5)}
            message = bag.make(kind, reserved1=np.zeros(6, np.uint8), **fields)
            bag.write("/ublox/navpvt", round((UNIX + row["t"]) * 1e9) + 80_000_000, message)
    return ["reader=rosbag"]


def ros1_ublox(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 1."""
    return _ublox(folder / "drive.bag", tables, ros2=False)


def ros2_ublox(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 2."""
    return _ublox(folder / "drive", tables, ros2=True)
