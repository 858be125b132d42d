"""Attitude at every epoch boundary from IMU and GNSS alone: course for yaw, levelling for roll and pitch.

Over a window that ends at the boundary the gyroscopes carry the specific force to the boundary's body axes,
u_b = mean(C_b(end)b(t) f_b(t)), and GNSS gives the same vector in n, u_n = Δv/Δt − g. With yaw ψ from the
course, C_nb u_b = u_n is solved for roll and pitch in closed form (Groves sect. 5.6.2, with motion).

A receiver without velocities has them fitted to its positions (:mod:`dlkf.data.velocity_fit`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import yaml
from jaxtyping import Bool, Float
from torch import Tensor

from dlkf.base.config import config_dir
from dlkf.base.errors import InputError
from dlkf.base.settings import settings_from
from dlkf.data.drive import Drive
from dlkf.data.velocity_fit import MOTION_SIGMAS, REACH_S, antenna_velocity, latest_before, scale_std
from dlkf.navigation.attitude import prefix_rotations, rotation_from_rpy, rotation_from_vector, rpy_from_rotation
from dlkf.navigation.earth import EARTH_RATE, STANDARD_GRAVITY, ned_axes, normal_gravity
from dlkf.navigation.error_model import RATE_AVERAGE_S
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.state import NavState

SIDESLIP_STD = math.radians(1.5)  # course is not heading: sideslip, mounting yaw
AXLE_STD = 0.7  # m, how far the IMU may sit before the rear axle; in a turn that is no small angle
ACCEL_BIAS_STD = 0.1  # m/s²; tilts the level by bias / g
JERK_STD = 0.7  # m/s³, of a car
SPREAD_STD = math.radians(0.5)  # lever arm to the rear axle, vibration


@dataclass(frozen=True)
class AlignConfig:
    """``min_speed`` [m/s] below which course is no heading; ``window_s`` [s] over which f is levelled.

    ``search_s`` [s] of motion over which headings are weighed against each other, until one has won; 0 takes the
    course. ``from_rest``: start with the first fix, which looks ahead; else with the epoch at which the heading is
    good, as in a vehicle (:mod:`dlkf.running.start`).
    """

    min_speed: float = 2.0
    window_s: float = 2.0
    search_s: float = 0.0
    from_rest: bool = False

    def __post_init__(self) -> None:
        for name in ("min_speed", "window_s", "search_s"):
            value = getattr(self, name)
            if value < 0 or (value == 0 and name != "search_s"):
                above = "≥ 0" if name == "search_s" else "above 0"
                raise InputError(f"align.{name} is {value!r}, must be a number {above}")
            object.__setattr__(self, name, float(value))


ALIGN = AlignConfig()  # the course
SEARCH = AlignConfig(search_s=20.0)


def read_align() -> AlignConfig:
    """How ``dlkf navigate`` starts a drive: ``align`` of ``conf/navigate.yaml``."""
    values = yaml.safe_load((config_dir() / "navigate.yaml").read_text(encoding="utf-8"))
    return settings_from(AlignConfig, values["align"], "align")


@dataclass(frozen=True)
class Aligned:
    """State of the IMU at the N+1 boundaries, where ``ok``; float64, garbage elsewhere.

    ``r_e`` [m], ``v_e`` [m/s] in ECEF, ``C_eb``; ``std`` (9) of position, velocity, attitude in local NED. ``scatter``:
    how many times more than claimed positions and velocities scatter, ≥ 1.
    """

    ok: Bool[Tensor, " rows"]
    r_e: Float[Tensor, "rows 3"]
    v_e: Float[Tensor, "rows 3"]
    C_eb: Float[Tensor, "rows 3 3"]
    std: Float[Tensor, "rows 9"]
    scatter: Float[Tensor, "rows 2"]


@dataclass(frozen=True)
class Start:
    """Where a filter starts on a drive: epoch ``first``, tangent origin [rad, rad, m], state there (one
    element, float64, in the tangent frame of that origin), its 1σ (9), the probability that the car faces
    another way, the gyroscopes' bias with its 1σ (6) [rad/s] where it has been found, and how many times more than
    claimed positions and velocities scatter (2; √w of :mod:`dlkf.filters.fix_noise`), where fixes have shown it."""

    first: int
    lat: float
    lon: float
    height: float
    state: NavState
    std: Float[Tensor, " 9"]
    doubt: float = 0.0
    gyro: Float[Tensor, " 6"] | None = None
    noise: Float[Tensor, " 2"] | None = None


def align_boundaries(drive: Drive, config: AlignConfig = ALIGN) -> Aligned:
    """Align at every boundary that has a fix with velocity faster than ``min_speed`` and than ``MOTION_SIGMAS`` times
    its 1σ, and one a window before: of ``window_s``, or up to ``REACH_S`` where fixes are missing.

    A source without any velocity has it fitted to its positions. Reads no reference.
    """
    rows = drive.epochs + 1
    back = max(1, round(config.window_s / drive.epoch_s))
    lat, lon, height = geodetic_from_ecef(torch.nan_to_num(drive.gnss_r_e, nan=1e6))
    C_en = ned_axes(lat, lon)
    position = drive.gnss_valid[:, :3].all(-1)
    u_b, rate_b, turned = _average_force(drive, back)
    down_b = -u_b / u_b.norm(dim=-1, keepdim=True).clamp_min(1.0)
    v_n, v_std, given, known, moving, scatter, off, lag = antenna_velocity(drive, C_en, down_b)

    then = latest_before(given, back, round(REACH_S / drive.epoch_s))
    ok = position & moving & (then >= 0) & known[then]
    windows = torch.where(ok, torch.arange(rows) - then, back)
    for longer in set(windows.tolist()) - {back}:
        these = (windows == longer)[:, None]
        u, _, turn = _average_force(drive, longer)
        u_b, turned = torch.where(these, u, u_b), torch.where(these[..., None], turn, turned)
    span = windows * drive.epoch_s - lag + lag[then]
    ok &= span > 0.5 * drive.epoch_s
    span = span.clamp_min(0.5 * drive.epoch_s)

    # velocity of the IMU in n at both ends: the antenna's less the lever-arm velocity ω × l
    arm_velocity_b = torch.linalg.cross(rate_b, drive.lever_arm_b.expand_as(rate_b))
    speed = v_n[:, :2].norm(dim=-1)
    slip = torch.asin((arm_velocity_b[:, 1] / speed.clamp_min(0.1)).clamp(-0.9, 0.9))
    yaw = torch.atan2(v_n[:, 1], v_n[:, 0]) - slip + lag * rate_b[:, 2]
    C_level = rotation_from_rpy(torch.stack((torch.zeros_like(yaw), torch.zeros_like(yaw), yaw), -1))
    v_imu = v_n - (C_level @ arm_velocity_b.unsqueeze(-1)).squeeze(-1)
    arm_velocity_then = torch.linalg.cross(rate_b[then], drive.lever_arm_b.expand_as(rate_b))
    v_then = v_n[then] - (C_level @ turned @ arm_velocity_then.unsqueeze(-1)).squeeze(-1)
    acceleration = (v_imu - v_then) / span.unsqueeze(-1)
    gravity = torch.stack((0 * lat, 0 * lat, normal_gravity(torch.sin(lat), height)), -1)
    earth_n = EARTH_RATE * torch.stack((torch.cos(lat), 0 * lat, -torch.sin(lat)), -1)
    u_n = acceleration + 2 * torch.linalg.cross(earth_n, (v_imu + v_then) / 2) - gravity
    roll, pitch = _level(u_b, (C_level.mT @ u_n.unsqueeze(-1)).squeeze(-1))
    C_nb = rotation_from_rpy(torch.stack((roll, pitch, yaw), -1))
    now = v_imu + lag.unsqueeze(-1) * acceleration
    r_e = drive.gnss_r_e + (C_en @ (drive.gnss_lag.unsqueeze(-1) * v_n).unsqueeze(-1)).squeeze(-1)
    r_e = r_e - (C_en @ C_nb @ drive.lever_arm_b).reshape(rows, 3)

    noise = v_std[:, :2].amax(-1)
    shift = torch.maximum(lag, lag[then])  # of the velocities' window against the IMU's
    pull = (1.41 * noise / span) ** 2 + (JERK_STD * shift) ** 2 + ACCEL_BIAS_STD**2  # (m/s²)²
    tilt = torch.sqrt(pull / STANDARD_GRAVITY**2 + SPREAD_STD**2)
    turning = AXLE_STD * rate_b[:, 2]  # m/s across the car
    heading = torch.sqrt(SIDESLIP_STD**2 + (noise**2 + turning**2) / speed.clamp_min(0.1) ** 2)
    attitude_std = torch.stack((tilt, tilt, heading), -1)
    position_std = torch.hypot(scale_std(drive.gnss_std[:, :3], scatter[:, :1]), off[:, None])
    std = torch.cat((position_std, v_std, attitude_std), -1)
    C_eb = C_en @ C_nb
    finite = torch.cat((r_e, now, C_eb.flatten(1), std), -1).isfinite().all(-1)
    ok &= (speed > config.min_speed) & (speed > MOTION_SIGMAS * noise) & finite
    return Aligned(ok, r_e, (C_en @ now.unsqueeze(-1)).squeeze(-1), C_eb, std, scatter)


def mean_force(drive: Drive, row: int, config: AlignConfig = ALIGN) -> Float[Tensor, " 3"]:
    """Mean specific force [m/s²] of the window that ends at boundary ``row``, carried to the body axes there."""
    back = min(row, max(1, round(config.window_s / drive.epoch_s)))
    return _average_force(drive.part(row - back, row), back)[0][-1]


def level_attitude(
    C_nb: Float[Tensor, "*k 3 3"], force_b: Float[Tensor, " 3"], force_n: Float[Tensor, " 3"]
) -> Float[Tensor, "*k 3 3"]:
    """Attitudes with the yaw of ``C_nb`` under which ``force_b`` is ``force_n`` [m/s²]."""
    yaw = rpy_from_rotation(C_nb)[..., 2]
    zero = torch.zeros_like(yaw)
    C_level = rotation_from_rpy(torch.stack((zero, zero, yaw), -1))
    force_h = (C_level.mT @ force_n.unsqueeze(-1)).squeeze(-1)
    roll, pitch = _level(force_b.expand_as(force_h), force_h)
    return rotation_from_rpy(torch.stack((roll, pitch, yaw), -1))


def _average_force(
    drive: Drive, back: int
) -> tuple[Float[Tensor, "rows 3"], Float[Tensor, "rows 3"], Float[Tensor, "rows 3 3"]]:
    """Mean specific force of the ``back`` epochs before each boundary in the boundary's body axes.

    Also the rate there (mean of the last :data:`RATE_AVERAGE_S`) and C_b(boundary)b(window's start). Rows
    < ``back`` repeat.
    """
    imu = drive.imu.double()
    N, M = imu.shape[:2]
    back = min(back, N)
    phi = imu[..., 3:] / drive.rate_hz
    to_start = prefix_rotations(phi.permute(2, 0, 1)).permute(2, 3, 0, 1)  # C_b(epoch start)b(end of sample)
    identity = torch.eye(3, dtype=torch.float64).expand(N, 1, 3, 3)
    middle = torch.cat((identity, to_start[:, :-1]), 1) @ rotation_from_vector(0.5 * phi)
    force = (middle @ imu[..., :3, None])[..., 0].sum(1)  # per epoch, axes of its start
    to_end = to_start[:, -1].mT
    total = torch.zeros(N + 1 - back, 3, dtype=torch.float64)
    turned = torch.eye(3, dtype=torch.float64).expand(N + 1 - back, 3, 3)
    for j in range(back):  # epochs of the window, latest first
        epoch = slice(back - 1 - j, N - j)
        turned = turned @ to_end[epoch]
        total = total + (turned @ force[epoch, :, None])[..., 0]
    tail = max(1, min(M, round(RATE_AVERAGE_S * drive.rate_hz)))
    rate = torch.cat((imu[:1, :tail, 3:], imu[:, -tail:, 3:])).mean(1)
    total = torch.cat((total[:1].expand(back, 3), total)) / (back * M)
    turned = torch.cat((turned[:1].expand(back, 3, 3), turned))
    return total, rate, turned


def _level(u_b: Float[Tensor, "*b 3"], u_h: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Roll and pitch with Ry(pitch) Rx(roll) u_b = u_h, u_h in level axes along the heading."""
    x, y, z = u_b.unbind(-1)
    roll = torch.asin((u_h[..., 1] / torch.hypot(y, z)).clamp(-1, 1)) - torch.atan2(y, -z)
    down = torch.sin(roll) * y + torch.cos(roll) * z
    pitch = torch.atan2(x, -down) - torch.asin((u_h[..., 0] / torch.hypot(x, down)).clamp(-1, 1))
    return roll, pitch
