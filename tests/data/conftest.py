"""A car on an analytic path as tables of the data contract: perfect IMU, exact GNSS and reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d
import pytest
import torch

from dlkf.data.schema import write_drive, write_drives_table
from dlkf.navigation.attitude import rpy_from_rotation
from dlkf.navigation.earth import ned_axes, tangent_frame

REAL = Path(__file__).parents[2].parent / "shared" / "data" / "real"
FINE = 10  # integration steps per IMU sample
Tables = dict[str, pd.DataFrame]


def car(seconds: float = 60.0, rate: float = 100.0, gnss_hz: float = 1.0, t0: float = 0.0) -> Tables:
    """Speed 10 ± 3 m/s, gentle turns, a plane road; the path of every call is the same."""
    dt = 1 / (rate * FINE)
    n = round(seconds * rate) * FINE
    t = np.arange(n + 1) * dt
    yaw = 0.5 + 0.9 * (1 - np.cos(0.3 * t))
    yaw_rate = 0.27 * np.sin(0.3 * t)
    speed, pull = 10 + 3 * np.sin(0.2 * t), 0.6 * np.cos(0.2 * t)
    heading = np.stack((np.cos(yaw), np.sin(yaw), 0 * yaw), -1)
    left = np.stack((-np.sin(yaw), np.cos(yaw), 0 * yaw), -1)
    v = speed[:, None] * heading
    a = pull[:, None] * heading + (speed * yaw_rate)[:, None] * left
    p = np.concatenate((np.zeros((1, 3)), np.cumsum((v[1:] + v[:-1]) / 2 * dt, 0)))
    origin = [torch.tensor([x], dtype=torch.float64) for x in (0.85, 0.15, 200.0)]
    frame = tangent_frame(*origin)
    p_t = torch.from_numpy(p)
    g = frame[torch.zeros(len(p_t), dtype=torch.int64)].gravity(p_t).numpy()
    w = frame.earth_rate_n[0].numpy()
    f_n = a - g + 2 * np.cross(w, v)
    C_nb = np.stack((heading, left, np.broadcast_to([0.0, 0, 1], v.shape)), -1)
    f_b = np.einsum("tji,tj->ti", C_nb, f_n)
    w_b = np.einsum("tji,j->ti", C_nb, w) + np.stack((0 * yaw, 0 * yaw, yaw_rate), -1)

    def means(x: np.ndarray) -> np.ndarray:
        middle = (x[1:] + x[:-1]) / 2
        return middle.reshape(-1, FINE, 3).mean(1)

    r_e = frame.to_ecef(p_t[None])[0].numpy()
    lat, lon, height = pymap3d.ecef2geodetic(*r_e.T)
    C_el = ned_axes(torch.from_numpy(np.radians(lat)), torch.from_numpy(np.radians(lon))).numpy()
    v_l = np.einsum("tji,jk,tk->ti", C_el, frame.C_en[0].numpy(), v)
    imu = pd.DataFrame({"t": t0 + t[FINE::FINE]})
    imu[["gyro_x", "gyro_y", "gyro_z"]] = means(w_b)
    imu[["accel_x", "accel_y", "accel_z"]] = means(f_b)
    state = pd.DataFrame({"t": t0 + t, "lat_deg": lat, "lon_deg": lon, "height_m": height})
    state[["vel_n", "vel_e", "vel_d"]] = v_l
    gnss = state.iloc[:: round(rate * FINE / gnss_hz)].reset_index(drop=True)
    for axis in "ned":
        gnss[f"std_pos_{axis}"], gnss[f"std_vel_{axis}"] = 0.02, 0.05
    gnss["quality"] = 4
    reference = state.iloc[:: FINE * round(rate / 10)].reset_index(drop=True)
    C_lb = np.einsum("tji,jk,tkl->til", C_el, frame.C_en[0].numpy(), C_nb)[:: FINE * round(rate / 10)]
    reference[["roll", "pitch", "yaw"]] = rpy_from_rotation(torch.from_numpy(C_lb)).numpy()
    reference["valid"] = True
    return {"imu": imu, "gnss": gnss, "reference": reference}


def write_cars(folder: Path, count: int = 1, groups: int | None = None, **kwargs: float) -> Path:
    """A dataset of ``count`` such drives in ``groups`` groups."""
    rows = []
    for k in range(count):
        meta = {"drive": f"car-{k}", "group": f"day-{k % (groups or count)}"}
        rows.append(write_drive(folder, meta, **car(**kwargs)))
    write_drives_table(folder, rows)
    return folder


@pytest.fixture(scope="session")
def tables() -> Tables:
    """One minute of the car."""
    return car()


@pytest.fixture(scope="session")
def town(tmp_path_factory) -> Path:
    """Six drives of 60 s in six groups."""
    return write_cars(tmp_path_factory.mktemp("data") / "town", 6)
