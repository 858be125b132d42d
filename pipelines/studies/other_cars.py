"""``plus`` on cars of other people: logs of public repositories as datasets, and the filters on them.

    python -m pipelines.studies.other_cars --logs logs --out outputs/other_cars

Clones the repositories that are missing below ``--logs`` (``<owner>/<name>``), writes each log as a dataset below
``--out``, prints what its axes, signs and clocks are checked by, and scores the filters as
:func:`pipelines.studies.plus.real_cases` does: whole drives from their own alignment, outages of 30 and 60 s from 45 s
and from 300 s on. ``table.md`` has RMS / geometric mean of the horizontal error at the end of the outages [m], and in
brackets the mean NEES over them; ``manifest.json`` the commits and the digests of the datasets. None of the data may
enter the project.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pipelines.studies.ablations.plus_parts import parts
from pipelines.studies.plus import SOURCES, Row, constants, found_noise, load, real_cases, score
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.io import loadmat
from scipy.ndimage import uniform_filter1d

from dlkf.base.errors import InputError
from dlkf.base.provenance import describe_provenance
from dlkf.data.intake import IngestOptions, ingest_drives
from dlkf.data.readers.frames import DriveFrames
from dlkf.data.readers.mapping import spread_stamps
from dlkf.data.schema import ACCEL, ATTITUDE, GYRO, POSITION, STD, VELOCITY
from dlkf.data.store import dataset_digest
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.attitude import rotation_from_rpy

G, DEGREE_M = 9.80665, 111_195.0  # m/s², metres per degree of latitude
FRD, FLU, BRU = np.diag([1, 1, 1]), np.diag([1, -1, -1]), np.diag([-1, 1, -1])  # what turns them to FRD
RFU = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FIXED = ("mbkf33_car any_car", f"mbkf33_car{SOURCES} any_car")
FOUND = f"mbkf21_car{SOURCES}"
BEFORE_S = (45, 300)
OPTICAL_SENSOR = -0.37 - 0.26j  # m forward + i right of the IMU of ``amz``, ± 0.04, by ``find_pose`` on its velocities
LONGEST_GAP_S = 1.5  # between fixes, over which the reference is interpolated


def imu_table(t: np.ndarray, accel: np.ndarray, gyro: np.ndarray, to_frd: np.ndarray) -> pd.DataFrame:
    """Specific force [m/s²] and rate [rad/s] (n, 3) in the sensor's axes, turned to Forward-Right-Down."""
    return pd.DataFrame({"t": t} | dict(zip(ACCEL, to_frd @ accel.T)) | dict(zip(GYRO, to_frd @ gyro.T)))


def level(imu: pd.DataFrame) -> pd.DataFrame:
    """The IMU turned by roll and pitch, so that its mean specific force points up: of a sensor in a holder."""
    x, y, z = imu[list(ACCEL)].mean()
    turn = rotation_from_rpy(torch.tensor([np.arctan2(-y, -z), np.arctan2(x, np.hypot(y, z)), 0.0])).numpy()
    return imu_table(imu["t"].to_numpy(), imu[list(ACCEL)].to_numpy(), imu[list(GYRO)].to_numpy(), turn)


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
    utc = utc // 10000 * 3600 + utc // 100 % 100 * 60 + utc % 100
    clock = np.polyval(np.polyfit(utc, gnss[time] - zero - utc, 1), utc)
    llh = np.stack([gnss["latitude"], gnss["longitude"], height], -1)
    hdop = gnss["hdop"].to_numpy()  # times 1 m, vertically 1.5 m
    known = {"std_pos_n": hdop, "std_pos_e": hdop, "std_pos_d": 1.5 * hdop}
    fixes = fix_table((utc + clock - delay_s).to_numpy(), llh, sentence[6].astype(int).to_numpy(), **known)
    even = np.arange(len(imu)) / 40  # the sensor's clock; samples arrive in bursts
    t = even + uniform_filter1d(imu[time].to_numpy() - zero - even, 401)
    f, w = (imu[[kind + axis for axis in "xyz"]].to_numpy() for kind in (accel, gyro))
    return DriveFrames({"drive": name}, imu_table(t, f, w, FRD), fixes, reference_table(fixes))


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
}


def correlate(drive: DriveFrames) -> dict[str, tuple[float, float]]:
    """Correlation with the reference and slope against it, of seconds in motion: yaw rate against course, acceleration
    forward against speed and to the right against speed times course, each by its change."""
    assert drive.reference is not None
    imu, reference = drive.imu, drive.reference[drive.reference["valid"]]
    t, t_reference = imu["t"].to_numpy(), reference["t"].to_numpy()
    at = np.arange(np.ceil(max(t[0], t_reference[0])), min(t[-1], t_reference[-1]))
    v = np.interp(at, t_reference, reference["vel_n"]) + 1j * np.interp(at, t_reference, reference["vel_e"])
    speed, turn = np.abs(v), np.angle(v[1:] / np.where(v == 0, 1, v)[:-1])
    use = (np.minimum(speed[1:], speed[:-1]) > 3.0) & (np.abs(turn) < 0.8)
    truth = {"gyro_z": turn, "accel_x": np.diff(speed), "accel_y": turn * (speed[1:] + speed[:-1]) / 2}
    found = {}
    for name, expected in truth.items():
        gained = np.diff(np.interp(at, t, np.cumsum(imu[name] * np.diff(t, prepend=t[0]))))[use]
        found[name] = (np.corrcoef(gained, expected[use])[0, 1], np.polyfit(expected[use], gained, 1)[0])
    return found


def convert(name: str, logs: Path, folder: Path) -> list[str]:
    """Write a log as a dataset and return what its axes, signs and clocks are checked by; InputError on doubt."""
    lines, drives = [], list(LOGS[name].read(logs))
    for drive in drives:
        found = correlate(drive)
        down = float(drive.imu["accel_z"].mean())
        shown = "; ".join(f"{axis} r {r:.3f}, slope {slope:.2f}" for axis, (r, slope) in found.items())
        line = f"{name}/{drive.name}: accel_z {down:.2f} m/s² in the mean; {shown}"
        if abs(down + G) >= 0.6 or min(r for r, _ in found.values()) <= 0.7:
            raise InputError(f"axes, signs or clocks are not those of the log that this was written for: {line}")
        lines.append(line)
        drive.meta.update(source=" ".join(LOGS[name].repositories), licence="of the repository")
    ingest_drives(drives, folder, IngestOptions(), overwrite=True)
    return lines


def clone(repository: str, logs: Path) -> None:
    """A repository of GitHub below ``logs``, if it is not there."""
    if not (logs / repository).is_dir():
        url = f"https://github.com/{repository}"
        subprocess.run(["git", "clone", "--depth", "1", url, str(logs / repository)], check=True)


def markdown(rows: Sequence[Row]) -> list[str]:
    """RMS / geometric mean and, in brackets, mean NEES of every filter."""
    names = list(rows[0].errors)
    lines = [f"| log | GNSS [s] | outage [s] | outages | {' | '.join(names)} |", f"|:--|{'--:|' * (3 + len(names))}"]
    for row in rows:
        cells = [f"`{row.name}`", str(row.before_s), str(row.length_s), str(len(row.groups))]
        for name, e in row.errors.items():
            cells.append(f"{mean_error(e, 'rms'):.1f} / {mean_error(e, 'log'):.2f} ({row.nees[name]:.1f})")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Clone, convert, check, score, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--logs", type=Path, default=Path("logs"), help="where the clones lie, or are put")
    arguments.add_argument("--sets", nargs="+", choices=LOGS, default=list(LOGS), help="only these logs")
    arguments.add_argument("--parts", action="store_true", help="and plus without a part")
    arguments.add_argument("--out", type=Path, default=Path("outputs/other_cars"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    digests = {}
    for name in options.sets:
        for repository in LOGS[name].repositories:
            clone(repository, options.logs)
        print("\n".join(convert(name, options.logs, options.out / name)), flush=True)
        drives, digests[name] = load(options.out / name), dataset_digest(options.out / name)
        same = constants()
        filters = {n: same[n] for n in FIXED} | {"plus": trained_filter("plus")} | found_noise(drives, [FOUND])
        filters |= parts("plus") if options.parts else {}
        for before_s in BEFORE_S:
            for case in real_cases(name, drives, before_s, LOGS[name].every_s):
                rows += score(case, filters)
                print(markdown(rows[-1:])[-1], flush=True)
    (options.out / "table.md").write_text("\n".join(markdown(rows)) + "\n")
    made = {**describe_provenance(), "digests": digests}
    (options.out / "manifest.json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
