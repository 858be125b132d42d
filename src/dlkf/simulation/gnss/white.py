"""A GNSS receiver's position and velocity at the antenna, with white noise of known size: no satellites."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from dlkf.errors import InputError
from dlkf.navigation.attitude import rotation_from_rpy
from dlkf.navigation.earth import EARTH_RATE, ECCENTRICITY_SQ, transverse_radius
from dlkf.simulation.gnss.surroundings import Sky
from dlkf.simulation.motion.vehicle import Truth

QUALITIES = (1, 2, 4, 5)


@dataclass(frozen=True)
class GnssConfig:
    """One receiver: fix rate, 1σ per axis, and the scale factors s_p, s_v of added noise (paper eqs 12, 13).

    Std of a fix is √(σ² + s²), and is what the fix claims. ``quality`` is an NMEA GGA code;
    ``lever_arm_b`` runs from the IMU to the antenna in body axes [m].
    """

    rate_hz: float = 1.0
    std_horizontal: float = 0.02  # m
    std_vertical: float = 0.02  # m
    std_velocity: float = 0.02  # m/s
    s_p: float = 0.0  # m
    s_v: float = 0.0  # m/s
    quality: int = 4
    lever_arm_b: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("std_horizontal", "std_vertical", "std_velocity"):
            if not 0 < getattr(self, name) < 1e4:
                raise InputError(f"gnss: {name} {getattr(self, name)} must be positive")
        if not (0 <= self.s_p < 1e4 and 0 <= self.s_v < 1e4):
            raise InputError(f"gnss: s_p {self.s_p} and s_v {self.s_v} must not be negative")
        if self.quality not in QUALITIES:
            raise InputError(f"gnss: quality {self.quality} is none of {QUALITIES} (NMEA GGA codes)")
        if len(self.lever_arm_b) != 3 or not all(math.isfinite(x) and abs(x) < 100 for x in self.lever_arm_b):
            raise InputError(f"gnss: lever_arm_b {self.lever_arm_b} must be 3 lengths in metres")

    @property
    def std(self) -> NDArray[np.float64]:
        """1σ of position and velocity in NED (6,)."""
        position = (self.std_horizontal, self.std_horizontal, self.std_vertical)
        return np.hypot((*position, *(self.std_velocity,) * 3), (self.s_p,) * 3 + (self.s_v,) * 3)


def observe(
    rng: np.random.Generator,
    truth: Truth,
    rate_b: NDArray[np.float64],
    config: GnssConfig,
    sky: Sky | None = None,
) -> pd.DataFrame:
    """GNSS table of the data contract at every row of ``truth`` whose sky is not blocked.

    ``rate_b`` (N, 3): the body's ω_ib [rad/s] at those times, for the velocity of the antenna.
    """
    arm, antenna_v_n = antenna(truth, rate_b, config.lever_arm_b)
    error = config.std * rng.standard_normal((len(truth.t), 6))
    lat, lon, height = shifted(truth, arm + error[:, :3])
    velocity = antenna_v_n + error[:, 3:]
    columns = {
        "t": truth.t,
        "lat_deg": np.degrees(lat),
        "lon_deg": np.degrees(lon),
        "height_m": height,
        **{f"vel_{axis}": velocity[:, k] for k, axis in enumerate("ned")},
        **{f"std_pos_{axis}": config.std[k] for k, axis in enumerate("ned")},
        **{f"std_vel_{axis}": config.std[3 + k] for k, axis in enumerate("ned")},
    }
    table = pd.DataFrame(columns)
    table["quality"] = np.full(len(table), config.quality, dtype=np.int64)
    return table if sky is None else table.loc[~sky.blocked].reset_index(drop=True)


def antenna(
    truth: Truth, rate_b: NDArray[np.float64], lever_arm_b: tuple[float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Offset of the antenna from the body C l [m] and its velocity v + C(ω_ib × l) − ω_ie × (C l) [m/s], (N, 3) NED.

    paper.md 2.5; ``lever_arm_b`` [m] in body axes, ``rate_b`` (N, 3) the body's ω_ib [rad/s].
    """
    C_nb = rotation_from_rpy(torch.from_numpy(truth.rpy)).numpy()
    arm = C_nb @ np.asarray(lever_arm_b)
    earth_rate = EARTH_RATE * np.stack((np.cos(truth.lat), np.zeros_like(truth.lat), -np.sin(truth.lat)), -1)
    swing = np.einsum("tij,tj->ti", C_nb, np.cross(rate_b, lever_arm_b)) - np.cross(earth_rate, arm)
    return arm, truth.v_n + swing


def shifted(truth: Truth, offset_n: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
    """Latitude, longitude [rad] and height [m] a few metres away; second order is below 1e-4 m at 30 m."""
    transverse = transverse_radius(torch.from_numpy(truth.lat)).numpy()
    meridian = (1 - ECCENTRICITY_SQ) * transverse / (1 - ECCENTRICITY_SQ * np.sin(truth.lat) ** 2)
    return (
        truth.lat + offset_n[:, 0] / (meridian + truth.height),
        truth.lon + offset_n[:, 1] / ((transverse + truth.height) * np.cos(truth.lat)),
        truth.height - offset_n[:, 2],
    )
