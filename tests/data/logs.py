"""One drive written as logs of every format, each by the library of that format where there is one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d

from dlkf.data.readers.units import GPS_EPOCH_UNIX
from tests.cars import Tables

WEEK, TOW = 2350, 345_600.0
GPS = WEEK * 604_800 + int(TOW)
UNIX = GPS + GPS_EPOCH_UNIX - 18
G, DEG = 9.80665, np.pi / 180
AXES = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")


def _ns(t: pd.Series, base: int) -> np.ndarray:
    return base * 10**9 + np.round(t.to_numpy() * 1e9).astype(np.int64)


def _plain_imu(folder: Path, imu: pd.DataFrame, t: np.ndarray | pd.Series) -> None:
    imu.assign(t=t).to_csv(folder / "imu.csv", index=False, float_format="%.12g")


def ubx(folder: Path, tables: Tables) -> list[str]:
    """pyubx2: NAV-PVT, NAV-HPPOSLLH, NAV-COV and ESF-RAW with time tags in ms of a clock of its own."""
    from pyubx2 import GET, UBXMessage

    def word(value: int, kind: int) -> bytes:
        return ((value & 0xFFFFFF) | kind << 24).to_bytes(4, "little")

    imu, gnss = tables["imu"], tables["gnss"]
    steps = {16: ("accel_x", 2.0**-10), 17: ("accel_y", 2.0**-10), 18: ("accel_z", 2.0**-10)}
    steps |= {14: ("gyro_x", DEG * 2**-12), 13: ("gyro_y", DEG * 2**-12), 5: ("gyro_z", DEG * 2**-12)}
    values = {kind: np.round(imu[name] / step).astype(int).to_numpy() for kind, (name, step) in steps.items()}
    out, at = [], 0
    for _, fix in gnss.iterrows():
        while at < len(imu) and imu["t"].iloc[at] <= fix.t - 1e-9:
            tag = (4_000_000_000 + round(1000 * imu["t"].iloc[at])) % 2**32
            words = (word(int(values[kind][at]), kind) + tag.to_bytes(4, "little") for kind in steps)
            out.append(UBXMessage("ESF", "ESF-RAW", GET, payload=bytes(4) + b"".join(words)))
            at += 1
        itow = round(1000 * (TOW + fix.t))
        date = np.datetime64(UNIX + int(fix.t), "s").astype(object)
        common = {"year": date.year, "month": date.month, "day": date.day, "hour": date.hour, "min": date.minute}
        common |= {"second": date.second, "validDate": 1, "validTime": 1, "fixType": 3, "gnssFixOk": 1, "carrSoln": 2}
        speeds = {f"vel{a.upper()}": round(1000 * fix[f"vel_{a}"]) for a in "ned"}
        place = {"lat": round(fix.lat_deg, 7), "lon": round(fix.lon_deg, 7), "height": round(1000 * fix.height_m)}
        out.append(UBXMessage("NAV", "NAV-PVT", GET, iTOW=itow, **common, **speeds, **place, hAcc=20, vAcc=20, sAcc=50))
        rest = {f"_HP{n}": round((fix[f"{n}_deg"] - place[n]) * 1e9) * 1e-9 for n in ("lat", "lon")}
        fine = {**place, **rest}
        out.append(UBXMessage("NAV", "NAV-HPPOSLLH", GET, iTOW=itow, **fine))
        spread = {f"posCov{a}{a}": fix[f"std_pos_{a.lower()}"] ** 2 for a in "NED"}
        spread |= {f"velCov{a}{a}": fix[f"std_vel_{a.lower()}"] ** 2 for a in "NED"}
        out.append(UBXMessage("NAV", "NAV-COV", GET, iTOW=itow, posCovValid=1, velCovValid=1, **spread))
    (folder / "drive.ubx").write_bytes(b"".join(m.serialize() for m in out))
    return ["reader=ubx"]


def nmea(folder: Path, tables: Tables) -> list[str]:
    """pynmeagps: GGA, RMC, GST; the IMU in Unix milliseconds."""
    from pynmeagps import GET, NMEAMessage

    out = []
    for _, fix in tables["gnss"].iterrows():
        date = np.datetime64(UNIX + int(fix.t), "s").astype(object)
        time, day = date.time(), date.date()
        speed, course = np.hypot(fix.vel_n, fix.vel_e) * 3600 / 1852, np.degrees(np.arctan2(fix.vel_e, fix.vel_n)) % 360
        place = {"lat": fix.lat_deg, "lon": fix.lon_deg}
        stds = {"stdLat": fix.std_pos_n, "stdLong": fix.std_pos_e, "stdAlt": fix.std_pos_d}
        extra = {"quality": 4, "numSV": 20, "HDOP": 0.6, "altUnit": "M", "sep": 47.1, "sepUnit": "M"}
        height = round(fix.height_m - 47.1, 3)
        rmc = {"status": "A", "date": day, "spd": round(speed, 4), "cog": round(course, 4)}
        out.append(NMEAMessage("GN", "RMC", GET, hpnmeamode=True, time=time, **rmc, **place))
        out.append(NMEAMessage("GN", "GGA", GET, hpnmeamode=True, time=time, alt=height, **place, **extra))
        out.append(NMEAMessage("GN", "GST", GET, time=time, **stds))
    (folder / "drive.nmea").write_bytes(b"noise\r\n" + b"".join(m.serialize() for m in out))
    _plain_imu(folder, tables["imu"], UNIX * 1000 + (1000 * tables["imu"]["t"]).round(6))
    return ["reader=nmea", "reader.imu.time.unit=ms"]


def _bag(path: Path, tables: Tables, ros2: bool) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    kinds = store.types
    flip = np.array([1.0, -1, -1])

    def header(t: int, frame: str):
        stamp = kinds["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)
        more = {} if ros2 else {"seq": 0}
        return kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    xyz = kinds["geometry_msgs/msg/Vector3"]
    unit = kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    none = np.zeros(9)
    with Writer2(path, version=9) if ros2 else Writer1(path) as writer:
        topics = {"/imu/data": "sensor_msgs/msg/Imu", "/gnss/fix": "sensor_msgs/msg/NavSatFix"}
        topics["/gnss/vel"] = "geometry_msgs/msg/TwistStamped"
        link = {name: writer.add_connection(name, kind, typestore=store) for name, kind in topics.items()}

        def write(name: str, t: int, message) -> None:
            encode = store.serialize_cdr if ros2 else store.serialize_ros1
            writer.write(link[name], t, encode(message, topics[name]))

        for t, row in zip(_ns(tables["imu"]["t"], GPS), tables["imu"].to_dict("records")):
            f, w = (flip * [row[f"{s}_{a}"] for a in "xyz"] for s in ("accel", "gyro"))
            fields = {"orientation": unit, "orientation_covariance": none, "angular_velocity": xyz(*w)}
            fields |= {"angular_velocity_covariance": none, "linear_acceleration": xyz(*f)}
            fields["linear_acceleration_covariance"] = none
            write("/imu/data", int(t) + 5_000_000, kinds["sensor_msgs/msg/Imu"](header=header(int(t), "imu"), **fields))
        for t, row in zip(_ns(tables["gnss"]["t"], GPS), tables["gnss"].to_dict("records")):
            status = kinds["sensor_msgs/msg/NavSatStatus"](status=2, service=1)
            spread = np.diag([row[f"std_pos_{a}"] ** 2 for a in "end"]).ravel()
            place = {"latitude": row["lat_deg"], "longitude": row["lon_deg"], "altitude": row["height_m"]}
            fix = kinds["sensor_msgs/msg/NavSatFix"](
                header=header(int(t), "gnss"),
                status=status,
                **place,
                position_covariance=spread,
                position_covariance_type=2,
            )
            write("/gnss/fix", int(t), fix)
            v = kinds["geometry_msgs/msg/Twist"](xyz(row["vel_e"], row["vel_n"], -row["vel_d"]), xyz(0.0, 0.0, 0.0))
            write("/gnss/vel", int(t), kinds["geometry_msgs/msg/TwistStamped"](header=header(int(t), "gnss"), twist=v))


TOPICS = ["reader=rosbag", "reader.gnss.velocity.table=/gnss/vel", "reader.gnss.quality={default: 4, column: null}"]


def ros1(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 1: Imu in Forward-Left-Up, NavSatFix, TwistStamped."""
    _bag(folder / "drive.bag", tables, ros2=False)
    return TOPICS


def ros2(folder: Path, tables: Tables) -> list[str]:
    """rosbags' writer of ROS 2."""
    _bag(folder / "drive", tables, ros2=True)
    return TOPICS


def _navego(tables: Tables) -> dict[str, dict[str, np.ndarray]]:
    imu, gnss = tables["imu"], tables["gnss"]
    place = {"lat": np.radians(gnss.lat_deg.to_numpy()), "lon": np.radians(gnss.lon_deg.to_numpy())}
    stds = {"stdm": np.array([0.02] * 3), "stdv": np.array([0.05] * 3), "larm": np.zeros(3), "freq": np.array(1.0)}
    return {
        "imu": {"t": imu.t.to_numpy(), "fb": imu[list(AXES[:3])].to_numpy(), "wb": imu[list(AXES[3:])].to_numpy()},
        "gnss": {"t": gnss.t.to_numpy(), **place, "h": gnss.height_m.to_numpy(), **stds}
        | {"vel": gnss[["vel_n", "vel_e", "vel_d"]].to_numpy()},
    }


def navego(folder: Path, tables: Tables) -> list[str]:
    """scipy.io: NaveGo's structures, version 5."""
    import scipy.io

    scipy.io.savemat(folder / "drive.mat", _navego(tables), oned_as="column")
    return ["reader=navego", "reader.gnss.quality.default=4"]


def navego_73(folder: Path, tables: Tables) -> list[str]:
    """h5py: the same as MATLAB's version 7.3 keeps it, matrices transposed."""
    import h5py

    with h5py.File(folder / "drive.mat", "w", userblock_size=512) as file:
        for name, fields in _navego(tables).items():
            for field, value in fields.items():
                file.create_dataset(f"{name}/{field}", data=np.atleast_2d(value) if value.ndim < 2 else value.T)
    with (folder / "drive.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return ["reader=navego", "reader.gnss.quality.default=4"]


def matlab(folder: Path, tables: Tables) -> list[str]:
    """scipy.io: plain matrices."""
    import scipy.io

    imu, gnss = tables["imu"], tables["gnss"]
    names = ["t", "lat_deg", "lon_deg", "height_m", "vel_n", "vel_e", "vel_d", "std_pos_n", "std_vel_n"]
    whole = {"imu_data": imu[["t", *AXES[3:], *AXES[:3]]].to_numpy(), "gps": gnss[names].to_numpy()}
    scipy.io.savemat(folder / "drive.mat", whole)
    own = ["reader.imu.table=imu_data", "reader.gnss.table=gps", "reader.gnss.quality.default=4"]
    return ["reader=matlab", *own, "reader.gnss.std_position.columns=[7]", "reader.gnss.std_velocity.columns=[8]"]


def parquet(folder: Path, tables: Tables) -> list[str]:
    """pandas: Parquet with a time type for the IMU, Feather for GNSS."""
    stamp = pd.to_datetime(_ns(tables["imu"]["t"], UNIX), utc=True)
    tables["imu"].drop(columns="t").assign(stamp=stamp).to_parquet(folder / "imu.parquet")
    tables["gnss"].assign(t=UNIX + tables["gnss"]["t"]).to_feather(folder / "gnss.feather")
    time = ["reader.imu.time={column: stamp, unit: ns, clock: unix}", "reader.gnss.time.clock=unix"]
    return ["reader=parquet", *time, *STDS]


STDS = [
    "reader.gnss.std_position.columns=[std_pos_n, std_pos_e, std_pos_d]",
    "reader.gnss.std_velocity.columns=[std_vel_n, std_vel_e, std_vel_d]",
    "reader.gnss.quality.column=quality",
]


def csv(folder: Path, tables: Tables) -> list[str]:
    """pandas."""
    for kind in ("imu", "gnss"):
        tables[kind].to_csv(folder / f"{kind}.csv", index=False)
    return ["reader=csv", *STDS]


def kitti(folder: Path, tables: Tables) -> list[str]:
    """The layout of KITTI's development kit (dataformat.txt), by hand: nothing writes it any more."""
    imu, state = tables["imu"], tables["fine"]
    (folder / "oxts" / "data").mkdir(parents=True)
    stamps = np.array(_ns(imu["t"], UNIX), "datetime64[ns]").astype(str)
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(s.replace("T", " ") for s in stamps) + "\n")
    flip = np.array([1.0, -1, -1])
    for k, (row, at) in enumerate(zip(imu.to_dict("records"), state.to_dict("records"))):
        f, w = (flip * [row[f"{s}_{a}"] for a in "xyz"] for s in ("accel", "gyro"))
        values = [at["lat_deg"], at["lon_deg"], at["height_m"], 0.0, 0.0, 0.0, at["vel_n"], at["vel_e"], 0.0, 0.0]
        values += [-at["vel_d"], *f, *f, *w, *w, 0.02, 0.05, 4, 10, 4, 4, 0]
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{x:.12g}" for x in values) + "\n")
    return ["reader=kitti", "reader.reference.file=null", "reader.gnss.quality.default=4"]


def kfgins(folder: Path, tables: Tables) -> list[str]:
    """numpy: seconds of week, increments; degrees and stds."""
    imu, gnss = tables["imu"], tables["gnss"]
    values = imu[[*AXES[3:], *AXES[:3]]].to_numpy() * 0.01
    np.savetxt(folder / "IMU.txt", np.column_stack((TOW + imu.t, values)), fmt="%.12g")
    names = ["lat_deg", "lon_deg", "height_m", "std_pos_n", "std_pos_e", "std_pos_d"]
    np.savetxt(folder / "GNSS.txt", np.column_stack((TOW + gnss.t, gnss[names])), fmt="%.12g")
    return ["reader=kfgins"]


def rtklib(folder: Path, tables: Tables) -> list[str]:
    """The layout of RTKLIB 2.4.3's outsol(), by hand."""
    head = "% program   : RTKPOST ver.2.4.3 b34\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single)\n"
    head += (
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)"
    )
    head += "  sdeu(m)  sdun(m) age(s)  ratio    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    "
    head += "sdveu    sdvun\n"
    lines = []
    for t, r in zip(tables["gnss"]["t"], tables["gnss"].to_dict("records")):
        stamp = str(np.datetime64(GPS + GPS_EPOCH_UNIX, "s") + np.timedelta64(round(1000 * t), "ms"))
        lines.append(
            f"{stamp.replace('-', '/').replace('T', ' ')} "
            f"{r['lat_deg']:14.9f} {r['lon_deg']:14.9f} {r['height_m']:10.4f} "
            f"{1:3d} {20:3d} {0.02:8.4f} {0.02:8.4f} {0.02:8.4f} {0:8.4f} {0:8.4f} {0:8.4f} {0.5:6.2f} {99.9:6.1f} "
            f"{r['vel_n']:10.5f} {r['vel_e']:10.5f} {-r['vel_d']:10.5f} {0.05:9.5f} {0.05:8.5f} {0.05:8.5f} 0.0 0.0 0.0"
        )
    (folder / "drive.pos").write_text(head + "\n".join(lines) + "\n")
    imu = tables["imu"].assign(week=WEEK)
    _plain_imu(folder, imu, TOW + imu["t"])
    return ["reader=rtklib", "reader.imu.time.week=week"]


def inertial_explorer(folder: Path, tables: Tables) -> list[str]:
    """An export in the layout of Inertial Explorer 8 (header, names, units), degrees-minutes-seconds, by hand."""
    head = "Project:     town\nProgram:     Inertial Explorer Version 8.90.2428\nDatum:       WGS84\n\n"
    names = "Week GPSTime Latitude Longitude H-Ell VEast VNorth VUp SDEast SDNorth SDHeight VESD VNSD VUSD Q"
    marks = "(weeks) (sec) (+/-D M S) (+/-D M S) (m) (m/s) (m/s) (m/s) (m) (m) (m) (m/s) (m/s) (m/s) (1-6)"

    def dms(x: float) -> str:
        size = abs(x)
        minutes = (size % 1) * 60
        return f"{'-' if x < 0 else ''}{int(size)} {int(minutes):02d} {(minutes % 1) * 60:.7f}"

    lines = [
        f" {WEEK} {TOW + r['t']:.3f} {dms(r['lat_deg'])} {dms(r['lon_deg'])} {r['height_m']:.4f} {r['vel_e']:.5f} "
        f"{r['vel_n']:.5f} {-r['vel_d']:.5f} 0.020 0.020 0.020 0.050 0.050 0.050 1"
        for r in tables["gnss"].to_dict("records")
    ]
    (folder / "drive.txt").write_text(head + names + "\n" + marks + "\n" + "\n".join(lines) + "\n")
    imu = tables["imu"].assign(week=WEEK)
    _plain_imu(folder, imu, TOW + imu["t"])
    own = ["reader.imu.time.week=week", "reader.gnss.std_velocity.columns=[VESD, VNSD, VUSD]"]
    return ["reader=inertial_explorer", *own, "reader.gnss.std_velocity.frame=enu"]


def sensor_logger(folder: Path, tables: Tables) -> list[str]:
    """The columns that Sensor Logger's documentation names, phone's axes as the car's Right-Forward-Up."""
    imu, gnss = tables["imu"], tables["gnss"]
    rfu = {s: imu[[f"{s}_y", f"{s}_x", f"{s}_z"]].to_numpy() * [1, 1, -1] for s in ("accel", "gyro")}
    for name, s in (("TotalAcceleration", "accel"), ("Gyroscope", "gyro")):
        table = {"time": _ns(imu["t"], UNIX), "seconds_elapsed": imu["t"]}
        pd.DataFrame({**table, **dict(zip("zyx", rfu[s].T[::-1]))}).to_csv(folder / f"{name}.csv", index=False)
    place = {"speed": np.hypot(gnss.vel_n, gnss.vel_e), "altitude": gnss.height_m}
    place |= {"bearing": np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360}
    place |= {"longitude": gnss.lon_deg, "latitude": gnss.lat_deg}
    place |= {"horizontalAccuracy": 0.02, "verticalAccuracy": 0.02, "speedAccuracy": 0.05}
    pd.DataFrame({"time": _ns(gnss["t"], UNIX), **place}).to_csv(folder / "Location.csv", index=False)
    axes = ["reader.imu.accel.axes=rfu", "reader.imu.gyro.axes=rfu", "reader.imu.accel.unit=m/s2"]
    axes += ["reader.imu.gyro.unit=rad/s", "reader.gnss.time.offset_s=0", "reader.gnss.quality.default=4"]
    return ["reader=sensor_logger", *axes]


def gnss_logger(folder: Path, tables: Tables) -> list[str]:
    """Lines of Google's GnssLogger 3: UncalAccel, UncalGyro, Fix."""
    lines = [
        "# Version: v3.0.0.1 Platform: 13",
        "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,BiasXMps2",
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,Unix",
    ]
    for r in tables["imu"].to_dict("records"):
        ms = UNIX * 1000 + round(1000 * r["t"])
        for name, s in (("UncalAccel", "accel"), ("UncalGyro", "gyro")):
            values = ",".join(f"{r[f'{s}_{a}']:.9g}" for a in "xyz")
            lines.append(f"{name},{ms},{ms}000000,{values},0.0,0.0,0.0")
    for r in tables["gnss"].to_dict("records"):
        speed, course = np.hypot(r["vel_n"], r["vel_e"]), np.degrees(np.arctan2(r["vel_e"], r["vel_n"])) % 360
        place = f"{r['lat_deg']:.10f},{r['lon_deg']:.10f},{r['height_m']:.4f}"
        lines.append(f"Fix,GPS,{place},{speed:.6f},0.02,{course:.6f},{UNIX * 1000 + round(1000 * r['t'])},0.05,0.1")
    (folder / "gnss_log_drive.txt").write_text("\n".join(lines) + "\n")
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=gnss_logger", *axes, "reader.gnss.quality.default=4"]


def phyphox(folder: Path, tables: Tables) -> list[str]:
    """The columns of phyphox's CSV export; seconds since its start, no stds of velocity."""
    imu, gnss = tables["imu"], tables["gnss"]
    for name, s, unit in (("Acceleration with g", "accel", "m/s^2"), ("Gyroscope", "gyro", "rad/s")):
        table = {f"{a.upper()} ({unit})": imu[f"{s}_{a}"] for a in "xyz"}
        pd.DataFrame({"Time (s)": imu["t"], **table}).to_csv(folder / f"{name}.csv", index=False)
    place = {"Latitude (°)": gnss.lat_deg, "Longitude (°)": gnss.lon_deg, "Height (m)": gnss.height_m}
    place |= {"Velocity (m/s)": np.hypot(gnss.vel_n, gnss.vel_e)}
    place |= {"Direction (°)": np.degrees(np.arctan2(gnss.vel_e, gnss.vel_n)) % 360}
    place |= {"Horizontal Accuracy (m)": 0.02, "Vertical Accuracy (°)": 0.02}
    pd.DataFrame({"Time (s)": gnss["t"], **place}).to_csv(folder / "Location.csv", index=False)
    axes = ["reader.imu.accel.axes=frd", "reader.imu.gyro.axes=frd", "reader.gnss.time.offset_s=0"]
    return ["reader=phyphox", *axes, "reader.gnss.quality.default=4"]


def novatel(folder: Path, tables: Tables) -> list[str]:
    """ASCII logs of the OEM7 manual: RAWIMUSA in counts, BESTPOSA with undulation, BESTVELA."""
    lines, accel, gyro = [], 2.0**-26, 2.0**-30
    for r in tables["imu"].to_dict("records"):
        tow = TOW + r["t"]
        f, w = ([round(0.01 * r[f"{s}_{a}"] / c) for a in "xyz"] for s, c in (("accel", accel), ("gyro", gyro)))
        counts = f"{f[2]},{-f[1]},{f[0]},{w[2]},{-w[1]},{w[0]}"
        lines.append(f"%RAWIMUSA,{WEEK},{tow:.3f};{WEEK},{tow:.9f},00000077,{counts}*1234abcd")
    for r in tables["gnss"].to_dict("records"):
        tow = f"{TOW + r['t']:.3f}"
        speed, course = np.hypot(r["vel_n"], r["vel_e"]), np.degrees(np.arctan2(r["vel_e"], r["vel_n"])) % 360
        head = f"COM1,0,60.5,FINESTEERING,{WEEK},{tow},02000000,cdba,16809"
        place = f"{r['lat_deg']:.11f},{r['lon_deg']:.11f},{r['height_m'] - 47.1:.4f},47.1000,WGS84,0.02,0.02,0.02"
        lines.append(f'#BESTPOSA,{head};SOL_COMPUTED,NARROW_INT,{place},"",0,0,20,20,20,20,00,06,39,33*1234abcd')
        speeds = f"{speed:.6f},{course:.6f},{-r['vel_d']:.6f}"
        lines.append(f"#BESTVELA,{head};SOL_COMPUTED,NARROW_INT,0.0,0.0,{speeds},0.0*1234abcd")
    (folder / "drive.asc").write_text("\n".join(lines) + "\n")
    return ["reader=novatel", f"reader.imu.accel.unit={accel!r}", f"reader.imu.gyro.unit={gyro!r}"]


WRITERS: tuple[Callable[[Path, Tables], list[str]], ...] = (
    *(csv, parquet, ubx, nmea, ros1, ros2, navego, navego_73, matlab, kitti, kfgins, rtklib, inertial_explorer),
    *(sensor_logger, gnss_logger, phyphox, novatel),
)


def metres(a: pd.DataFrame, b: pd.DataFrame) -> np.ndarray:
    """Distance [m] between the positions of two tables."""
    ecef = [np.stack(pymap3d.geodetic2ecef(*(t[c] for c in ("lat_deg", "lon_deg", "height_m"))), -1) for t in (a, b)]
    return np.linalg.norm(ecef[0] - ecef[1], axis=-1)
