"""Speed, all from one run: ``make bench`` or ``python -m pipelines.studies.benchmark [--threads 2] [--hours 8]``.

Windowed strapdown against a loop over samples, Kalman filters for one drive and for 64, one training epoch.
The other half of the comparison, python-ins on the same files, is ``pipelines/studies/parity.py``.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table

from dlkf.config import config_dir
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Batch
from dlkf.data.segments import StartLaw, cut_pieces, make_batch
from dlkf.data.store import load_dataset
from dlkf.filters.build import build_filter
from dlkf.filters.integration import integrate
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.navigation.strapdown import strapdown
from dlkf.simulation.dataset import simulate_from_config
from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted


def seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Median wall time of a call after one warm-up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def sample_loop(batch: Batch) -> torch.Tensor:
    """The same mechanisation sample by sample, as one would write it first."""
    p, v, C = batch.start
    rate, dt = batch.frame.earth_rate_n, batch.dt
    imu = batch.imu.flatten(1, 2)
    error = torch.zeros(len(p), 6, dtype=imu.dtype, requires_grad=True)
    earth = rotation_from_vector(-rate * dt)
    for k in range(imu.shape[1]):
        sample = imu[:, k] - error
        half = C @ rotation_from_vector(sample[:, 3:] * (dt / 2))
        a = (half @ sample[:, :3, None]).squeeze(-1) + batch.frame.gravity(p) - 2 * torch.linalg.cross(rate, v)
        p, v = p + dt * v + 0.5 * dt * dt * a, v + dt * a
        C = earth @ C @ rotation_from_vector(sample[:, 3:] * dt)
    (p.sum() + v.sum()).backward()
    return p.detach()


def windows(batch: Batch) -> torch.Tensor:
    """The windowed strapdown over the same samples."""
    state = batch.start
    error = torch.zeros(len(state.p_n), 6, dtype=batch.imu.dtype, requires_grad=True)
    for t in range(batch.size[1]):
        state = strapdown(state, batch.imu[:, t] - error.unsqueeze(1), batch.dt, batch.frame).end
    (state.p_n.sum() + state.v_n.sum()).backward()
    return state.p_n.detach()


def filters(table: Table, dataset: Path, imu: ImuSpec) -> None:
    """Rows for the Kalman filters over drives at the file's own 100 Hz, one and 64 at a time, and for one online."""
    drives = load_dataset(dataset, rate_hz=100, dtype=torch.float64, reference=True)
    length = 300.0
    pieces = (cut_pieces(drives, length) * 8)[:64]
    for name in ("mbkf15", "mbkf21", "mbkf21_nhc"):
        estimator, rates = build_filter(name, imu), {}
        for n in (1, 64):
            batch = make_batch(drives, pieces[:n], dtype=torch.float64)
            with torch.inference_mode():
                took = seconds(lambda batch=batch, estimator=estimator: integrate(batch, estimator), 3)
            rates[n] = n * batch.size[1] * batch.size[2] / took
            table.add_row(f"{name}, {n} drive{'s' * (n > 1)}, 100 Hz", f"{rates[n]:,.0f} IMU epochs/s")
        table.add_row(f"{name}, 64 drives at once against one", f"{rates[64] / rates[1]:.1f} ×")


def training_epoch(data: DriveDataModule, model: LearnedFilter) -> tuple[float, int]:
    """Seconds and steps of one epoch with decimation, outages, backward pass and optimiser."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)
    transforms = (GnssDecimation(), OutageInjection(start_epoch=0))
    steps = len(data.train_pieces(1))
    start = time.perf_counter()
    for step in range(steps):
        batch = data.train_batch(1, step)
        generator = torch.Generator().manual_seed(step)
        for transform in transforms:
            batch = transform.transform(batch, 99, generator)
        losses = pva_losses(integrate(batch, model), batch, LossConfig())
        optimizer.zero_grad()
        weighted(losses, dict.fromkeys(TERMS, 1.0)).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    return time.perf_counter() - start, steps


def main() -> None:
    """Simulate, measure, print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--hours", type=float, default=8.0)
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        preset = compose("simulate", overrides=["simulated@dataset=one_imu", f"dataset.hours={options.hours}"])
    config = OmegaConf.to_container(preset, resolve=True)
    table = Table("work", "figure", title=f"{platform.machine()}, {options.threads} threads, torch {torch.__version__}")
    with tempfile.TemporaryDirectory() as folder:
        simulate_from_config(config, Path(folder) / "drives")
        data = DriveDataModule([f"{folder}/drives"], fractions=(1.0, 0.0, 0.0), batch_size=50)
        data.setup()
        pieces = cut_pieces(data.stack, 60.0)[:64]
        exact = StartLaw(0.0, 0.0, 0.0, 0.0)
        batch = make_batch(data.stack, pieces[:50], dtype=torch.float64, start=exact)
        apart = (windows(batch) - sample_loop(batch)).norm(dim=-1).max()
        slow, fast = seconds(lambda: sample_loop(batch), 1), seconds(lambda: windows(batch))
        what = "50 × 60 s × 50 Hz, forward + backward"
        table.add_row(f"sample loop, {what}, float64", f"{slow:.2f} s")
        table.add_row(f"windowed strapdown, {what}, float64", f"{fast:.3f} s ({slow / fast:.1f} × faster)")
        table.add_row("largest difference of the two after 60 s", f"{apart:.1e} m")
        single = make_batch(data.stack, pieces[:50], dtype=torch.float32, start=exact)
        table.add_row(f"windowed strapdown, {what}, float32", f"{seconds(lambda: windows(single)):.3f} s")
        filters(table, Path(folder) / "drives", imu_spec(config["imu"]))
        model = LearnedFilter(LearnedConfig()).train()
        training_epoch(data, model)
        took, steps = training_epoch(data, model)
        table.add_row(f"training epoch, {options.hours:g} h, batch 50 ({steps} steps), literal dlkf", f"{took:.1f} s")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
