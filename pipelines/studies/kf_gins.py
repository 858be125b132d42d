"""Compiled filters beside KF-GINS' engine: ``python -m pipelines.studies.kf_gins FOLDER``, a checkout of KF-GINS.

KF-GINS (Wuhan University, C++ with Eigen, GPL-3) has 21 states and takes GNSS positions. Its engine is compiled here,
-O3 for this machine, with a loop round it that holds the drive in memory, and runs over the same simulated drive in
turns with our filters: processor time of one thread, the least of some rounds. It propagates its covariance with every
sample, ours once an epoch in closed form over all samples of it; that is the larger part of the difference. Nothing of
it is kept here.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from dlkf.data.alignment import ALIGN
from dlkf.data.drive import Batch
from dlkf.data.limits import horizontal_distance
from dlkf.data.store import load_dataset
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Mbkf
from dlkf.navigation.attitude import rpy_from_rotation
from dlkf.navigation.earth import ned_axes
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.running.batched import run_filter
from dlkf.running.start import align_drives
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.tracking.models import resolve_model

RATE_HZ, MINUTES, ROUNDS = 100.0, 20.0, 5
IMU = ImuSpec(
    "mems", SensorErrors(2.5e-3, 0.02, 1e-3, 3600.0, 3e-3, 3e-3), SensorErrors(9e-5, 1e-3, 1e-4, 3600.0, 3e-3, 3e-3)
)


def build_engine(checkout: Path, folder: Path) -> Path:
    """Their engine with our loop, compiled."""
    theirs = checkout / "src"
    program = folder / "engine"
    sources = (
        Path(__file__).with_name("kf_gins_engine.cpp"),
        *(theirs / "kf-gins" / f"{n}.cpp" for n in ("gi_engine", "insmech")),
    )
    eigen = checkout / "ThirdParty" / "eigen-3.3.9"
    flags = "-std=c++14", "-O3", "-DNDEBUG", "-march=native", f"-I{theirs}", f"-I{eigen}"
    subprocess.run(["c++", *flags, *sources, "-o", program], check=True)
    return program


def numbers(batch: Batch, mbkf: Mbkf) -> np.ndarray:
    """A drive, its start and its noise as the engine reads them."""
    epoch = batch.dt * batch.size[2]
    samples = batch.imu[0].flatten(0, 1).numpy() * batch.dt
    times = batch.dt * (1 + np.arange(len(samples)))
    fixes = batch.gnss_valid[0, :, :3].all(-1).numpy()
    at = epoch * (1 + np.arange(batch.size[1]))[fixes]
    position = _geodetic(batch, batch.gnss[0, :, :3])[fixes]
    start, C = _geodetic(batch, batch.start.p_n)[0], batch.frame.C_en[0] @ batch.start.C_nb[0]
    local = ned_axes(*map(torch.tensor, start[:2])).mT
    v = local @ batch.frame.C_en[0] @ batch.start.v_n[0]
    sigma = mbkf.begin(batch)[0].P[0].diagonal().sqrt().numpy()
    a, g = IMU.accel, IMU.gyro
    noise = [g.noise_density, a.noise_density, sigma[12], sigma[9], g.scale_factor, a.scale_factor, a.correlation_time]
    head = [len(samples), len(at), *batch.lever_arm_b[0], *start, *v, *rpy_from_rotation(local @ C), *sigma[:9], *noise]
    imu = np.column_stack((times, samples[:, 3:], samples[:, :3]))
    gnss = np.column_stack((at, position, batch.gnss_std[0, :, :3].numpy()[fixes]))
    return np.concatenate((np.array(head, float), imu.ravel(), gnss.ravel()))


def _geodetic(batch: Batch, p_n: torch.Tensor) -> np.ndarray:
    return torch.stack(geodetic_from_ecef(batch.frame.to_ecef(p_n)), -1).numpy()


def final_error(batch: Batch, at: np.ndarray) -> float:
    """Horizontal distance [m] of a place from the truth at the end."""
    truth = _geodetic(batch, batch.truth.p_n[:, -1])[0]
    return float(horizontal_distance(*np.degrees((*truth[:2], *at[:2]))))


def processor_time(estimator: Estimator, batch: Batch) -> float:
    """Of one run [s]."""
    began = time.process_time()
    run_filter(batch, estimator)
    return time.process_time() - began


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside the block torch has one: a second one that waits for work counts as processor time."""
    usual = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(usual)


@one_thread()
def measure(
    checkout: Path, models: Sequence[str], minutes: float, rounds: int
) -> dict[str, tuple[list[float], int, float]]:
    """By name: processor seconds of the rounds, samples of the drive, horizontal error [m] at its end."""
    with tempfile.TemporaryDirectory() as folder:
        home, gnss = Path(folder), GnssConfig(lever_arm_b=(1.0, 0.3, -1.2))
        config = DatasetConfig("one", hours=minutes / 60, drive_minutes=minutes, gnss=gnss)
        data = simulate_dataset(config, IMU, 0, home / "data", progress=False, workers=1)
        batch = align_drives([load_dataset(data, rate_hz=RATE_HZ, dtype=torch.float64)[0]], ALIGN)
        mbkf = resolve_model("mbkf21", IMU)
        assert isinstance(mbkf, Mbkf)
        numbers(batch, mbkf).tofile(home / "drive.bin")
        engine = build_engine(checkout, home)
        ours: dict[str, Estimator] = {n: compile_filter(resolve_model(n, IMU), RATE_HZ, 1.0) for n in models}
        spent: dict[str, list[float]] = {n: [] for n in ("KF-GINS", *ours)}
        end = np.zeros(3)
        for _ in range(rounds):
            said = subprocess.run([engine, home / "drive.bin"], capture_output=True, text=True, check=True).stdout
            seconds, *end = map(float, said.splitlines()[-1].split())
            spent["KF-GINS"].append(seconds)
            for name, estimator in ours.items():
                spent[name].append(processor_time(estimator, batch))
        ends = {n: _geodetic(batch, run_filter(batch, f).posterior.p_n[:, -1])[0] for n, f in ours.items()}
        samples = batch.size[1] * batch.size[2]
        return {n: (s, samples, final_error(batch, ends.get(n, np.array(end)))) for n, s in spent.items()}


def main() -> None:
    """Build, run interleaved, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path, help="git clone of KF-GINS")
    parser.add_argument("--models", nargs="+", default=["mbkf21", "mbkf21_car", "plus"])
    parser.add_argument("--minutes", type=float, default=MINUTES)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    options = parser.parse_args()
    found = measure(options.checkout, options.models, options.minutes, options.rounds)
    print("| | IMU epochs/s | × KF-GINS | off at the end [m] |\n|:--|--:|--:|--:|")
    for name, (seconds, samples, distance) in found.items():
        ratio = min(found["KF-GINS"][0]) / min(seconds)
        print(f"| {name} | {samples / min(seconds):,.0f} | {ratio:.1f} | {distance:.2f} |")


if __name__ == "__main__":
    main()
