"""Memory and time of a training step over the length of its pieces: ``python -m pipelines.studies.training_memory``.

Each row is a process of its own with one thread: batches as the experiments take them (the literal network 50 pieces,
``plus`` 64 with its likelihood, which keeps covariances), 50 Hz, forward and backward. Told are the largest resident
memory of the process, how much of it came with the step, and the processor time of the step.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

import torch

from dlkf.command.simulated import composed_recipe
from dlkf.data.datamodule import DriveDataModule
from dlkf.filters.integration import integrate
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.plus import PlusConfig, PlusFilter
from dlkf.simulation.dataset import simulate
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted

MODELS = {"dlkf_literal": (LearnedFilter, LearnedConfig, 50, False), "plus": (PlusFilter, PlusConfig, 64, True)}


def peak_gb() -> float:
    """Largest resident memory of this process so far [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def step(drives: str, name: str, length_s: float) -> str:
    """A row of the table, of the second of two steps."""
    torch.set_num_threads(1)
    kind, config, pieces, covariances = MODELS[name]
    data = DriveDataModule([drives], fractions=(1.0, 0.0, 0.0), batch_size=pieces, length_s=length_s)
    data.setup()
    batch, model = data.train_batch(1, 0), kind(config()).train()
    if len(batch.imu) < pieces:
        batch = batch.select(torch.arange(pieces) % len(batch.imu))
    before, taken = peak_gb(), []
    for _ in range(2):
        began = time.process_time()
        solution = integrate(batch, model, keep_covariances=covariances)
        weighted(pva_losses(solution, batch, LossConfig()), dict.fromkeys(TERMS, 1.0)).backward()
        taken.append(time.process_time() - began)
    B, T = batch.size[:2]
    return f"| `{name}` | {B} × {T} s | {peak_gb():.2f} GB | {peak_gb() - before:.2f} GB | {taken[-1]:.1f} s |"


def main() -> None:
    """Simulate, and a process for every row."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    arguments.add_argument("--lengths", nargs="+", type=float, default=[60, 135, 270])
    o = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        drives = Path(folder) / "drives"
        minutes = f"dataset.drive_minutes={max(o.lengths) / 60 + 1}"
        simulate(composed_recipe("simulated@dataset=one_imu", "dataset.hours=1", minutes), drives)
        print("| | batch | whole process | of it the step | processor |\n|:--|:--|--:|--:|--:|", flush=True)
        for name in o.models:
            for length_s in o.lengths:
                with multiprocessing.get_context("spawn").Pool(1) as alone:
                    print(alone.apply(step, (str(drives), name, length_s)), flush=True)


if __name__ == "__main__":
    main()
