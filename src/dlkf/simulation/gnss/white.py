"""A GNSS receiver's position and velocity at the antenna, with white noise of known size: no satellites."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.earth import EARTH_RATE
from dlkf.simulation.gnss.receiver import QUALITIES
from dlkf.simulation.gnss.surroundings import Sky
from dlkf.simulation.imu import gauss_markov
from dlkf.simulation.motion.vehicle import Truth, radii_of_curvature
from dlkf.simulation.tables import fix_columns

FLOAT = 5  # NMEA GGA code: RTK with open ambiguities
AXES = np.array((1.0, 1.0, 1.5))  # of errors that last, north, east, down


@dataclass(frozen=True)
class GnssConfig(Ranged, where="gnss"):
    """One receiver: fix rate, 1σ per axis, and the scale factors s_p, s_v of added noise (paper eqs 12, 13).

    Std of a fix is √(σ² + s²), and is what the fix claims. ``quality`` is an NMEA GGA code;
    ``lever_arm_b`` runs from the IMU to the antenna in body axes [m].

    What receivers do besides, nothing by default: position and velocity are ``position_lag_s`` and
    ``velocity_lag_s`` older than their stamp; claimed stds are ``std_factor`` times the true ones; fixes are missing
    for ``dropout_share`` of the time, ``dropout_s`` at a time. Without satellites only, as with them it comes of the
    receiver: ``wander`` [m], 1σ per horizontal axis and half as much again vertically, Gauss-Markov with a time
    constant of ``wander_s`` (multipath), which the claimed std includes; and for ``float_share`` of the time,
    ``float_s`` at a time, carrier ambiguities are open: a Gauss-Markov error of ``float_std`` [m], quality 5.
    """

    rate_hz: float = 1.0
    std_horizontal: float = bounded_field(0.02, 1e-15, 1e4)  # m
    std_vertical: float = bounded_field(0.02, 1e-15, 1e4)  # m
    std_velocity: float = bounded_field(0.02, 1e-15, 1e4)  # m/s
    s_p: float = bounded_field(0.0, 0, 1e4)  # m
    s_v: float = bounded_field(0.0, 0, 1e4)  # m/s
    quality: int = 4
    lever_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position_lag_s: float = bounded_field(0.0, 0, 1)
    velocity_lag_s: float = bounded_field(0.0, 0, 1)
    std_factor: float = bounded_field(1.0, 0.05, 20)
    dropout_share: float = bounded_field(0.0, 0, 0.9)
    dropout_s: float = bounded_field(3.0, 0.1, 600)
    wander: float = bounded_field(0.0, 0, 100)
    wander_s: float = bounded_field(30.0, 0.1, 1e4)
    float_share: float = bounded_field(0.0, 0, 1)
    float_s: float = bounded_field(30.0, 1, 1e4)
    float_std: float = bounded_field(0.3, 0, 100)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quality not in QUALITIES:
            raise InputError(f"gnss: quality {self.quality} is none of {QUALITIES} (NMEA GGA codes)")
        if len(self.lever_arm_b) != 3 or not all(math.isfinite(x) and abs(x) < 100 for x in self.lever_arm_b):
            raise InputError(f"gnss: lever_arm_b {self.lever_arm_b} must be 3 lengths in metres")

    @property
    def std(self) -> NDArray[np.floating]:
        """1σ of position and velocity in NED (6,)."""
        position = (self.std_horizontal, self.std_horizontal, self.std_vertical)
        return np.hypot((*position, *(self.std_velocity,) * 3), (self.s_p,) * 3 + (self.s_v,) * 3)


def observe(
    rng: np.random.Generator, truth: Truth, rate_b: NDArray[np.floating], config: GnssConfig, sky: Sky | None = None
) -> pd.DataFrame:
    """GNSS table of the data contract at every row of ``truth`` whose sky is not blocked.

    ``rate_b`` (N, 3): the body's ω_ib [rad/s] at those times, for the velocity of the antenna.
    """
    arm, antenna_v_n = antenna_states(truth, rate_b, config.lever_arm_b)
    error = config.std * rng.standard_normal((len(truth.t), 6))
    wandering, is_float = _draw_wander(rng.spawn(1)[0], truth.t, config)
    error[:, :3] += wandering
    std = np.broadcast_to(config.std, error.shape).copy()
    if config.wander > 0 or config.float_share > 0:
        sizes = np.hypot(config.wander, config.float_std * is_float)[:, None] * AXES
        std[:, :3] = np.hypot(std[:, :3], sizes)
    lat, lon, height = shift_positions(truth, arm + error[:, :3])
    velocity = antenna_v_n + error[:, 3:]
    quality = np.where(is_float, FLOAT, config.quality).astype(np.int64)
    table = pd.DataFrame(fix_columns(truth.t, lat, lon, height, velocity, std, quality))
    return table if sky is None else table.loc[~sky.blocked].reset_index(drop=True)


def _draw_wander(
    rng: np.random.Generator, t: NDArray[np.floating], config: GnssConfig
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Errors (N, 3) [m] in NED that last, by multipath and open ambiguities, and where the latter are open (N,)."""
    error, is_float = np.zeros((len(t), 3)), np.zeros(len(t), dtype=bool)
    dt = float(t[1] - t[0]) if len(t) > 1 else 1.0
    if config.wander > 0:
        error += config.wander * AXES * gauss_markov(rng, error.shape, dt / config.wander_s)
    if config.float_share > 0:
        is_float = episodes(rng, t, config.float_share, config.float_s)
        error += config.float_std * AXES * gauss_markov(rng, error.shape, dt / config.float_s) * is_float[:, None]
    return error, is_float


def episodes(rng: np.random.Generator, t: NDArray[np.floating], share: float, mean_s: float) -> NDArray[np.bool_]:
    """Times (N,) that lie within random episodes of a mean length [s], exponential, which make a share of the time."""
    if share >= 1:
        return np.ones(len(t), dtype=bool)
    between = mean_s * (1 - share) / share
    mean = (float(t[-1] - t[0]) if len(t) else 0.0) / (mean_s + between)
    count = 2 + int(mean + 10 * math.sqrt(mean))  # ten sigma more than it takes
    starts_in = bool(rng.random() < share)
    spans = rng.exponential((mean_s, between) if starts_in else (between, mean_s), (count, 2)).ravel()
    odd = np.searchsorted(np.cumsum(spans), t - (t[0] if len(t) else 0.0), side="right") % 2 == 1
    return odd != starts_in


def antenna_states(
    truth: Truth, rate_b: NDArray[np.floating], lever_arm_b: tuple[float, float, float]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Offset of the antenna from the body C l [m] and its velocity v + C(ω_ib × l) − ω_ie × (C l) [m/s], (N, 3) NED.

    paper.md 2.5; ``lever_arm_b`` [m] in body axes, ``rate_b`` (N, 3) the body's ω_ib [rad/s].
    """
    C_nb = rotation_from_rpy(torch.from_numpy(truth.rpy)).numpy()
    arm = C_nb @ np.asarray(lever_arm_b)
    earth_rate = EARTH_RATE * np.stack((np.cos(truth.lat), np.zeros_like(truth.lat), -np.sin(truth.lat)), -1)
    swing = np.einsum("tij,tj->ti", C_nb, np.cross(rate_b, lever_arm_b)) - np.cross(earth_rate, arm)
    return arm, truth.v_n + swing


def shift_positions(truth: Truth, offset_n: NDArray[np.floating]) -> tuple[NDArray, NDArray, NDArray]:
    """Latitude, longitude [rad] and height [m] a few metres away; second order is below 1e-4 m at 30 m."""
    meridian, transverse = radii_of_curvature(truth.lat)
    return (
        truth.lat + offset_n[:, 0] / (meridian + truth.height),
        truth.lon + offset_n[:, 1] / ((transverse + truth.height) * np.cos(truth.lat)),
        truth.height - offset_n[:, 2],
    )
