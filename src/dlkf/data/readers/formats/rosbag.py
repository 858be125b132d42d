"""ROS 1 and 2 bags by rosbags: IMU, fixes, velocities, NMEA sentences and u-blox messages.

Tables have the contract's columns and ``t_ns``: the header's stamp; of NMEA and u-blox messages the UTC that they
carry; else the bag's. The axes of an IMU are those of its frame; velocities of geometry_msgs are East-North-Up
(REP 103).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlkf.base.errors import InputError, first_line
from dlkf.data.readers.formats import foxglove, library, nmea
from dlkf.data.readers.frames import LogTable
from dlkf.data.readers.qualities import READINGS, ROS
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD, VELOCITY

Row = dict[str, Any]


def read(path: Path, *, kind: str, table: str | None, text: Mapping[str, Any]) -> LogTable:
    """The topic ``table``, or the only one whose type holds what ``kind`` needs; ROS 2: the bag's metadata.yaml."""
    with _open(path) as reader:
        return _read(reader, path, kind, table)


def holds(path: Path, kind: str) -> bool:
    """Whether some topic holds an IMU (``imu``), or fixes (``gnss``)."""
    return any(t in (SENSORS["imu"] if kind == "imu" else (*FIX, SENTENCE)) for t in _topics(path).values())


def list_topics(path: Path) -> str:
    """The topics of a bag and their types."""
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(_topics(path).items())) or "none"


def aids(path: Path) -> tuple[str, ...]:
    """Which further sensors a bag has: speed, where one topic is of the wheels."""
    return ("speed",) if len(_wheel_topics(_topics(path))) == 1 else ()


def _wheel_topics(topics: Mapping[str, str]) -> list[str]:
    """Topics of the wheels: twists and odometries that are called so, and not by GNSS or a filter's output."""
    moving = (t for t, kind in topics.items() if kind in SENSORS["speed"])
    return sorted(t for t in moving if WHEEL.search(t) and not NO_WHEEL.search(t))


def find_velocities(path: Path) -> list[str]:
    """Topics with velocities alone, where the bag's fixes (one topic of NavSatFix) have none."""
    topics = _topics(path)
    topics = {topic: kind for topic, kind in topics.items() if topic not in _wheel_topics(topics)}
    bare = [kind for kind in topics.values() if kind in (*FIX, SENTENCE)] == ["sensor_msgs/NavSatFix"]
    return sorted(topic for topic, kind in topics.items() if kind in VELOCITIES) if bare else []


def _topics(path: Path) -> dict[str, str]:
    with _open(path) as reader:
        return {c.topic: _shorten_type(c.msgtype) for c in reader.connections}


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    highlevel = library("rosbags.highlevel", "a ROS bag")
    typesys = library("rosbags.typesys", "a ROS bag")
    bag = path.parent if path.name == "metadata.yaml" else path
    if path.suffix == ".mcap" and foxglove.is_json(path):
        yield foxglove.JsonBag(path)
        return
    store = typesys.get_typestore(typesys.Stores.LATEST)
    try:
        with highlevel.AnyReader([bag], default_typestore=store) as reader:
            yield reader
    except InputError:
        raise
    except Exception as error:
        # rosbags raises errors of its own, of sqlite, lz4 and struct for damaged bags
        raise InputError(f"{path}: cannot be read as a bag ({first_line(error)}); give a whole one") from None


def _read(reader: Any, path: Path, kind: str, table: str | None) -> LogTable:
    known = [*SENSORS[kind]] if kind in SENSORS else [*FIX, SENTENCE]
    topics = {c.topic: c for c in reader.connections}
    have = ", ".join(f"{name} ({c.msgtype})" for name, c in sorted(topics.items()))
    if table is not None:
        if table not in topics:
            raise InputError(f"{path}: no topic {table}; has {have}; name one of these")
        chosen = [topics[table]]
    else:
        chosen = [c for c in topics.values() if _shorten_type(c.msgtype) in known]
        if kind == "speed":
            wheels = _wheel_topics({topic: _shorten_type(c.msgtype) for topic, c in topics.items()})
            chosen = [topics[topic] for topic in wheels] or chosen
        if len(chosen) != 1:
            what = "no topic" if not chosen else f"{len(chosen)} topics"
            raise InputError(f"{path}: {what} with {', '.join(sorted(known))}; has {have}; set reader.{kind}.table")
    name = _shorten_type(chosen[0].msgtype)
    every = SENSORS.get(kind, {**FIX, **VELOCITIES})
    if name not in (*every, SENTENCE):
        raise InputError(f"{path}: {chosen[0].topic} is {chosen[0].msgtype}; must be {', '.join(every)}")
    messages = ((stamp, reader.deserialize(raw, c.msgtype)) for c, stamp, raw in reader.messages(connections=chosen))
    if name == SENTENCE:
        sentences = nmea.sentences("\n".join(m.sentence.strip() for _, m in messages).encode())
        fixes = nmea.fixes(sentences, f"{path}, {chosen[0].topic}")
        return LogTable(fixes.rename(columns={"utc_ns": "t_ns"}), path, "message")
    rows = []
    for stamp, message in messages:
        header = getattr(message, "header", None)
        own = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
        row = every[name](message)
        rows.append({"t_ns": own or row.pop("utc_ns", None) or stamp, **row})
    if not rows:
        raise InputError(f"{path}: topic {chosen[0].topic} has no messages; give another one")
    frame = pd.DataFrame(rows)
    if kind in ("gnss", "reference"):
        frame = frame.reindex(columns=list(dict.fromkeys((*frame, *POSITION, *VELOCITY, *STD))))
    return LogTable(frame, path, "message")


def _imu(m: Any) -> Row:
    w, f = m.angular_velocity, m.linear_acceleration
    return dict(zip((*GYRO, *ACCEL), (w.x, w.y, w.z, f.x, f.y, f.z)))


def _nav_sat_fix(m: Any) -> Row:
    """Covariance is East-North-Up; status −1 is no fix, 2 corrections of a ground station."""
    row: Row = {"lat_deg": m.latitude, "lon_deg": m.longitude, "height_m": m.altitude}
    if m.position_covariance_type > 0:
        row |= dict(zip(STD[:3], _stds(np.asarray(m.position_covariance)[[4, 0, 8]])))
    row["quality"] = READINGS[ROS].get(int(m.status.status), 1) if hasattr(m, "status") else 1
    return row


def _stds(variances: np.ndarray) -> list[float]:
    """Drivers write -1 for a covariance that they do not know (sensor_msgs)."""
    return np.sqrt(np.where(variances >= 0, variances, np.nan)).tolist()


def _twist(m: Any) -> Row:
    v = _linear(m)
    row: Row = dict(zip(VELOCITY, (v.y, v.x, -v.z)))
    if hasattr(m.twist, "covariance"):
        row |= dict(zip(STD[3:], _stds(np.asarray(m.twist.covariance)[[7, 0, 14]])))
    return row


def _linear(m: Any) -> Any:
    """The velocity of a twist, with a covariance beside it or not."""
    return (m.twist.twist if hasattr(m.twist, "twist") else m.twist).linear


def _forward(m: Any) -> Row:
    """Speed along the x axis of the car's frame (REP 105: child_frame_id), and its 1σ where there is one."""
    variance = float(np.asarray(m.twist.covariance)[0]) if hasattr(m.twist, "covariance") else 0.0
    return {"speed": _linear(m).x, "std": float(np.sqrt(variance)) if variance > 0 else np.nan}


def _nav_pvt(m: Any) -> Row:
    """ublox_msgs/NavPVT: UBX-NAV-PVT in whole numbers, fields as ``h_acc`` or (older) ``hAcc``; 3 is a valid UTC."""
    field = {name.lower().replace("_", ""): getattr(m, name) for name in dir(m) if name[0].islower()}
    h, v, s = field["hacc"] / 1000 / np.sqrt(2), field["vacc"] / 1000, field["sacc"] / 1000 / np.sqrt(3)
    row: Row = {"lat_deg": field["lat"] * 1e-7, "lon_deg": field["lon"] * 1e-7, "height_m": field["height"] / 1000}
    row |= dict(zip(VELOCITY, (field["veln"] / 1000, field["vele"] / 1000, field["veld"] / 1000)))
    flags = int(field["flags"])
    fixed = bool(flags & 1) and int(field["fixtype"]) in (2, 3, 4)
    row["quality"] = {2: 4, 1: 5}.get(flags >> 6, 2 if flags & 2 else 1) if fixed else 0
    if field["valid"] & 3 == 3:
        year, month, day, hour, minute, second = (int(field[k]) for k in ("year", "month", "day", "hour", "min", "sec"))
        date = np.datetime64(f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}", "ns").astype(np.int64)
        row["utc_ns"] = int(date) + second * 10**9 + int(field["nano"])
    return row | dict(zip(STD, (h, h, v, s, s, s)))


def _shorten_type(msgtype: str) -> str:
    return msgtype.replace("/msg/", "/")


WHEEL = re.compile(r"wheel|odom|vehicle|can|chassis|encoder|speed", re.IGNORECASE)
NO_WHEEL = re.compile(r"gnss|gps|fix|ublox|filter|ekf|slam|visual|lidar|imu", re.IGNORECASE)
SENTENCE = "nmea_msgs/Sentence"  # several make a fix
FIX: dict[str, Callable[[Any], Row]] = {
    "sensor_msgs/NavSatFix": _nav_sat_fix,
    "foxglove.LocationFix": _nav_sat_fix,
    "ublox_msgs/NavPVT": _nav_pvt,
    "ublox_msgs/NavPVT7": _nav_pvt,
}
VELOCITIES: dict[str, Callable[[Any], Row]] = {
    "geometry_msgs/TwistStamped": _twist,
    "geometry_msgs/TwistWithCovarianceStamped": _twist,
}
SENSORS: dict[str, dict[str, Callable[[Any], Row]]] = {
    "imu": {"sensor_msgs/Imu": _imu},
    "speed": dict.fromkeys(("nav_msgs/Odometry", *VELOCITIES), _forward),
}
