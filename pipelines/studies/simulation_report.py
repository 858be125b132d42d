"""What the simulated cars and IMUs are like, as Markdown tables: bounds, velocity across the car, exactness, noise.

    python -m pipelines.studies.simulation_report --hours 5

For every profile of ``conf/simulated``: speed, accelerations and radii of the plans (R085-R088); the velocity across
the car, RMS above 2 m/s; how far our strapdown of the error-free samples is from the truth during a minute at 50, 100
and 200 Hz; how far the same minute differs between these rates. For IMU presets: the Allan deviation of six static
hours against the preset's own.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from dlkf.command.composing import composed, imu_preset
from dlkf.diagnosis.allan import allan_variance
from dlkf.navigation.attitude import rotation_from_rpy, vector_from_rotation
from dlkf.navigation.earth import ecef_from_geodetic, ned_axes, tangent_frame
from dlkf.navigation.imu_errors import SensorErrors
from dlkf.navigation.state import NavState
from dlkf.navigation.strapdown import strapdown
from dlkf.simulation.dataset import DatasetConfig, dataset_config
from dlkf.simulation.drive import sliced
from dlkf.simulation.imu import corrupt, draw_unit, inverse_mechanisation
from dlkf.simulation.motion.chassis import draw_car, mounted, slip_angle
from dlkf.simulation.motion.routes import along
from dlkf.simulation.motion.vehicle import Truth, follow, random_route

PROFILES = ("paper_clean", "lifelike", "city", "highway", "car_park", "tunnel")
PRESETS = ("consumer", "icm20602_i2nav", "adis16465_i2nav")
RATES = (50, 100, 200)
MINUTE = 60
STATIC_HZ, STATIC_HOURS = 10, 6


def drive(config: DatasetConfig, seed: int, seconds: int, rate: int) -> tuple[Truth, dict[str, np.ndarray]]:
    """Truth of the IMU; and of its plan speed, accelerations and radii, with the velocity across the car."""
    t = np.arange(seconds * rate + 1) / rate
    route = random_route(np.random.default_rng((seed, 0)), config.vehicle, float(seconds))
    rng = np.random.default_rng((seed, 1))
    car, axle = draw_car(rng, config.chassis), follow(route, config.vehicle, t)
    truth = axle if config.chassis.is_point and not config.vehicle.is_banked else mounted(rng, car, route, axle)
    motion, planned = route.motion(t), along(route.plan, t)
    steady = (planned.yaw_rate != 0) & (planned.yaw_acceleration == 0)
    moving = motion.speed > 2
    v_b = np.einsum("tij,ti->tj", rotation_from_rpy(torch.from_numpy(truth.rpy)).numpy(), truth.v_n)[moving]
    return truth, {
        "speed": 3.6 * np.abs(planned.speed),
        "along": np.abs(planned.acceleration),
        "radius": np.abs(planned.speed[steady] / planned.yaw_rate[steady]),
        "lateral": np.abs(planned.speed * planned.yaw_rate)[steady],
        "axle": (motion.speed * np.sin(slip_angle(car, route, motion)[0]))[moving],
        "imu": v_b[:, 1],
        "down": v_b[:, 2],
    }


def round_trip(truth: Truth, rate: int) -> tuple[float, float]:
    """Largest position [m] and attitude [rad] error of our strapdown over a minute of error-free samples."""
    imu = torch.from_numpy(inverse_mechanisation(truth))
    lat, lon, height, v_n, rpy = (
        torch.from_numpy(np.ascontiguousarray(x)) for x in (truth.lat, truth.lon, truth.height, truth.v_n, truth.rpy)
    )
    frame, C_en = tangent_frame(lat[:1], lon[:1], height[:1]), ned_axes(lat, lon)
    p = frame.from_ecef(ecef_from_geodetic(lat, lon, height)[None])[0]
    v = frame.rotate_from_ecef((C_en @ v_n[..., None])[None, ..., 0])[0]
    C = frame.C_en[0].mT @ C_en @ rotation_from_rpy(rpy)
    state, worst = NavState(p[:1], v[:1], C[:1]), (0.0, 0.0)
    for first in range(0, len(imu), rate):
        state = strapdown(state, imu[first : first + rate][None], 1 / rate, frame).end
        end = first + rate
        error = (state.p_n[0] - p[end]).norm(), vector_from_rotation(C[end] @ state.C_nb[0].mT).norm()
        worst = max(worst[0], float(error[0])), max(worst[1], float(error[1]))
    return worst


def exactness(config: DatasetConfig, seeds: int) -> tuple[list[tuple[float, float]], float]:
    """Worst round trip over some minutes at each rate, and the largest position difference between the rates [m]."""
    worst, apart = [(0.0, 0.0) for _ in RATES], 0.0
    for seed in range(seeds):
        minutes = [drive(config, seed, 2 * MINUTE, rate)[0] for rate in RATES]
        for k, rate in enumerate(RATES):
            trip = round_trip(sliced(minutes[k], slice(MINUTE * rate, None)), rate)
            worst[k] = max(worst[k][0], trip[0]), max(worst[k][1], trip[1])
            same = sliced(minutes[k], slice(None, None, rate // RATES[0]))
            apart = max(apart, 6.4e6 * float(np.abs(same.lat - minutes[0].lat).max()))
            apart = max(apart, float(np.abs(same.height - minutes[0].height).max()))
    return worst, apart


def stated(sensor: SensorErrors, tau: float) -> float:
    """Allan deviation of a preset: white noise and stationary Gauss-Markov (IEEE Std 952, annex C)."""
    T = sensor.correlation_time
    decay = 1 - T / (2 * tau) * (3 - 4 * math.exp(-tau / T) + math.exp(-2 * tau / T))
    return math.sqrt(sensor.noise_density**2 / tau + 2 * sensor.instability**2 * T / tau * decay)


def rms(x: np.ndarray) -> float:
    return math.sqrt(float(np.mean(x**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=5.0, help="of each profile, in drives of ten minutes")
    parser.add_argument("--seeds", type=int, default=8, help="minutes of each profile for the round trip")
    parser.add_argument("--profiles", nargs="+", default=list(PROFILES))
    arguments = parser.parse_args()
    table(
        "profile | speed [km/h] | along [m/s²] | radius [m] | lateral [m/s²] | axle, imu, down [m/s]",
        arguments.profiles,
        lambda name: motion_row(name, arguments.hours),
    )
    table(
        "profile | 50 Hz [mm], [rad] | 100 Hz | 200 Hz | between rates [µm]",
        arguments.profiles,
        lambda name: exact_row(name, arguments.seeds),
    )
    table("preset | accelerometer, measured/stated at 1, 10, 100 s | gyroscope", PRESETS, allan_row)


def motion_row(name: str, hours: float) -> str:
    config = dataset_config(composed("simulate", f"simulated@dataset={name}")["dataset"])
    parts = [drive(config, seed, 600, 10)[1] for seed in range(math.ceil(hours * 6))]
    all_of = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    bounds = [f"{all_of[key].min():.4g} – {all_of[key].max():.4g}" for key in ("speed", "along", "radius", "lateral")]
    return " | ".join([*bounds, ", ".join(f"{rms(all_of[key]):.3f}" for key in ("axle", "imu", "down"))])


def exact_row(name: str, seeds: int) -> str:
    worst, apart = exactness(dataset_config(composed("simulate", f"simulated@dataset={name}")["dataset"]), seeds)
    return " | ".join([*(f"{1e3 * p:.2f}, {a:.0e}" for p, a in worst), f"{1e6 * apart:.2f}"])


def allan_row(name: str) -> str:
    spec, rng = imu_preset(name), np.random.default_rng(1)
    at_rest = np.broadcast_to((0.0, 0.0, -9.81, 0.0, 0.0, 0.0), (STATIC_HOURS * 3600 * STATIC_HZ, 6))
    log = corrupt(rng, at_rest, spec, draw_unit(rng, spec), STATIC_HZ)[0]
    taus = (1, 10, 100)
    variance = [allan_variance(x, 1 / STATIC_HZ, [tau * STATIC_HZ for tau in taus]) for x in log.T]
    cells = []
    for sensor, axes in ((spec.accel, variance[:3]), (spec.gyro, variance[3:])):
        measured = np.sqrt(np.mean(axes, axis=0))
        cells.append(", ".join(f"{m / stated(sensor, tau):.3f}" for m, tau in zip(measured, taus)))
    return " | ".join(cells)


def table(head: str, names: list[str] | tuple[str, ...], row: Callable[[str], str]) -> None:
    """Print a Markdown table, a row for each name."""
    rows = [f"| {name} | {row(name)} |" for name in track(names, head.split(" | ")[0], console=Console(stderr=True))]
    print(f"\n| {head} |\n|{'---|' * (head.count(' | ') + 1)}", *rows, sep="\n")


if __name__ == "__main__":
    main()
