"""What the compiled epoch is worth: ``python -m pipelines.studies.compiled_step --models mbkf21_car plus``.

Old and new run interleaved in one process on a simulated drive, since the machine's speed varies: processor time of one
thread, the best of some rounds. Then the time of one epoch: in Python by torch, in Python compiled, and the call in C.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from dlkf.data.alignment import ALIGN
from dlkf.data.store import load_dataset
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.navigation.imu_errors import ImuSpec, SensorErrors
from dlkf.onboard.check import Latency, measure_latencies
from dlkf.onboard.compiled_filter import CompiledFilter, compile_filter
from dlkf.running.batched import run_filter
from dlkf.running.start import align_drives
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.tracking.models import resolve_model

IMU = ImuSpec("mems", SensorErrors(noise_density=2.5e-3, turn_on_bias=0.02), SensorErrors(9e-5, turn_on_bias=1e-3))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", nargs="+", default=["mbkf15", "mbkf21", "mbkf21_car", "plus", "dlkf"])
    parser.add_argument("--rate", type=float, default=100.0, help="Hz")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        gnss, minutes = GnssConfig(lever_arm_b=(1.0, 0.3, -1.2)), options.minutes
        config = DatasetConfig("one", hours=minutes / 60, drive_minutes=minutes, gnss=gnss)
        data = simulate_dataset(config, IMU, 0, Path(folder) / "data", progress=False, workers=1)
        for name in options.models:
            report(name, data, 50.0 if name == "dlkf" else options.rate, options.rounds)


def report(name: str, data: Path, rate_hz: float, rounds: int) -> None:
    """Three lines of one model."""
    drive = load_dataset(data, rate_hz=rate_hz, dtype=torch.float64)[0]
    compiled = compile_filter(model_of(name), rate_hz, 1.0)
    batch = align_drives([drive], ALIGN)
    for drives in (1, 64):
        many = batch.select(torch.zeros(drives, dtype=torch.int64))
        many = replace(many, imu=many.imu + 1e-9 * torch.randn_like(many.imu))  # no drive a copy of another
        spent = [[processor_time(f, many) for f in (compiled.estimator, compiled)] for _ in range(rounds)]
        old, new = (min(x) for x in zip(*spent))
        samples = drives * many.size[1] * many.size[2]
        print(f"{name}, {rate_hz:g} Hz, {drives} drives: {samples / old:,.0f} → {samples / new:,.0f} IMU epochs/s, "
              f"{old / new:.1f} ×", flush=True)  # fmt: skip
    for kind, x in {**measure_latencies(compiled, drive), "C": Latency.of(times_in_c(compiled, batch))}.items():
        print(f"{name}, an epoch in {kind}: p50 {x.p50:.4f} ms, p99 {x.p99:.4f} ms", flush=True)


def model_of(name: str):
    """A filter by name; ``dlkf`` of the paper's sizes with fresh weights, whose values do not change its speed."""
    if name != "dlkf":
        return resolve_model(name, IMU)
    settings = {"outage_mode": "run", "frame": "heading", "imu_error": "affine", "imu_error_bound": 4.0}
    return LearnedFilter(LearnedConfig.from_mapping({**settings, "network": {"dropout": 0.0}})).eval()


def processor_time(estimator, batch) -> float:
    """Of one run [s]."""
    began = time.process_time()
    run_filter(batch, estimator)
    return time.process_time() - began


def times_in_c(compiled: CompiledFilter, batch) -> list[float]:
    """Seconds of the epochs' calls alone, memory and samples at hand."""
    memory, _ = compiled.begin(batch)
    numbers, seconds = memory.numbers, []
    fix = torch.zeros(1, 19, dtype=torch.float64)
    for k in range(20, batch.size[1]):
        imu = batch.imu[:, k].contiguous()
        began = time.perf_counter()
        numbers, _ = compiled.library.turn(numbers, imu, fix)
        seconds.append(time.perf_counter() - began)
    return seconds


if __name__ == "__main__":
    main()
