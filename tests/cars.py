"""The cars that the tests share: one on an analytic path as files, and segments with noise and biases as a batch.

``car``, ``write_cars``: perfect IMU, exact GNSS and reference, in closed form. ``car_batch``, ``write_segments``: the
truth is what the strapdown makes of a perfect IMU; white noise, a new bias in every segment, GNSS of some centimetres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pymap3d
import torch

from dlkf.data.drive import Batch
from dlkf.data.schema import write_drive, write_drives_table
from dlkf.navigation.attitude import rotation_from_rpy, rpy_from_rotation
from dlkf.navigation.earth import ned_axes, tangent_frame
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown

REAL = Path(__file__).parents[1].parent / "shared" / "data" / "real"
IMU = ImuSpec("test", SensorErrors(2e-3, 0.05, 0.0), SensorErrors(1e-4, 2e-3, 0.0))
FINE = 10  # integration steps per IMU sample
Tables = dict[str, pd.DataFrame]


def car(seconds: float = 60.0, rate: float = 100.0, gnss_hz: float = 1.0, t0: float = 0.0) -> Tables:
    """Speed 10 ± 3 m/s, gentle turns, a plane road; the path of every call is the same."""
    return {name: table.copy() for name, table in _made_once(seconds, rate, gnss_hz, t0).items()}


@cache
def _made_once(seconds: float, rate: float, gnss_hz: float, t0: float) -> Tables:
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
    f_b = (f_n[:, None] @ C_nb)[:, 0]
    w_b = w @ C_nb + np.stack((0 * yaw, 0 * yaw, yaw_rate), -1)

    def means(x: np.ndarray) -> np.ndarray:
        middle = (x[1:] + x[:-1]) / 2
        return middle.reshape(-1, FINE, 3).mean(1)

    r_e = frame.to_ecef(p_t[None])[0].numpy()
    lat, lon, height = pymap3d.ecef2geodetic(*r_e.T)
    C_el = ned_axes(torch.from_numpy(np.radians(lat)), torch.from_numpy(np.radians(lon))).numpy()
    v_l = ((v @ frame.C_en[0].numpy().T)[:, None] @ C_el)[:, 0]
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
    slow = slice(None, None, FINE * round(rate / 10))
    C_lb = C_el[slow].transpose(0, 2, 1) @ frame.C_en[0].numpy() @ C_nb[slow]
    reference[["roll", "pitch", "yaw"]] = rpy_from_rotation(torch.from_numpy(C_lb)).numpy()
    reference["valid"] = True
    return {"imu": imu, "gnss": gnss, "reference": reference}


def car_aids(
    tables: Tables, *, scale: float = 1.0, delay_s: float = 0.0, right_m: float = 0.0, rate: float = 20.0
) -> Tables:
    """A wheel at ``right_m`` of the exact car that turns ``scale`` as fast, stamped ``delay_s`` late, at ``rate``;
    heading and a barometer with an offset of 30 m at a quarter of it."""
    truth, imu = tables["reference"], tables["imu"]
    first, last = truth["t"].iloc[0] + 1, truth["t"].iloc[-1] - 1
    t, slow = np.arange(first, last, 1 / rate) + 0.013, np.arange(first, last, 4 / rate) + 0.007
    north, east = (np.interp(t - delay_s, truth["t"], truth[c]) for c in ("vel_n", "vel_e"))
    turn = np.interp(t - delay_s, imu["t"], imu["gyro_z"])
    return {
        "speed": pd.DataFrame({"t": t, "speed": scale * (np.hypot(north, east) - right_m * turn)}),
        "heading": pd.DataFrame({"t": slow, "heading": np.interp(slow, truth["t"], np.unwrap(truth["yaw"]))}),
        "baro": pd.DataFrame({"t": slow, "height_m": 30 + np.interp(slow, truth["t"], truth["height_m"])}),
    }


def write_cars(
    folder: Path, count: int = 1, groups: int | None = None, aids: dict[str, float] | None = None, **kwargs: float
) -> Path:
    """A dataset of ``count`` such drives in ``groups`` groups, with the sensors of :func:`car_aids` where asked for."""
    rows = []
    for k in range(count):
        meta = {"drive": f"car-{k}", "group": f"day-{k % (groups or count)}"}
        tables = car(**kwargs)
        further = None if aids is None else car_aids(tables, **aids)
        rows.append(write_drive(folder, meta, **tables, aids=further))
    write_drives_table(folder, rows)
    return folder


def car_batch(
    B: int = 4, T: int = 60, M: int = 20, seed: int = 0, dtype: torch.dtype = torch.float64, epoch_s: float = 1.0
) -> Batch:
    """B segments of T epochs: speed and yaw rate vary smoothly, new IMU biases in every segment, cm GNSS.

    For about a minute only is it the motion of a car: the Earth's rotation is not in its angular rates, so it tilts and
    slides sideways, with 0.2 m/s (RMS) after 30 s, 0.8 m/s after 60 s, 3 m/s after 120 s and 8.5 m/s after 200 s.
    """
    g = torch.Generator().manual_seed(seed)

    def draw(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=g, dtype=torch.float64)

    frame = tangent_frame(torch.full((B,), 0.7), torch.full((B,), 0.2), torch.full((B,), 300.0))
    dt = epoch_s / M
    t = torch.arange(T * M, dtype=torch.float64) * dt
    phase = draw(B, 4, 1)
    forward = 1.2 * torch.sin(2 * math.pi * t / 24 + phase[:, 0])
    yaw_rate = 0.12 * torch.sin(2 * math.pi * t / 31 + phase[:, 1]) * torch.sin(2 * math.pi * t / 13 + phase[:, 2])
    speed = 14 + (forward * dt).cumsum(-1)
    yaw = 3 * phase[:, 3, 0]
    zero = torch.zeros_like(forward)
    gravity = frame.gravity(torch.zeros(B, 3, dtype=torch.float64))[:, 2:].expand_as(forward)
    perfect = torch.stack((forward, speed * yaw_rate, -gravity, zero, zero, yaw_rate), -1).unflatten(1, (T, M))
    v0 = 14 * torch.stack((torch.cos(yaw), torch.sin(yaw), 0 * yaw), -1)
    start = NavState(torch.zeros(B, 3).double(), v0, rotation_from_rpy(torch.stack((0 * yaw, 0 * yaw, yaw), -1)))
    states, state = [], start
    for k in range(T):
        state = strapdown(state, perfect[:, k], dt, frame).end
        states.append(NavState(*(x.clone() for x in state)))
    truth = NavState(*(torch.stack(x, 1) for x in zip(*states)))
    bias = torch.tensor([0.05] * 3 + [2e-3] * 3, dtype=torch.float64) * draw(B, 6)
    white = torch.tensor([2e-3] * 3 + [1e-4] * 3, dtype=torch.float64) * math.sqrt(M)
    imu = perfect + bias[:, None, None] + white * draw(B, T, M, 6)
    std = torch.tensor([0.03] * 3 + [0.02] * 3, dtype=torch.float64).expand(B, T, 6)
    law = torch.tensor([1.0] * 3 + [0.1] * 3 + [math.radians(1)] * 2 + [math.radians(10)], dtype=torch.float64)
    yes = torch.ones(B, T, dtype=torch.bool)
    batch = Batch(
        imu=imu, dt=dt, frame=frame,
        gnss=torch.cat((truth.p_n, truth.v_n), -1) + std * draw(B, T, 6), gnss_std=std,
        gnss_valid=yes[..., None].expand(B, T, 6), gnss_lag=torch.zeros(B, T).double(), available=yes,
        lever_arm_b=torch.zeros(B, 3).double(), start=start.correct(-law * draw(B, 9)),
        start_std=law.expand(B, 9), truth=truth, truth_valid=yes, attitude_valid=yes,
        true_imu_error=bias[:, None].expand(B, T, 6), present=yes,
        drive=tuple(f"car-{i:02d}" for i in range(B)), t_start=100.0 * torch.arange(B).double(),
    )  # fmt: skip
    return batch if dtype is torch.float64 else batch.in_precision(dtype)


def write_segments(folder: Path, batch: Batch, kinds: Sequence[str] = ()) -> Path:
    """The segments of a batch as a dataset: IMU at its rate, GNSS and reference at 1 Hz, from t = 100 s on."""
    B, T, M = batch.size
    rows = []
    for i in range(B):
        C_en = batch.frame.C_en[i]
        t = 100.0 + np.arange(1, T * M + 1) * batch.dt
        imu = batch.imu[i].reshape(-1, 6).numpy()
        fixes = 100.0 + np.arange(1, T + 1)

        def placed(p_n: torch.Tensor, v_n: torch.Tensor, i: int = i, C_en: torch.Tensor = C_en) -> dict:
            r_e = batch.frame.to_ecef(p_n.expand(B, *p_n.shape))[i]
            lat, lon, height = geodetic_from_ecef(r_e)
            v = torch.einsum("tji,jk,tk->ti", ned_axes(lat, lon), C_en, v_n)
            return {
                "lat_deg": torch.rad2deg(lat), "lon_deg": torch.rad2deg(lon), "height_m": height,
                "vel_n": v[:, 0], "vel_e": v[:, 1], "vel_d": v[:, 2],
            }  # fmt: skip

        gnss = placed(batch.gnss[i, :, :3], batch.gnss[i, :, 3:])
        std = {f"std_{k}_{a}": np.full(T, s) for k, s in (("pos", 0.03), ("vel", 0.02)) for a in "ned"}
        truth = placed(batch.truth.p_n[i], batch.truth.v_n[i])
        rpy = rpy_from_rotation(batch.truth.C_nb[i])  # within 1.5e-4 rad of local NED over a kilometre
        angles = dict(zip(("roll", "pitch", "yaw"), rpy.T.numpy()))
        named = [f"{s}_{a}" for s in ("accel", "gyro") for a in "xyz"]
        meta = {"drive": batch.drive[i], "group": f"g{i % 3}", "source": "simulated by a test"}
        if kinds:
            meta["kind"] = kinds[i]
        rows.append(
            write_drive(
                folder,
                meta,
                pd.DataFrame({"t": t} | dict(zip(named, imu.T))),
                pd.DataFrame({"t": fixes} | gnss | std | {"quality": np.full(T, 4)}),
                pd.DataFrame({"t": fixes} | truth | angles | {"valid": np.ones(T, bool)}),
            )
        )
    write_drives_table(folder, rows)
    return folder
