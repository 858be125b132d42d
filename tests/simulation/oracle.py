"""A strapdown in ECEF by Runge-Kutta 4, sample by sample, written apart from the package: slow and plain."""

import math

import numpy as np
import pandas as pd
import pymap3d
from pyins.strapdown import Integrator

OMEGA, A, E2, GM = 7.292115e-5, 6378137.0, 6.69437999014e-3, 3.986004418e14


def gravity(lat, height):
    """WGS-84 normal gravity, written here again (NIMA TR8350.2 eqs 4-1, 4-3)."""
    s2, f = math.sin(lat) ** 2, 1 / 298.257223563
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(1 - E2 * s2)
    m = OMEGA**2 * A**3 * (1 - f) / GM
    return surface * (1 - 2 / A * (1 + f + m - 2 * f * s2) * height + 3 * height**2 / A**2)


def ecef(lat, lon, height):
    radius = A / math.sqrt(1 - E2 * math.sin(lat) ** 2)
    flat = (radius + height) * math.cos(lat)
    return np.array((flat * math.cos(lon), flat * math.sin(lon), ((1 - E2) * radius + height) * math.sin(lat)))


def axes(lat, lon):
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array(((-sl * co, -so, -cl * co), (-sl * so, co, -cl * so), (cl, 0, -sl)))


def attitude(roll, pitch, yaw):
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        (
            (cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy),
            (cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy),
            (-sp, sr * cp, cr * cp),
        )
    )


def cross_matrix(u):
    return np.array(((0, -u[2], u[1]), (u[2], 0, -u[0]), (-u[1], u[0], 0)))


def rotation(phi):
    angle = math.sqrt(phi @ phi)
    K = cross_matrix(phi)
    if angle < 1e-8:
        return np.eye(3) + K
    return np.eye(3) + math.sin(angle) / angle * K + 2 * (math.sin(angle / 2) / angle) ** 2 * K @ K


def geodetic_gravity_vector(r_e):
    """Gravity at an ECEF point; latitude and height by a few Bowring-like iterations."""
    flat = math.hypot(r_e[0], r_e[1])
    lat = math.atan2(r_e[2], flat * (1 - E2))
    for _ in range(4):
        radius = A / math.sqrt(1 - E2 * math.sin(lat) ** 2)
        height = flat / math.cos(lat) - radius
        lat = math.atan2(r_e[2], flat * (1 - E2 * radius / (radius + height)))
    return gravity(lat, height) * axes(lat, math.atan2(r_e[1], r_e[0]))[:, 2]


def strapdown(truth, imu, rate):
    """Sample-by-sample ECEF strapdown by Runge-Kutta 4 with constant rate and force in each sample."""
    dt = 1 / rate
    earth = np.array((0, 0, OMEGA))
    W = cross_matrix(earth)
    half, whole = rotation(-earth * dt / 2), rotation(-earth * dt)
    r = ecef(truth.lat[0], truth.lon[0], truth.height[0])
    C_en = axes(truth.lat[0], truth.lon[0])
    v, C = C_en @ truth.v_n[0], C_en @ attitude(*truth.rpy[0])
    for sample in imu:
        f, phi = sample[:3], sample[3:] * dt
        g = geodetic_gravity_vector(r + v * dt / 2)
        mid, end = half @ C @ rotation(phi / 2), whole @ C @ rotation(phi)
        f0, f1, f2 = C @ f + g, mid @ f + g, end @ f + g
        k1 = f0 - 2 * W @ v
        k2 = f1 - 2 * W @ (v + k1 * dt / 2)
        k3 = f1 - 2 * W @ (v + k2 * dt / 2)
        k4 = f2 - 2 * W @ (v + k3 * dt)
        r = r + v * dt + dt**2 / 6 * (k1 + k2 + k3)
        v = v + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        C = end
    return r, v, C


def apart(truth, r, v, C):
    """How far an ECEF state is from the end of a truth: m, m/s, and the norm of the difference of the attitudes."""
    C_en = axes(truth.lat[-1], truth.lon[-1])
    there = ecef(truth.lat[-1], truth.lon[-1], truth.height[-1])
    return tuple(np.linalg.norm(x) for x in (r - there, v - C_en @ truth.v_n[-1], C - C_en @ attitude(*truth.rpy[-1])))


def apart_of_python_ins(truth, imu, rate):
    """The same of pyins' integration of IMU samples from the truth's start."""
    theta = imu[:, 3:] / rate
    turned = np.cross(theta, imu[:, :3])
    dv = (imu[:, :3] + turned / 2 + np.cross(theta, turned) / 6) / rate
    increments = pd.DataFrame(
        np.hstack((np.full((len(imu), 1), 1 / rate), theta, dv)),
        columns=["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"],
        index=truth.t[1:],
    )
    where = (*np.degrees((truth.lat[0], truth.lon[0])), truth.height[0])
    start = pd.Series(
        [*where, *truth.v_n[0], *np.degrees(truth.rpy[0])],
        index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"],
        name=truth.t[0],
    )
    end = Integrator(start).integrate(increments).iloc[-1]
    lat, lon = math.radians(end.lat), math.radians(end.lon)
    C_nb = attitude(*np.radians(end[["roll", "pitch", "heading"]].astype(float)))
    C_en = axes(lat, lon)
    return apart(truth, ecef(lat, lon, end.alt), C_en @ end[["VN", "VE", "VD"]].to_numpy(float), C_en @ C_nb)


def positions_and_integral(truth, rate):
    """ECEF positions (pymap3d) at every second row, and Simpson's rule over the ECEF velocities up to there."""
    r_e = np.stack(pymap3d.geodetic2ecef(truth.lat, truth.lon, truth.height, deg=False), -1)
    north, east, down = truth.v_n.T
    v_e = np.stack(pymap3d.enu2uvw(east, north, -down, truth.lat, truth.lon, deg=False), -1)
    moved = (v_e[:-2:2] + 4 * v_e[1:-1:2] + v_e[2::2]).cumsum(0) / (3 * rate)
    return r_e[2::2], r_e[0] + moved
