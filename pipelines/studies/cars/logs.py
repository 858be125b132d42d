"""Logs of other people's cars: what public repositories hold, as tables of a drive.

A log is read with what is known of its sensors' axes, units and clocks. Of a clone, files of its older commits are read
too. None of the data may enter the project.
"""

from __future__ import annotations

import struct
import subprocess
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.io import loadmat
from scipy.ndimage import uniform_filter1d

from dlkf.data.readers.formats.matlab import variables
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.readers.mapping import spread_stamps
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, POSITION, STD, VELOCITY
from dlkf.navigation.attitude import rotation_from_rpy

G, DEGREE_M = 9.80665, 111_195.0  # m/s², metres per degree of latitude
FRD, FLU, BRU = np.diag([1, 1, 1]), np.diag([1, -1, -1]), np.diag([-1, 1, -1])  # what turns them to FRD
RFU = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
OPTICAL_SENSOR = -0.37 - 0.26j  # m forward + i right of the IMU of ``amz``, ± 0.04, by ``find_pose`` on its velocities
BOSTON_GEOID_M, USABLE_2019_S = -33.8, ((0, 600), (830, 1275))
BEIJING = {  # drive: file and its blob in git, delay of the fixes [s], yaw of the mounting [°]
    "2022-03-03": ("study/eskf156/dataset/data20220303.mat", "d68426c1228d51e8423a9a95610ed7e6d02b964b", 0.03, 0.0),
    "2022-03-20_11": ("study/eskf15/data20220320_11.mat", "2f1cbee3ffb3edf8d8cdc233056731177e25fdd5", 0.0, 2.71),
    "2022-03-20_12": ("study/eskf15/data20220320_12.mat", "2711342ba7fa0a445a88eaa28f46e27d41d99f1e", 0.0, 4.98),
    "2022-03-27": ("study/eskf15/data20220327_rtk1hz_2.mat", "7a71b82d87f3a1e0f0aab39a651a41f07b1b7098", 0.45, -3.16),
    "2022-04-05": ("study/eskf15/data20220405_RTK.mat", "b06d31a4fdbbf337e4fa70bfdb3e2c155d0d10d4", 0.1, -1.31),
    "2022-04-16": ("study/eskf15/data20220416.mat", "f9266a70f9876fa36723a458ece16b3359b5991c", 0.03, 0.0),
    "2022-05-04": ("study/eskf156/dataset/data20220504.mat", "1fc2f7430f3ec6797b19a10a24338d0b2edbf4eb", 0.07, 0.0),
}
WITH_INS = "2022-03-20"  # whose INS solution agrees with fixes and IMU
LONGEST_GAP_S = 1.5  # between fixes, over which the reference is interpolated


def imu_table(t: np.ndarray, accel: np.ndarray, gyro: np.ndarray, to_frd: np.ndarray) -> pd.DataFrame:
    """Specific force [m/s²] and rate [rad/s] (n, 3) in the sensor's axes, turned to Forward-Right-Down."""
    return pd.DataFrame({"t": t} | dict(zip(ACCEL, to_frd @ accel.T)) | dict(zip(GYRO, to_frd @ gyro.T)))


def level(imu: pd.DataFrame) -> pd.DataFrame:
    """The IMU turned by roll and pitch, so that its mean specific force points up: of a sensor in a holder."""
    x, y, z = imu[list(ACCEL)].mean()
    turn = rotation_from_rpy(torch.tensor([np.arctan2(-y, -z), np.arctan2(x, np.hypot(y, z)), 0.0])).numpy()
    return imu_table(imu["t"].to_numpy(), imu[list(ACCEL)].to_numpy(), imu[list(GYRO)].to_numpy(), turn)


def turn_level(imu: pd.DataFrame, yaw: float) -> pd.DataFrame:
    """A level IMU that stands turned by so much [rad], clockwise, in the axes of the car."""
    turn = rotation_from_rpy(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64)).numpy()
    return imu_table(imu["t"].to_numpy(), imu[list(ACCEL)].to_numpy(), imu[list(GYRO)].to_numpy(), turn)


def stored(logs: Path, repository: str, path: str, blob: str) -> Path:
    """A file of a clone, taken from its history where the working tree no longer has it."""
    there, taken = logs / repository / path, logs / "blobs" / f"{blob}{Path(path).suffix}"
    if there.is_file():
        return there
    if not taken.is_file():
        command = ["git", "-C", str(logs / repository), "cat-file", "blob", blob]
        content = subprocess.run(command, check=True, capture_output=True).stdout
        taken.parent.mkdir(exist_ok=True)
        taken.write_bytes(content)
    return taken


def fix_table(t: np.ndarray, llh: np.ndarray, quality: int | np.ndarray = 1, **known: np.ndarray) -> pd.DataFrame:
    """Fixes at ``llh`` (n, 3) [°, °, m] with the other columns that are known."""
    table = pd.DataFrame({"t": t, **dict(zip(POSITION, llh.T))})
    for name in (*VELOCITY, *STD):
        table[name] = known.get(name, np.nan)
    return table.assign(quality=quality)


def reference_table(fixes: pd.DataFrame, attitude: np.ndarray | None = None, every_s: float = 1.0) -> pd.DataFrame:
    """Cubic splines through a fix every so often, and roll, pitch and yaw (n, 3) [rad] beside them, at 10 Hz."""
    kept = fixes.loc[fixes["t"].floordiv(every_s).diff() != 0]
    t, llh, v = (kept[list(names)].to_numpy() for names in (["t"], POSITION, VELOCITY))
    t, p, metres = t[:, 0], (llh - llh[0]) * metres_per(llh), metres_per(llh)
    curve = CubicSpline(t, p) if np.isnan(v).any() else CubicHermiteSpline(t, p, v)
    at = np.arange(np.ceil(10 * t[0]), np.floor(10 * t[-1]) + 1) / 10
    table = pd.DataFrame({"t": at, **dict(zip(POSITION, (llh[0] + curve(at) / metres).T))})
    table[list(VELOCITY)] = curve(at, 1)
    for k, name in enumerate(ATTITUDE):
        known = np.nan if attitude is None else np.interp(at, t, np.unwrap(attitude[kept.index, k]))
        table[name] = np.remainder(known + np.pi, 2 * np.pi) - np.pi
    return table.assign(valid=np.diff(t)[np.clip(np.searchsorted(t, at) - 1, 0, len(t) - 2)] < LONGEST_GAP_S)


def metres_per(llh: np.ndarray) -> np.ndarray:
    """Metres North, East and Down per degree of latitude, of longitude and per metre of height."""
    return np.array([DEGREE_M, DEGREE_M * np.cos(np.radians(llh[0, 0])), -1.0])


def pick_changes(rows: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Rows whose position is not that of the row before."""
    return rows[(rows[list(columns)].diff() != 0).any(axis=1)]


def read_nuance(logs: Path) -> Iterator[DriveFrames]:
    """Two drives with a VN-100 (Forward-Right-Down) and a USB receiver, whose stamps are times of arrival."""
    folder = logs / "freecode23/EECE5554/lab5/data/first_test"
    imu, gnss = pd.read_csv(folder / "town_imu.csv"), pd.read_csv(folder / "town_gps.csv")
    yield _nuance_drive("town", imu, gnss, "stamp", "accel_", "gyro_")
    with zipfile.ZipFile(logs / "aaronpan-eng/EECE5554/lab5/src/data/data_driving.zip") as archive:
        imu, gnss = (pd.read_csv(archive.open(f"data_driving/{name}.csv")) for name in ("imu", "gps"))
    yield _nuance_drive("driving", imu, gnss, "Time", "imu.linear_acceleration.", "imu.angular_velocity.")


def _nuance_drive(
    name: str, imu: pd.DataFrame, gnss: pd.DataFrame, time: str, accel: str, gyro: str, delay_s: float = 0.43
) -> DriveFrames:
    zero, sentence = np.floor(imu[time].iloc[0]), gnss["gpgga_read"].str.split(",", expand=True)
    utc, height = sentence[1].astype(float), sentence[9].astype(float) + sentence[11].astype(float)
    utc = (utc // 10000 * 3600 + utc // 100 % 100 * 60 + utc % 100).to_numpy()
    llh = np.stack([gnss["latitude"], gnss["longitude"], height], -1)
    t_fix = _read_clock(utc, gnss[time].to_numpy() - zero) - delay_s
    fixes = _puck_fixes(t_fix, llh, gnss["hdop"].to_numpy(), sentence[6].astype(int).to_numpy())
    f, w = (imu[[kind + axis for axis in "xyz"]].to_numpy() for kind in (accel, gyro))
    t = _smooth_stamps(imu[time].to_numpy() - zero, 40)
    return DriveFrames({"drive": name}, imu_table(t, f, w, FRD), fixes, reference_table(fixes))


def _read_clock(seconds: np.ndarray, arrived: np.ndarray) -> np.ndarray:
    """A receiver's own seconds on the clock of the computer that its fixes have ``arrived`` at."""
    return seconds + np.polyval(np.polyfit(seconds, arrived - seconds, 1), seconds)


def _smooth_stamps(t: np.ndarray, rate_hz: float) -> np.ndarray:
    """Stamps of samples that arrive in bursts, on the sensor's even clock."""
    even = np.arange(len(t)) / rate_hz
    return even + uniform_filter1d(t - even, 401)


def _puck_fixes(t: np.ndarray, llh: np.ndarray, hdop: np.ndarray, quality: int | np.ndarray = 1) -> pd.DataFrame:
    """Positions with a 1σ of HDOP times 1 m, vertically 1.5 m."""
    return fix_table(t, llh, quality, std_pos_n=hdop, std_pos_e=hdop, std_pos_d=1.5 * hdop)


def read_boston(logs: Path) -> Iterator[DriveFrames]:
    """Two more drives with a VN-100 and a USB receiver: half an hour after one of ``nuance``, and one of 2019, whose
    fixes have stamps of arrival, no HDOP and heights above sea level, and are useless for a time."""
    repository = "freecode23/EECE5554"
    path = "integration_ws/data/town_imu/town_imu.csv"
    imu = pd.read_csv(stored(logs, repository, path, "c57947a03692aadbaccd0228db191deb963760d7"))
    gnss = pd.read_csv(logs / repository / "lab5/data/town/town_gps.csv")
    yield _nuance_drive("town_2024", imu, gnss, "stamp", "accel_", "gyro_")
    folder = logs / "MakiseYuki/EECE5554_Robotic-and-Navigation/lab3/MATLAB files"
    imu, gnss = (loadmat(folder / f"testdrive_{name}.mat")["data"] for name in ("imu", "gps"))
    zero, arrived = np.floor(imu[0, 0]), gnss[:, 0] / 1e6
    seconds = np.round(arrived - np.angle(np.exp(2j * np.pi * arrived).mean()) / (2 * np.pi))
    llh = np.stack([gnss[:, 1], -gnss[:, 2], gnss[:, 3] + BOSTON_GEOID_M], -1)
    t, t_fix = _smooth_stamps(imu[:, 0] - zero, 40), _read_clock(seconds - zero, arrived - zero) - 0.02
    fixes = _puck_fixes(t_fix, llh, np.full(len(t_fix), 1.2))
    table = imu_table(t, imu[:, 7:10], imu[:, 10:13], FRD)
    for number, (first, last) in enumerate(USABLE_2019_S):
        some, seen = (x[x["t"].between(first, last)].reset_index(drop=True) for x in (table, fixes))
        meta = {"drive": f"test_2019_{number}", "group": "test_2019"}
        yield DriveFrames(meta, some, seen, reference_table(seen))


def read_kingston(logs: Path) -> Iterator[DriveFrames]:
    """An HG1700 averaged to 10 Hz (Right-Forward-Up), a receiver with heights above sea level, the SPAN solution."""
    top = logs / "marwanrashed/INSfullMech"
    folder = top / "2008-06-23 kingston downtown/rover/Mat"
    log = loadmat(top / "f_w_IMSseconds_dt_Marwan.mat", squeeze_me=True)
    accel, gyro = (np.stack([log[k][axis].item() for axis in "xyz"], -1).astype(float) for k in "fw")
    zero = np.floor(log["IMU_second"][0])
    imu = imu_table(log["IMU_second"] - zero, accel, gyro, RFU)
    at, speed, ins = (
        loadmat(folder / f"{name}.mat", squeeze_me=True) for name in ("BESTGPSPOS", "BESTGPSVEL", "INSPVA")
    )
    t, i, k = np.intersect1d(at["BGP_second"], speed["BGV_second"], return_indices=True)
    geoid = np.median(np.interp(t, ins["INS_second"], ins["INS_Alt"]) - at["BGP_Alt"][i])
    known = {f"std_pos_{n}": at[f"BGP_{name}_std"][i] for n, name in zip("ned", ("Lat", "Long", "Alt"))}
    known |= {f"vel_{n}": sign * speed[f"BGV_v{name}"][k] for n, name, sign in zip("ned", "neu", (1, 1, -1))}
    llh = np.stack([at["BGP_Lat"], at["BGP_Long"], at["BGP_Alt"] + geoid], -1)[i]
    gnss = fix_table(t - zero, llh, **known)
    llh = np.stack([ins[f"INS_{name}"] for name in ("Lat", "Long", "Alt")], -1)
    known = {f"vel_{n}": sign * ins[f"INS_v{name}"] for n, name, sign in zip("ned", "neu", (1, 1, -1))}
    attitude = np.radians(np.stack([ins[f"INS_{name}"] for name in ("Roll", "Pitch", "Azi")], -1))
    reference = reference_table(fix_table(ins["INS_second"] - zero, llh, **known), attitude)
    yield DriveFrames({"drive": "downtown"}, imu, gnss, reference)


def read_amz(logs: Path, delay_s: float = 0.1) -> Iterator[DriveFrames]:
    """A racing car with an Xsens (Forward-Left-Up) at 200 Hz and positions in single precision, new ones at 5 Hz.

    The reference is the integral of optical speed and yaw rate at the IMU, with what the positions say of its rotation,
    scale and drift (a polynomial of degree 4) and, as a mean over 5 s, of the rest; the antenna's place follows.
    """
    folder = logs / "raghuramshankar/kalman-filter-localization/amz-data-import"
    log = loadmat(folder / "AMZ_data_non_resample.mat", squeeze_me=True)["d"]
    stamps = {name: f"{name.lower()}_time" for name in ("IMU", "GPS", "speed")}
    clocks = [loadmat(folder / f"AMZ_{n}.mat", variable_names=[k])[k].ravel() for n, k in stamps.items()]
    t, t_fix, t_speed = (clock - np.floor(clocks[0][0]) for clock in clocks)
    names = ("a_x", "a_y", "a_z", "wXsens", "wYsens", "wZsens")
    accel, gyro = np.split(np.stack([log[name].item() for name in names], -1), 2, axis=-1)
    imu = imu_table(t, accel, gyro, FLU)
    llh = np.stack([log["lat"].item(), log["long"].item(), 0 * t_fix], -1)
    new = slice(1 + np.bincount(np.flatnonzero(np.diff(llh[:, 0])) % 2).argmax(), None, 2)
    llh, t_fix = llh[new], t_fix[new] - delay_s
    yaw = np.cumsum(imu["gyro_z"] * np.diff(t, prepend=t[0]))
    nose, nose_fix = (np.exp(1j * np.interp(at, t, yaw)) for at in (t_speed, t_fix))
    v = log["lin_v_x"].item() - 1j * log["lin_v_y"].item()
    way = np.interp(t_fix, t_speed, np.cumsum(v * nose * np.diff(t_speed, prepend=t_speed[0])))
    design = np.column_stack([nose_fix, way - OPTICAL_SENSOR * nose_fix, np.vander(t_fix / t_fix[-1] - 0.5, 5)])
    seen = (llh - llh[0]) * metres_per(llh) @ np.array([1, 1j, 0])
    moving = np.abs(np.interp(t_fix, t_speed, v)) > 0.1
    found = np.linalg.lstsq(design[moving], seen[moving], rcond=None)[0]
    path = design[:, 1:] @ found[1:] + uniform_filter1d(seen - design @ found, 25)
    smooth = llh[0] + np.column_stack([path.real, path.imag, 0 * t_fix]) / metres_per(llh)
    arm = found[0] * abs(found[1]) / found[1]
    meta = {"drive": "track", "lever_arm_x_m": arm.real, "lever_arm_y_m": arm.imag}
    known = dict.fromkeys(STD[:3], np.full(len(t_fix), 0.5))  # the step of single precision
    yield DriveFrames(meta, imu, fix_table(t_fix, llh, **known), reference_table(fix_table(t_fix, smooth), every_s=0.1))


def read_beersheva(logs: Path) -> Iterator[DriveFrames]:
    """A BNO055 (Back-Right-Up) at 100 Hz, stamps in 10 ms, acceleration in g without gravity; positions at 10 Hz."""
    log = pd.read_csv(logs / "orshalev91/NavigationSystem/Input/drive3_rt-GPS.csv")
    log.columns = [name.split("[")[0].strip() for name in log.columns]
    log["t"] = 0.01 * (log["t"] - log["t"].iloc[0])
    imu, gnss = log.dropna(subset="ax"), pick_changes(log.dropna(subset="latitude"), ["latitude", "longitude"])
    roll, pitch = imu["roll"], imu["pitch"]
    up = np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], -1)
    accel, gyro = G * (imu[["ax", "ay", "az"]].to_numpy() + up), imu[["gy_x", "gy_y", "gy_z"]].to_numpy()
    gnss = gnss[gnss["t"].diff() != 0]
    llh = np.stack([gnss["latitude"], gnss["longitude"], 0 * gnss["t"]], -1)
    fixes = fix_table(gnss["t"].to_numpy(), llh)
    table = level(imu_table(spread_stamps(imu["t"].to_numpy()), accel, gyro, BRU))
    yield DriveFrames({"drive": "drive3"}, table, fixes, reference_table(fixes))


def read_dresden(logs: Path, delay_s: float = 0.9) -> Iterator[DriveFrames]:
    """A phone-like logger (Forward-Left-Up) that counts acceleration minus specific force, in a loose holder."""
    log = pd.read_csv(logs / "balzer82/Kalman/2014-03-26-000-Data.csv")
    log["t"] = log["millis"] / 1e3 - np.floor(log["millis"].iloc[0] / 1e3)
    accel, gyro = -log[["ax", "ay", "az"]].to_numpy(), np.radians(log[["rollrate", "pitchrate", "yawrate"]].to_numpy())
    log[["speed", "course"]] = log[["speed", "course"]].shift(-1)  # they come a row after their position
    gnss = pick_changes(log, ["latitude", "longitude"]).dropna()
    v = (gnss["speed"] / 3.6 * np.exp(1j * np.radians(gnss["course"]))).to_numpy()
    llh = gnss[["latitude", "longitude", "altitude"]].to_numpy()
    fixes = fix_table(gnss["t"].to_numpy() - delay_s, llh, vel_n=v.real, vel_e=v.imag)
    imu = level(imu_table(log["t"].to_numpy(), accel, gyro, FLU))
    yield DriveFrames({"drive": "2014-03-26"}, imu, fixes, reference_table(fixes))


def read_beijing(logs: Path) -> Iterator[DriveFrames]:
    """Consumer modules (Right-Forward-Up) at 100 Hz on six days, two of them at once on one, and a receiver with
    velocities and 1σ, thinned to 1 Hz. Delays of the fixes by the yaw rate; yaw of the mounting and, of that one day,
    the reference by the solution of an INS in the log."""
    for name, (path, blob, delay_s, yaw_deg) in BEIJING.items():
        log = variables(stored(logs, "yandld/nav_matlab", path, blob))
        gnss, imu = np.asarray(log["gnss_data"]), np.asarray(log["imu_data"])
        if gnss.shape[1] == 15:  # milliseconds, degrees
            gnss[:, 0], imu[:, 0] = gnss[:, 0] / 1e3, imu[:, 0] / 1e3
        else:
            gnss, imu = gnss[:, 1:], imu[:, 1:]
            gnss[:, 3:5] = np.degrees(gnss[:, 3:5])
        imu = _keep_forward(imu[np.isfinite(imu[:, :7]).all(1)])
        gnss = _keep_forward(gnss[gnss[:, 1] <= 2])  # rows of RTK at the same epochs have no velocities
        gnss = gnss[np.diff(np.round(gnss[:, 0] - delay_s, 2) // 1, prepend=-1) != 0]
        zero = np.floor(imu[0, 0])
        columns = ["vel_e", "vel_n", "vel_d", *(f"std_{kind}_{axis}" for kind in ("pos", "vel") for axis in "end")]
        known = dict(zip(columns, (gnss[:, 6:15] * [1, 1, -1, 1, 1, 1, 1, 1, 1]).T))
        fixes = fix_table(gnss[:, 0] - delay_s - zero, gnss[:, 3:6], gnss[:, 1].astype(int), **known)
        reference = reference_table(fixes)
        if name.startswith(WITH_INS):
            reference = reference_table(_read_ins(log["span"], zero), every_s=0.1)
        turned = turn_level(level(imu_table(imu[:, 0] - zero, imu[:, 1:4], imu[:, 4:7], RFU)), np.radians(yaw_deg))
        yield DriveFrames({"drive": name, "group": name[:10]}, turned, fixes, reference)


def _keep_forward(rows: np.ndarray) -> np.ndarray:
    """Rows whose stamp, the first column, is later than all before."""
    return rows[np.diff(np.maximum.accumulate(rows[:, 0]), prepend=-np.inf) > 0]


def _read_ins(span: dict[str, np.ndarray], zero: float) -> pd.DataFrame:
    """The solution of an INS as fixes."""
    rows = np.column_stack([np.ravel(span["time"]), *(np.ravel(span[k]) for k in ("lat", "lon", "alt")), span["vel"]])
    rows = _keep_forward(rows[rows[:, 1] != 0])
    return fix_table(rows[:, 0] - zero, rows[:, 1:4], vel_e=rows[:, 4], vel_n=rows[:, 5], vel_d=-rows[:, 6])


def read_kth(logs: Path) -> Iterator[DriveFrames]:
    """Five minutes with an IMU (Forward-Right-Down), positions at 1 Hz about a place that is not given, HDOP as 1σ."""
    path, blob = "library/nav_lib/loose_gps_imu/dataset1.mat", "b6c0c4d5c7419670c151c4b5360a8e65e8670697"
    log = variables(stored(logs, "yandld/nav_matlab", path, blob))["dataset"]
    gnss, imu, place = log["gnss"], log["imu"], np.array([[59.35, 18.07, 40.0]])
    llh = place + np.asarray(gnss["pos_ned"]).T / metres_per(place)
    horizontal, vertical = np.ravel(gnss["HDOP"]), np.ravel(gnss["VDOP"])
    fixes = fix_table(np.ravel(gnss["time"]), llh, std_pos_n=horizontal, std_pos_e=horizontal, std_pos_d=vertical)
    table = imu_table(np.ravel(imu["time"]), np.asarray(imu["acc"]).T, np.asarray(imu["gyro"]).T, FRD)
    yield DriveFrames({"drive": "kth", "group": "kth"}, table, fixes, reference_table(fixes))


def read_boulder(logs: Path, ahead_s: float = 0.185) -> Iterator[DriveFrames]:
    """A roof with an IMU (Back-Right-Up) at 100 Hz and RTK with velocities at 4 Hz, stamped as they came in: the time
    tags of RTKLIB give the beginning and the end of the IMU's file."""
    folder = logs / "rtklibexplorer/GNSS_IMU/data/drive_0708"
    tag = (folder / "imu_1934.csv.tag").read_bytes()
    (seconds, fraction), last_ms = struct.unpack("<Id", tag[64:76]), np.frombuffer(tag, "<u4", offset=76)[-2]
    rows = np.genfromtxt(folder / "imu_1934.csv", delimiter=",", skip_header=1, skip_footer=1)
    clock = rows[:, 6] - rows[0, 6]
    zero = seconds % 86400
    t = fraction + clock * (1e-3 * last_ms / clock[-1])
    imu = turn_level(level(imu_table(t, G * rows[:, :3], np.radians(rows[:, 3:6]), BRU)), np.radians(5.5))
    gnss = pd.read_csv(folder / "gnss_1934_sf.pos", sep=r"\s+", skiprows=1, header=None)
    t_fix = pd.to_timedelta(gnss[1]).dt.total_seconds().to_numpy() - zero + ahead_s
    columns = {"std_pos": (7, 8, 9), "vel": (15, 16, 17), "std_vel": (18, 19, 20)}
    known = {f"{kind}_{axis}": gnss[k].to_numpy() for kind, places in columns.items() for axis, k in zip("ned", places)}
    quality = gnss[5].astype(int).map({1: 4, 2: 5, 4: 2, 5: 1}).to_numpy()
    fixes = fix_table(t_fix, gnss[[2, 3, 4]].to_numpy(), quality, **known | {"vel_d": -known["vel_d"]})
    meta = {"drive": "boulder", "lever_arm_x_m": 0.0, "lever_arm_y_m": -0.05, "lever_arm_z_m": 0.0}
    yield DriveFrames(meta, imu, fixes, reference_table(fixes, every_s=0.25))


def read_raut(logs: Path, until_s: float = 235.0) -> Iterator[DriveFrames]:
    """Four minutes with a VN-100, of whose samples a sixth is missing, and a USB receiver without heights; later its
    positions are useless."""
    folder = logs / "AkshajRaut/Sensor-Fusion-of-GPS-and-IMU/analysis"
    imu, gnss = (pd.read_csv(folder / f"trip_{name}.csv") for name in ("imu", "gps"))
    zero = imu["seconds"].iloc[0]
    t, t_fix = ((x["seconds"] - zero + 1e-9 * x["nanoseconds"]).to_numpy() for x in (imu, gnss))
    f, w = (imu[[f"{kind}.{axis}" for axis in "xyz"]].to_numpy() for kind in ("Linear", "Angular"))
    llh = np.stack([gnss["Latitude"], gnss["Longitude"], 0 * t_fix], -1)
    fixes = _puck_fixes(t_fix - 0.04, llh, np.full(len(t_fix), 1.5))
    table = turn_level(level(imu_table(t, f, w, FRD)), np.radians(-4.8))
    some, seen = (x[x["t"] < until_s].reset_index(drop=True) for x in (table, fixes))
    yield DriveFrames({"drive": "raut"}, some, seen, reference_table(seen))


@dataclass(frozen=True)
class Log:
    """Where a log is, how it is read, and the seconds between its outages."""

    repositories: tuple[str, ...]
    read: Callable[[Path], Iterator[DriveFrames]]
    every_s: int = 10


LOGS = {
    "nuance": Log(("freecode23/EECE5554", "aaronpan-eng/EECE5554"), read_nuance, 20),
    "kingston": Log(("marwanrashed/INSfullMech",), read_kingston, 30),
    "amz": Log(("raghuramshankar/kalman-filter-localization",), read_amz),
    "beersheva": Log(("orshalev91/NavigationSystem",), read_beersheva),
    "dresden": Log(("balzer82/Kalman",), read_dresden),
    "boston": Log(("freecode23/EECE5554", "MakiseYuki/EECE5554_Robotic-and-Navigation"), read_boston, 20),
    "beijing": Log(("yandld/nav_matlab",), read_beijing, 20),
    "kth": Log(("yandld/nav_matlab",), read_kth),
    "boulder": Log(("rtklibexplorer/GNSS_IMU",), read_boulder),
    "raut": Log(("AkshajRaut/Sensor-Fusion-of-GPS-and-IMU",), read_raut),
}
