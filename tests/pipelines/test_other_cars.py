"""Logs of public repositories, written here in their formats from one known drive: axes, signs and clocks of each."""

from __future__ import annotations

import struct
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from pipelines.studies import other_cars
from pipelines.studies.cars import logs as car_logs
from scipy.io import savemat

from dlkf.base.errors import InputError
from dlkf.data.schema import ACCEL, GYRO, POSITION, STD
from dlkf.data.store import load_dataset
from dlkf.navigation.attitude import rotation_from_rpy

BASE_S, END_S, LAT, LON = 152_143.0, 120.0, 44.2, 8.6
T = np.arange(0, END_S, 1e-3)
SPEED, RATE = 9 + 4 * np.sin(2 * np.pi * T / 24), 0.3 * np.sin(2 * np.pi * T / 40)
YAW = np.cumsum(RATE) * 1e-3
WAY = np.cumsum(SPEED * np.exp(1j * YAW)) * 1e-3  # North + i East
FORCE = np.stack([np.pi / 3 * np.cos(2 * np.pi * T / 24), SPEED * RATE, np.full(len(T), -other_cars.G)], -1)
TILT = rotation_from_rpy(torch.tensor([0.03, -0.1, 0.0], dtype=torch.float64)).numpy()  # of a holder


def at(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """What is true at times."""
    return values[np.clip(np.round(1000 * t).astype(int), 0, len(T) - 1)]


def sensed(t: np.ndarray, to_frd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Specific force and rates (3, n) in the axes of a sensor."""
    rates = np.stack([0 * t, 0 * t, at(t, RATE)])
    return to_frd.T @ at(t, FORCE).T, to_frd.T @ rates


def place(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude [°]."""
    metre = 1 / car_logs.DEGREE_M
    return LAT + way.real * metre, LON + way.imag * metre / np.cos(np.radians(LAT))


def write(path: Path, table: pd.DataFrame) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False)


def write_nuance(logs: Path) -> None:
    """Fixes arrive 0.43 s late, on a clock of which their own seconds say nothing."""
    t, seconds = np.arange(0.02, END_S, 0.025), np.arange(1.0, END_S - 1)
    lat, lon = place(at(seconds, WAY))
    stamps = BASE_S + seconds + 0.43 + 0.01 * np.sin(5 * seconds)
    sentences = [
        f"$GPGGA,{int(180000 + k // 60 * 100 + k % 60)}.000,,N,,W,1,09,1.2,16.6,M,-33.8,M,,*55" for k in seconds
    ]
    gnss = {"latitude": lat, "longitude": lon, "hdop": 1.2, "gpgga_read": sentences}
    accel, gyro = sensed(t, np.eye(3))
    town = {f"{kind}_{axis}": x[k] for kind, x in (("accel", accel), ("gyro", gyro)) for k, axis in enumerate("xyz")}
    folder = logs / "freecode23/EECE5554/lab5/data/first_test"
    write(folder / "town_imu.csv", pd.DataFrame({"stamp": BASE_S + t, **town}))
    write(folder / "town_gps.csv", pd.DataFrame({"stamp": stamps, **gnss}))
    long = {"accel": "imu.linear_acceleration", "gyro": "imu.angular_velocity"}
    driving = {f"{long[name[:-2]]}.{name[-1]}": x for name, x in town.items()}
    folder = logs / "aaronpan-eng/EECE5554/lab5/src/data"
    write(folder / "imu.csv", pd.DataFrame({"Time": BASE_S + t + 0.01 * (np.arange(len(t)) % 2), **driving}))
    write(folder / "gps.csv", pd.DataFrame({"Time": stamps, **gnss}))
    with zipfile.ZipFile(folder / "data_driving.zip", "w") as archive:
        for name in ("imu.csv", "gps.csv"):
            archive.write(folder / name, f"data_driving/{name}")


def write_kingston(logs: Path) -> None:
    """Right-Forward-Up at 10 Hz; heights of fixes 34 m above those of the reference."""
    top = logs / "marwanrashed/INSfullMech"
    folder = top / "2008-06-23 kingston downtown/rover/Mat"
    folder.mkdir(parents=True)
    t, seconds = np.arange(0.09, END_S, 0.1), np.arange(1.0, END_S - 1)
    accel, gyro = sensed(t, np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]))
    f, w = (dict(zip("xyz", x)) for x in (accel, gyro))
    savemat(top / "f_w_IMSseconds_dt_Marwan.mat", {"IMU_second": BASE_S + t, "f": f, "w": w})
    (lat, lon), v = place(at(seconds, WAY)), at(seconds, SPEED * np.exp(1j * YAW))
    whole, still = (BASE_S + seconds).astype(int), 0 * seconds
    names = ("Lat", "Long", "Alt")
    position = {f"BGP_{n}": x for n, x in zip(names, (lat, lon, still + 73))}
    position |= {f"BGP_{n}_std": still + 1.5 for n in names}
    velocity = {"BGV_second": whole, "BGV_vn": v.real, "BGV_ve": v.imag, "BGV_vu": still}
    own = {f"INS_{n}": x for n, x in zip(names, (lat, lon, still + 39))}
    own |= {"INS_vn": v.real, "INS_ve": v.imag, "INS_vu": still, "INS_Roll": still, "INS_Pitch": still}
    savemat(folder / "BESTGPSPOS.mat", {"BGP_second": whole, **position})
    savemat(folder / "BESTGPSVEL.mat", velocity)
    savemat(folder / "INSPVA.mat", {"INS_second": whole, "INS_Azi": np.degrees(at(seconds, YAW)) % 360, **own})


ARM = 0.9 + 0.2j  # of the antenna of amz


def write_amz(logs: Path) -> None:
    """Forward-Left-Up at 200 Hz; positions of an antenna, every other one new, 0.1 s late; speed beside the IMU."""
    folder = logs / "raghuramshankar/kalman-filter-localization/amz-data-import"
    folder.mkdir(parents=True)
    t, late, fast = np.arange(0.005, END_S, 0.005), np.arange(0.2, END_S, 0.1), np.arange(0.002, END_S, 0.004)
    accel, gyro = sensed(t, np.diag([1, -1, -1]))
    seen = late[np.maximum(np.arange(len(late)) - 1 + np.arange(len(late)) % 2, 0)] - 0.1
    lat, lon = place(at(seen, WAY + ARM * np.exp(1j * YAW)))
    v = at(fast, SPEED + 1j * RATE * car_logs.OPTICAL_SENSOR)
    log = dict(zip(("a_x", "a_y", "a_z", "wXsens", "wYsens", "wZsens"), (*accel, *gyro)))
    log |= {"lat": lat, "long": lon, "lin_v_x": v.real, "lin_v_y": -v.imag}
    savemat(folder / "AMZ_data_non_resample.mat", {"d": log})
    for name, clock in (("IMU", t), ("GPS", late), ("speed", fast)):
        savemat(folder / f"AMZ_{name}.mat", {f"{name.lower()}_time": BASE_S + clock})


def write_beersheva(logs: Path) -> None:
    """Back-Right-Up in a tilted holder, in g and without gravity; rows of both kinds, fixes at times repeated."""
    t, fixes = np.arange(0, END_S, 0.01), np.arange(0.1, END_S - 0.1, 0.1)
    accel, gyro = sensed(t, TILT @ np.diag([-1, 1, -1]))
    up = (TILT @ np.diag([-1, 1, -1])).T @ [0, 0, -1]
    names = ["ax[m/s^2]", " ay", " az", "gy_x[rad/sec]", "gy_y", "gy_z", "roll[rad]", "pitch[rad]"]
    attitude = [0 * t + np.arctan2(up[1], up[2]), 0 * t - np.arcsin(up[0])]
    imu = pd.DataFrame(dict(zip(names, (*(accel / other_cars.G - up[:, None]), *gyro, *attitude))))
    imu.insert(0, "t[s]", 68734 + np.round(100 * t))
    lat, lon = place(at(fixes, WAY))
    gnss = pd.DataFrame({"t[s]": 68734 + np.round(100 * fixes), "latitude": lat, "longitude": lon})
    both = pd.concat([imu, gnss, gnss[::7]]).sort_values("t[s]", kind="stable")
    write(logs / "orshalev91/NavigationSystem/Input/drive3_rt-GPS.csv", both)


def write_dresden(logs: Path) -> None:
    """Forward-Left-Up in a tilted holder, the other sign of acceleration; fixes 0.9 s late, their speed a row later."""
    t = np.arange(0.02, END_S, 0.02)
    accel, gyro = sensed(t, TILT @ np.diag([1, -1, -1]))
    table = dict(zip(("ax", "ay", "az"), -accel)) | dict(zip(("rollrate", "pitchrate", "yawrate"), np.degrees(gyro)))
    new, later = (np.floor((t - x) * 10 + 1e-6) / 10 - 0.9 for x in (0, 0.02))
    lat, lon = place(at(new, WAY))
    v = at(later, SPEED * np.exp(1j * YAW))
    table |= {"latitude": lat, "longitude": lon, "altitude": 110.0}
    table |= {"speed": 3.6 * np.abs(v), "course": np.degrees(np.angle(v)) % 360, "millis": 1e3 * (BASE_S + t)}
    write(logs / "balzer82/Kalman/2014-03-26-000-Data.csv", pd.DataFrame(table))


def write_boston(logs: Path) -> None:
    """A drive as those of ``nuance`` beside them; one whose fixes are known by the times of their arrival alone."""
    write_nuance(logs)
    top = logs / "freecode23/EECE5554"
    for kind, folder in (("imu", "integration_ws/data/town_imu"), ("gps", "lab5/data/town")):
        (top / folder).mkdir(parents=True)
        (top / f"lab5/data/first_test/town_{kind}.csv").rename(top / folder / f"town_{kind}.csv")
    folder = logs / "MakiseYuki/EECE5554_Robotic-and-Navigation/lab3/MATLAB files"
    folder.mkdir(parents=True)
    t, seconds = np.arange(0.02, END_S, 0.025), np.arange(1.0, END_S - 1)
    lat, lon = place(at(seconds, WAY))
    arrived = 1e6 * (BASE_S + seconds + 0.02 + 0.005 * np.sin(5 * seconds))
    savemat(folder / "testdrive_gps.mat", {"data": np.column_stack([arrived, lat, -lon, 0 * lat + 50.0])})
    imu = np.column_stack([BASE_S + t, np.zeros((len(t), 6)), np.concatenate(sensed(t, np.eye(3))).T])
    savemat(folder / "testdrive_imu.mat", {"data": imu})


def write_beijing(logs: Path) -> None:
    """Right-Forward-Up and turned in the car; rows of RTK beside the fixes; the two layouts of the files."""
    t, half = np.arange(0.01, END_S, 0.01), np.arange(1.0, END_S - 1, 0.5)
    (lat, lon), v = place(at(half, WAY)), at(half, SPEED * np.exp(1j * YAW))
    for k, (path, _, delay_s, yaw_deg) in enumerate(car_logs.BEIJING.values()):
        file = logs / "yandld/nav_matlab" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        imu = np.column_stack([BASE_S + t, *np.concatenate(sensed(t, turned(yaw_deg, car_logs.RFU)))])
        one, up = np.ones(len(half)), 0.2
        sigma = [1.5 * one, 1.4 * one, 2.5 * one, 0.12 * one, 0.11 * one, up * one]
        gnss = np.column_stack(
            [BASE_S + half + delay_s, one, 9 * one, lat, lon, 50 * one, v.imag, v.real, 0 * one, *sigma]
        )
        rtk = gnss * np.where(np.arange(15) == 1, 4, np.where((np.arange(15) > 5) & (np.arange(15) < 9), 7, 1))
        gnss = np.stack([gnss, rtk], 1).reshape(-1, 15)
        ins = {
            "time": BASE_S + half,
            "lat": lat,
            "lon": lon,
            "alt": 50 * one,
            "vel": np.column_stack([v.imag, v.real, 0 * one]),
        }
        if k % 2:
            gnss[:, 0], imu[:, 0] = 1e3 * gnss[:, 0], 1e3 * imu[:, 0]
        else:
            gnss[:, 3:5] = np.radians(gnss[:, 3:5])
            gnss, imu = (np.column_stack([np.zeros(len(x)), x]) for x in (gnss, imu))
        savemat(file, {"gnss_data": gnss, "imu_data": imu, "span": ins})


def write_kth(logs: Path) -> None:
    """Metres from a place of which only the latitude matters."""
    file = logs / "yandld/nav_matlab/library/nav_lib/loose_gps_imu/dataset1.mat"
    file.parent.mkdir(parents=True, exist_ok=True)
    t, seconds = np.arange(0.01, END_S, 0.01), np.arange(1.0, END_S - 1)
    lat, lon = place(at(seconds, WAY))
    from_place = np.stack([lat - 59.35, (lon - 18.07) * np.cos(np.radians(59.35)), 0 * lat]) * car_logs.DEGREE_M
    accel, gyro = sensed(t, np.eye(3))
    gnss = {"pos_ned": from_place, "time": seconds, "HDOP": 0 * lat + 1.2, "VDOP": 0 * lat + 2.0}
    savemat(file, {"dataset": {"gnss": gnss, "imu": {"time": t, "acc": accel, "gyro": gyro}}})


def turned(yaw_deg: float, axes: np.ndarray) -> np.ndarray:
    """What turns a sensor with such axes that stands turned in the car to Forward-Right-Down."""
    return rotation_from_rpy(torch.tensor([0.0, 0.0, np.radians(yaw_deg)], dtype=torch.float64)).numpy() @ axes


def write_boulder(logs: Path) -> None:
    """Back-Right-Up and turned; the first and the last row of the IMU are cut off; fixes are stamped 0.185 s early."""
    folder = logs / "rtklibexplorer/GNSS_IMU/data/drive_0708"
    folder.mkdir(parents=True)
    t, seconds = np.arange(0.01, END_S, 0.01), np.arange(1.0, END_S - 1, 0.25)
    accel, gyro = sensed(t, turned(5.5, car_logs.BRU))
    rows = np.column_stack([*(accel / other_cars.G), *np.degrees(gyro), 5000 + 1e3 * t])
    np.savetxt(folder / "imu_1934.csv", rows[[0, *range(len(t)), 0]], delimiter=",", fmt="%.9f")
    pairs = np.array([[0, 0], [round(1e3 * (t[-1] - t[0])), 4711]], "<u4")
    day = 20_000 * 86400 + int(BASE_S) % 86400
    (folder / "imu_1934.csv.tag").write_bytes(bytes(64) + struct.pack("<Id", day, 0.01) + pairs.tobytes())
    (lat, lon), v, still = place(at(seconds, WAY)), at(seconds, SPEED * np.exp(1j * YAW)), 0 * seconds
    stamps = (pd.Timestamp("2025-07-08") + pd.to_timedelta(BASE_S % 86400 + seconds - 0.185, "s")).strftime(
        "%H:%M:%S.%f"
    )
    columns = [lat, lon, still + 1600, still + 1, still + 20, *[still + 0.01] * 3, *[still] * 5, v.real, v.imag, still]
    columns += [*[still + 0.05] * 3, *[still] * 3]
    lines = [f"2025/07/08 {s} {' '.join(f'{x:.9f}' for x in row)}" for s, row in zip(stamps, zip(*columns))]
    (folder / "gnss_1934_sf.pos").write_text("\n".join(["%  GPST latitude(deg)", *lines]) + "\n")


def write_raut(logs: Path) -> None:
    """Turned in the car; seconds and nanoseconds in two columns, fixes 0.04 s late."""
    folder = logs / "AkshajRaut/Sensor-Fusion-of-GPS-and-IMU/analysis"
    t, seconds = np.arange(0.02, END_S, 0.025), np.arange(1.0, END_S - 1)
    accel, gyro = sensed(t, turned(-4.8, np.eye(3)))
    imu = {f"{kind}.{axis}": x[k] for kind, x in (("Linear", accel), ("Angular", gyro)) for k, axis in enumerate("xyz")}
    lat, lon = place(at(seconds, WAY))
    for name, clock, table in (("imu", t, imu), ("gps", seconds + 0.04, {"Latitude": lat, "Longitude": lon})):
        nanoseconds = np.round(1e9 * (clock % 1)).astype(int)
        stamps = {"seconds": (BASE_S + np.floor(clock)).astype(int), "nanoseconds": nanoseconds}
        write(folder / f"trip_{name}.csv", pd.DataFrame(stamps | table))


WRITERS = {
    "nuance": write_nuance,
    "kingston": write_kingston,
    "amz": write_amz,
    "beersheva": write_beersheva,
    "dresden": write_dresden,
    "boston": write_boston,
    "beijing": write_beijing,
    "kth": write_kth,
    "boulder": write_boulder,
    "raut": write_raut,
}
COUNTS = {"nuance": 2, "boston": 3, "beijing": 3}


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """Of the recording that is cut, two parts within the known drive; of the many the first three."""
    monkeypatch.setattr(car_logs, "BEIJING", dict(list(car_logs.BEIJING.items())[:3]))
    monkeypatch.setattr(car_logs, "USABLE_2019_S", ((0, 60), (60, 120)))


@pytest.mark.parametrize("name", other_cars.LOGS)
def test_axes_signs_and_clocks_of_a_log(name, tmp_path):
    WRITERS[name](tmp_path)
    drives = list(other_cars.LOGS[name].read(tmp_path))
    assert len(drives) == COUNTS.get(name, 1)
    for drive in drives:
        t = drive.imu["t"].to_numpy()
        tilt = (
            0.2 if name in ("beersheva", "dresden", "beijing") else 0.03
        )  # levelled by the mean, which holds some acceleration
        np.testing.assert_allclose(drive.imu[list(ACCEL)], at(t, FORCE), atol=tilt)
        np.testing.assert_allclose(drive.imu["gyro_z"], at(t, RATE), atol=0.005)
        np.testing.assert_allclose(drive.imu[list(GYRO[:2])], 0, atol=0.01)
        antenna = WAY + ARM * np.exp(1j * YAW) if name == "amz" else WAY
        for table, truth, within in ((drive.gnss, antenna, 0.1), (drive.reference, WAY, 0.2)):
            rows = table[(table["t"] > 5) & (table["t"] < END_S - 5)]
            lat, lon = place(at(rows["t"].to_numpy(), truth))
            away = (rows[list(POSITION[:2])].to_numpy() - np.stack([lat, lon], -1)) * car_logs.DEGREE_M
            assert np.abs(away).max() < within, (name, np.abs(away).max())
        rows = drive.reference[(drive.reference["t"] > 5) & (drive.reference["t"] < END_S - 5)]
        v = at(rows["t"].to_numpy(), SPEED * np.exp(1j * YAW))
        np.testing.assert_allclose(rows[["vel_n", "vel_e"]], np.stack([v.real, v.imag], -1), atol=0.3)
        found = other_cars.correlate(drive)
        assert min(r for r, _ in found.values()) > 0.99
        assert all(abs(slope - 1) < 0.05 for _, slope in found.values()), found


def test_what_single_logs_know(tmp_path):
    for name, writer in WRITERS.items():
        writer(tmp_path / name)
    read = {name: list(log.read(tmp_path / name))[-1] for name, log in other_cars.LOGS.items()}
    arm = complex(read["amz"].meta["lever_arm_x_m"], read["amz"].meta["lever_arm_y_m"])
    assert abs(arm - ARM) < 0.05
    assert read["kingston"].gnss["height_m"].mean() == pytest.approx(39)
    yaw = read["kingston"].reference["yaw"].to_numpy()
    turned = at(read["kingston"].reference["t"].to_numpy(), YAW)
    np.testing.assert_allclose(np.exp(1j * yaw), np.exp(1j * turned), atol=0.02)
    assert read["nuance"].gnss["height_m"].mean() == pytest.approx(16.6 - 33.8)
    assert read["nuance"].gnss[list(STD[:3])].mean().tolist() == pytest.approx([1.2, 1.2, 1.8])
    fixes = read["beijing"].gnss
    assert fixes["t"].diff().dropna().to_numpy() == pytest.approx(1.0) and (fixes["quality"] == 1).all()
    assert fixes[[*STD[:2], *STD[3:5]]].mean().tolist() == pytest.approx([1.4, 1.5, 0.11, 0.12])
    assert fixes["vel_n"].abs().max() < 14
    assert read["kth"].gnss[list(STD[:3])].mean().tolist() == pytest.approx([1.2, 1.2, 2.0])
    assert [x.gnss["t"].iloc[0] for x in other_cars.LOGS["boston"].read(tmp_path / "boston")] == pytest.approx(
        [1, 1, 61], abs=0.01
    )
    assert read["dresden"].gnss["vel_n"].notna().all() and read["beersheva"].gnss["vel_n"].isna().all()


@pytest.mark.parametrize("name", other_cars.LOGS)
def test_a_dataset_is_written_and_its_reference_is_found(name, tmp_path):
    WRITERS[name](tmp_path / "logs")
    lines = other_cars.convert(name, tmp_path / "logs", tmp_path / name)
    assert all(line.startswith(f"{name}/") and "slope 1.0" in line for line in lines)
    for drive in load_dataset(tmp_path / name, rate_hz=50.0, dtype=torch.float64):
        assert float(drive.ref_valid.double().mean()) > 0.95


def test_a_file_of_an_older_commit_is_read(tmp_path):
    folder = tmp_path / "someone" / "cars"
    folder.mkdir(parents=True)
    run = partial(subprocess.run, check=True, capture_output=True, cwd=folder, text=True)
    run(["git", "init", "-q"])
    (folder / "log.csv").write_text("t\n1\n")
    blob = run(["git", "hash-object", "-w", "log.csv"]).stdout.strip()
    assert car_logs.stored(tmp_path, "someone/cars", "log.csv", blob) == folder / "log.csv"
    (folder / "log.csv").unlink()
    for _ in range(2):
        found = car_logs.stored(tmp_path, "someone/cars", "log.csv", blob)
        assert found.suffix == ".csv" and found.read_text() == "t\n1\n"


def test_a_turned_sensor_is_refused(tmp_path, monkeypatch):
    write_kingston(tmp_path)
    monkeypatch.setattr(car_logs, "RFU", np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]))
    with pytest.raises(InputError):
        other_cars.convert("kingston", tmp_path, tmp_path / "out")


def test_the_whole_study_on_one_log(tmp_path, monkeypatch, capsys):
    write_kingston(tmp_path / "logs")
    words = ["--logs", str(tmp_path / "logs"), "--sets", "kingston", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["other_cars", *words])
    one = other_cars.constants()["mbkf33_car any_car"]  # which is compiled sooner than the others
    monkeypatch.setattr(other_cars, "constants", lambda: dict.fromkeys(other_cars.FIXED, one))
    monkeypatch.setattr(other_cars, "trained_filter", lambda _: one)
    monkeypatch.setattr(other_cars, "found_noise", lambda *_: {})
    other_cars.main()
    head, _, *rows = (tmp_path / "out" / "table.md").read_text().splitlines()
    assert head.startswith("| log | GNSS [s] | outage [s] | outages | mbkf33_car any_car |")
    cells = [row.split(" | ")[:4] for row in rows[:2]]
    assert cells == [["| `kingston`", "45", "30", "2"], ["| `kingston`", "45", "60", "1"]]
    assert rows[-1] == "| 45 | 3 (1) | 1.00; 1.00 | 1.00; 1.00 | 1.00; 1.00 |"  # the same filter
    assert "digests" in (tmp_path / "out" / "manifest.json").read_text() and rows[0] in capsys.readouterr().out
