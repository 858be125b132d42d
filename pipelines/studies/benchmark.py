"""Speed, all from one run: ``make bench`` or ``python -m pipelines.studies.benchmark [--threads 2] [--hours 8]``.

Windowed strapdown against a loop over samples, Kalman filters for one drive and for 64, training epochs of the learned
filters, and how cost goes with drives, length and batch. Prints a table with bars and writes ``outputs/bench.json``:
median and least of the repeats of every figure, the machine and the commit. The other half of the comparison,
python-ins on the same files, is ``pipelines/studies/parity.py``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from dlkf.command.composing import composed
from dlkf.command.simulated import composed_recipe
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Batch
from dlkf.data.segments import StartLaw, cut_pieces, make_batch
from dlkf.data.store import load_dataset
from dlkf.files import staged
from dlkf.filters.build import build_causal
from dlkf.filters.integration import integrate
from dlkf.filters.saved import learned_filter, learned_settings
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.strapdown import strapdown
from dlkf.provenance import provenance
from dlkf.simulation.dataset import simulate
from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted

KALMAN = ("mbkf15", "mbkf21", "mbkf21_nhc")
LEARNED = ("dlkf_literal", "dlkf", "plus")
BAR = 24


@dataclass
class Figure:
    """A work's times by its repeats; with ``units`` what is told is units a second."""

    group: str
    work: str
    seconds: list[float]
    units: float = 0.0  # of work in a repeat, for a rate

    @property
    def median(self) -> float:
        """Seconds, or units a second."""
        middle = statistics.median(self.seconds)
        return self.units / middle if self.units else middle

    @property
    def best(self) -> float:
        """Of the least time."""
        return self.units / min(self.seconds) if self.units else min(self.seconds)

    def text(self, x: float) -> str:
        """With its unit."""
        return f"{x:,.0f} /s" if self.units else f"{x:.3f} s"


@dataclass
class Bench:
    """Figures of a run."""

    most_repeats: int = 9
    figures: list[Figure] = field(default_factory=list)

    def time(self, group: str, work: str, call: Callable[[], object], repeats: int = 5, units: float = 0.0) -> Figure:
        """Wall times of a call after one warm-up."""
        call()
        times = []
        for _ in range(min(repeats, self.most_repeats)):
            start = time.perf_counter()
            call()
            times.append(time.perf_counter() - start)
        self.figures.append(Figure(group, work, times, units))
        return self.figures[-1]

    def table(self, title: str) -> Table:
        """Median, best and a bar against the largest of the group."""
        table = Table("work", "median", "best", "", title=title)
        for group in dict.fromkeys(f.group for f in self.figures):
            rows = [f for f in self.figures if f.group == group]
            table.add_section()
            for f in rows:
                bar = "█" * max(1, round(BAR * f.median / max(r.median for r in rows)))
                table.add_row(f"{group}: {f.work}", f.text(f.median), f.text(f.best), bar)
        return table

    def write(self, folder: Path, machine: dict) -> None:
        """``bench.json``, whole or not at all."""
        rows = [asdict(f) | {"median": f.median, "best": f.best} for f in self.figures]
        with staged(folder) as beside:
            text = json.dumps({"machine": machine, **provenance(), "figures": rows}, indent=1)
            (beside / "bench.json").write_text(text, encoding="utf-8")


def machine(threads: int) -> dict:
    """What the figures depend on."""
    info = Path("/proc/cpuinfo")
    models = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.is_file() else []
    return {
        "processor": models[0].partition(":")[2].strip() if models else platform.processor(),
        "cores": os.cpu_count(),
        "load_1_min": round(os.getloadavg()[0], 1),
        "threads": threads,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "system": platform.platform(),
    }


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


def filters(bench: Bench, dataset: Path, imu: ImuSpec, length_s: float) -> None:
    """The Kalman filters over drives at the file's own 100 Hz, and what drives and length cost."""
    drives = load_dataset(dataset, rate_hz=100, dtype=torch.float64, reference=True)
    pieces = (cut_pieces(drives, length_s) * 8)[:64]

    def run(group: str, name: str, count: int, chosen: list) -> None:
        batch = make_batch(drives, chosen[:count], dtype=torch.float64)
        estimator = build_causal(name, imu, "the loop does not")
        with torch.inference_mode():
            samples = count * batch.size[1] * batch.size[2]
            what = f"{name}, {count} drive{'s' * (count > 1)} of {batch.size[1] * batch.epoch_s:g} s"
            bench.time(group, what, lambda: integrate(batch, estimator), 3, samples)

    for name in KALMAN:
        for count in (1, 64):
            run("filter, IMU epochs", name, count, pieces)
    for count in (1, 4, 16, 64):
        run("over drives, IMU epochs", "mbkf15", count, pieces)
    for length in (length_s / 4, length_s / 2, length_s):
        run("over length, IMU epochs", "mbkf15", 8, cut_pieces(drives, length) * 8)


def training_epoch(data: DriveDataModule, name: str, steps: int | None = None) -> None:
    """An epoch with decimation, outages, backward pass and optimiser, or so many steps of it."""
    settings = composed("train", f"filter@model={name}")["model"]
    torch.manual_seed(0)
    model = learned_filter(learned_settings(settings)).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)
    transforms = (GnssDecimation(), OutageInjection(start_epoch=0))
    for step in range(steps or len(data.train_pieces(1))):
        batch = data.train_batch(1, step)
        generator = torch.Generator().manual_seed(step)
        for transform in transforms:
            batch = transform.transform(batch, 99, generator)
        losses = pva_losses(integrate(batch, model), batch, LossConfig())
        optimizer.zero_grad()
        weighted(losses, dict.fromkeys(TERMS, 1.0)).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()


def training(bench: Bench, folder: str, hours: float) -> None:
    """Epochs of the learned filters, and what the batch costs."""
    data = DriveDataModule([folder], fractions=(1.0, 0.0, 0.0), batch_size=50)
    data.setup()
    for name in LEARNED:
        work = f"{name}, {hours:g} h, batch 50, {len(data.train_pieces(1))} steps"
        bench.time("training epoch", work, lambda name=name: training_epoch(data, name), 2)
    for size in (10, 25, 50, 100):
        data.batch_size, data._latest = size, (-1, -1, [])
        if len(data.train_pieces(1)[0]) == size:
            work = f"dlkf_literal, batch {size}, pieces"
            bench.time("over batch", work, lambda: training_epoch(data, "dlkf_literal", 1), 3, size)


def mechanisation(bench: Bench, folder: str) -> float:
    """Windows against the loop over samples, forward and backward; returns how far apart they end [m]."""
    drives = load_dataset(folder, dtype=torch.float64)
    pieces = cut_pieces(drives, 60.0)[:50]
    what = f"{len(pieces)} × 60 s × 50 Hz, forward + backward"
    batch, single = (
        make_batch(drives, pieces, dtype=dtype, start=StartLaw(0.0, 0.0, 0.0, 0.0))
        for dtype in (torch.float64, torch.float32)
    )
    bench.time("strapdown", f"sample loop, {what}, float64", lambda: sample_loop(batch), 1)
    bench.time("strapdown", f"windows, {what}, float64", lambda: windows(batch))
    bench.time("strapdown", f"windows, {what}, float32", lambda: windows(single))
    return float((windows(batch) - sample_loop(batch)).norm(dim=-1).max())


def main() -> None:
    """Simulate, measure, print, write."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--hours", type=float, default=8.0)
    arguments.add_argument("--length-s", type=float, default=300.0, help="of the drives that filters run over")
    arguments.add_argument("--repeats", type=int, default=9, help="at most, of every figure")
    arguments.add_argument("--out", type=Path, default=Path("outputs"))
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    recipe = composed_recipe("simulated@dataset=one_imu", f"dataset.hours={options.hours}")
    bench, described = Bench(options.repeats), machine(options.threads)
    with tempfile.TemporaryDirectory() as folder:
        simulate(recipe, Path(folder) / "drives")
        apart = mechanisation(bench, f"{folder}/drives")
        filters(bench, Path(folder) / "drives", recipe.imu, options.length_s)
        training(bench, f"{folder}/drives", options.hours)
    console = Console(width=140)
    console.print(bench.table(f"{described['processor']}, {options.threads} threads, torch {torch.__version__}"))
    console.print(f"loop and windows end {apart:.1e} m apart after 60 s: the loop is first order")
    bench.write(options.out, described)
    console.print(f"{options.out}/bench.json")


if __name__ == "__main__":
    main()
