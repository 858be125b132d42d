"""Speed, all from one run: ``make bench`` or ``python -m pipelines.studies.benchmark [--threads 2] [--hours 8]``.

Windowed strapdown against a loop over samples, filters in torch and compiled for one drive and for 64, an epoch by
itself, tuning, training epochs of the learned filters, and how cost goes with hours, drives, length, rate, batch and
threads. Beside them python-ins on the same drive; on request
KF-GINS (``--kf-gins FOLDER``, a checkout). Prints a table with bars, writes ``outputs/bench.json``
(median, least, 99th percentile of the repeats of every figure, the machine, the commit), draws ``outputs/bench.png``.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import torch
from pipelines.studies import kf_gins, parity
from pipelines.studies.figures.bench_figures import Bench, Timing, machine
from rich.console import Console

from dlkf.command.composing import compose_command, imu_preset
from dlkf.command.simulated import compose_recipe
from dlkf.data.alignment import ALIGN
from dlkf.data.datamodule import DriveDataModule
from dlkf.data.drive import Batch
from dlkf.data.segments import StartLaw, cut_segments, make_batch
from dlkf.data.store import load_dataset
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol
from dlkf.filters.build import build_causal
from dlkf.filters.integration import Estimator, integrate
from dlkf.filters.saved import build_learned_filter, parse_learned_settings
from dlkf.navigation.attitude import rotation_from_vector
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.strapdown import strapdown
from dlkf.onboard.check import time_epochs
from dlkf.onboard.compiled_filter import CompiledFilter, compile_filter
from dlkf.onboard.library import find_compiler
from dlkf.running.batched import run_filter
from dlkf.running.start import align_drives
from dlkf.simulation.dataset import simulate
from dlkf.tracking.models import resolve_model
from dlkf.training.callbacks.masking import GnssDecimation, OutageInjection
from dlkf.training.loss import TERMS, LossConfig, pva_losses, weighted_loss
from dlkf.tuning.search import list_factors, tune_filter
from dlkf.tuning.study import withhold_outages

COMPILED = ("mbkf15", "mbkf21", "mbkf21_car", "plus")
LEARNED = ("dlkf_literal", "dlkf", "plus")
PARTS = ("strapdown", "filters", "epochs", "peers", "tuning", "training", "scaling")
RATE_HZ = 100.0  # of the files
SECONDS = "IMU epochs a second"


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


def filters(bench: Bench, dataset: Path, imu: ImuSpec, length_s: float, models: list[str]) -> None:
    """Filters over drives at the files' own rate, one and 64 at once, in torch and compiled, interleaved."""
    drives = load_dataset(dataset, rate_hz=RATE_HZ, dtype=torch.float64)
    segments = (cut_segments(drives, length_s) * 64)[:64]
    for name in models:
        estimator = resolve_model(name, imu)
        in_c = compile_filter(estimator, RATE_HZ, 1.0) if find_compiler() else None
        for count in (1, 64):
            batch = make_batch(drives, segments[:count], dtype=torch.float64)
            what = f"{name}, {count} drive{'s' * (count > 1)} of {batch.size[1] * batch.epoch_s:g} s"
            calls = {f"{what}, torch": lambda batch=batch, f=estimator: run_filter(batch, f)}
            if in_c is not None:
                calls[f"{what}, compiled"] = lambda batch=batch, f=in_c: run_filter(batch, f)
            bench.in_turns(f"filter, {SECONDS}", calls, 3, count * batch.size[1] * batch.size[2])


def epochs(bench: Bench, dataset: Path, imu: ImuSpec, models: list[str]) -> None:
    """One epoch with its fix by itself: in Python by torch and compiled, and the call in C."""
    drive = load_dataset(dataset, rate_hz=RATE_HZ, dtype=torch.float64)[0]
    batch = align_drives([drive], ALIGN)
    for name in models if find_compiler() else ():
        in_c = compile_filter(resolve_model(name, imu), RATE_HZ, 1.0)
        for kind, seconds in {**time_epochs(in_c, drive), "C": times_in_c(in_c, batch)}.items():
            bench.add(Timing("an epoch", f"{name} in {kind}", seconds))


def times_in_c(compiled: CompiledFilter, batch: Batch) -> list[float]:
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


def peers(bench: Bench, folder: Path, minutes: float, checkout: Path | None) -> None:
    """python-ins on the same drive with the same states, and KF-GINS' engine where it is at hand."""
    spec = imu_preset("consumer")
    parity.write_drives(folder, spec, 1, minutes)
    drives = load_dataset(folder, rate_hz=RATE_HZ, dtype=torch.float64)
    batch = make_batch(
        drives, cut_segments(drives, drives[0].epochs - 1.0)[:1], dtype=torch.float64, start=parity.START
    )
    samples = batch.size[1] * batch.size[2]
    _, seconds = parity.theirs(folder, batch, spec, 21, 0.1)
    bench.add(Timing(f"peer, {SECONDS}", "python-ins, 21 states, 0.1 s", [seconds], samples))
    bench.time(f"peer, {SECONDS}", "mbkf21, torch", lambda: parity.ours(batch, spec, 21, score=False), 3, samples)
    if checkout is not None:
        beside = kf_gins.measure(checkout, list(COMPILED), kf_gins.MINUTES, kf_gins.ROUNDS)
        for name, (seconds, samples, _) in beside.items():
            bench.add(Timing(f"beside KF-GINS, {SECONDS}", name, seconds, samples))


def tuning(bench: Bench, dataset: Path, imu: ImuSpec) -> None:
    """A search over all factors of a filter on sixty segments of two minutes."""
    drives = load_dataset(dataset, rate_hz=50.0, dtype=torch.float64)
    segments = withhold_outages(drives, Protocol(outage=OutagePlan(60.0, 60.0)), 60)
    factors, count = len(list_factors("mbkf21_car")), sum(b.size[0] for b in segments)
    work = f"mbkf21_car, {factors} factors, {count} segments of 120 s"
    bench.time("tuning", work, lambda: tune_filter(imu, segments, name="mbkf21_car"), 1)


def training_epoch(data: DriveDataModule, name: str, steps: int | None = None) -> None:
    """An epoch with decimation, outages, backward pass and optimiser, or so many steps of it."""
    settings = compose_command("train", f"filter@model={name}")["model"]
    torch.manual_seed(0)
    model = build_learned_filter(parse_learned_settings(settings)).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)
    transforms = (GnssDecimation(), OutageInjection(start_epoch=0))
    for step in range(steps or len(data.train_segments(1))):
        batch = data.train_batch(1, step)
        generator = torch.Generator().manual_seed(step)
        for transform in transforms:
            batch = transform.transform(batch, 99, generator)
        losses = pva_losses(integrate(batch, model), batch, LossConfig())
        optimizer.zero_grad()
        weighted_loss(losses, dict.fromkeys(TERMS, 1.0)).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()


def training(bench: Bench, folder: str, hours: float) -> None:
    """Epochs of the learned filters, interleaved, on one thread as a training runs unless set otherwise."""
    data = DriveDataModule([folder], fractions=(1.0, 0.0, 0.0), batch_size=50)
    data.setup()
    what = f"{hours:g} h, batch 50, {len(data.train_segments(1))} steps"
    with kf_gins.one_thread():
        calls = {f"{name}, {what}": lambda name=name: training_epoch(data, name) for name in LEARNED}
        bench.in_turns("training epoch, one thread", calls, 2)


def scaling(bench: Bench, dataset: Path, imu: ImuSpec, length_s: float) -> None:
    """What the cost of a work grows with; ``mbkf15`` in torch, but compiled for threads."""
    drives = load_dataset(dataset, rate_hz=RATE_HZ, dtype=torch.float64)
    estimator: Estimator = build_causal("mbkf15", imu, "the loop does not")
    usual = torch.get_num_threads()

    def run(over: str, at: float, what: str, count: int, chosen: list, of: list = drives) -> None:
        batch = make_batch(of, (chosen * count)[:count], dtype=torch.float64)
        with torch.inference_mode():
            bench.time(f"over {over}", f"mbkf15, {what}", lambda: integrate(batch, estimator), 3, at=at)

    for count in (1, 4, 16, 64):
        run("drives at once", count, f"{count} × {length_s:g} s", count, cut_segments(drives, length_s))
    for length in (length_s / 4, length_s / 2, length_s):
        run("length (s)", length, f"8 × {length:g} s", 8, cut_segments(drives, length))
    for rate in (25.0, 50.0, RATE_HZ):
        slower = load_dataset(dataset, rate_hz=rate, dtype=torch.float64)
        run("rate (Hz)", rate, f"8 × {length_s:g} s at {rate:g} Hz", 8, cut_segments(slower, length_s), slower)
    if find_compiler():  # its threads share nothing; those of torch wait for each other, for minutes on a busy machine
        usual_clock, bench.clock = bench.clock, time.perf_counter  # two threads use two processors
        estimator = compile_filter(estimator, RATE_HZ, 1.0)
        for threads in sorted({1, 2, os.cpu_count() or 1}):
            torch.set_num_threads(threads)
            what = f"64 × {length_s:g} s, compiled, {threads} threads"
            run("threads", threads, what, 64, cut_segments(drives, length_s))
        torch.set_num_threads(usual)
        bench.clock = usual_clock
    for count in sorted({max(1, len(drives) * part // 4) for part in (1, 2, 4)}):
        some = [d.name for d in drives[:count]]
        work = f"load, check and cut, {count} drives"
        at = sum(d.epochs * d.epoch_s for d in drives[:count]) / 3600
        bench.time(
            "over hours", work, lambda some=some: cut_segments(load_dataset(dataset, drives=some), 60.0), 3, at=at
        )
    data = DriveDataModule([str(dataset)], fractions=(1.0, 0.0, 0.0), batch_size=50)
    data.setup()
    for size in (10, 25, 50, 100):
        data.batch_size, data._latest = size, (-1, -1, [])
        if len(data.train_segments(1)[0]) == size:
            work = f"dlkf_literal, a step of {size} segments"
            bench.time("over batch", work, lambda: training_epoch(data, "dlkf_literal", 1), 3, at=size)


def mechanisation(bench: Bench, folder: str, length_s: float) -> float:
    """Windows against the loop over samples, forward and backward; returns how far apart they end [m]."""
    drives = load_dataset(folder, dtype=torch.float64)
    segments = cut_segments(drives, length_s)[:50]
    what = f"{len(segments)} × {length_s:g} s × 50 Hz, forward + backward"
    batch, single = (
        make_batch(drives, segments, dtype=dtype, start=StartLaw(0.0, 0.0, 0.0, 0.0))
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
    arguments.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    arguments.add_argument("--models", nargs="+", default=list(COMPILED))
    arguments.add_argument("--processor", action="store_true", help="time of the processor: for a machine that is busy")
    arguments.add_argument("--kf-gins", type=Path, help="a checkout of KF-GINS, whose engine is compiled and run too")
    arguments.add_argument("--out", type=Path, default=Path("outputs"))
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    recipe = compose_recipe("simulated@dataset=one_imu", f"dataset.hours={options.hours}")
    bench = Bench(options.repeats, time.process_time if options.processor else time.perf_counter)
    described = machine(options.threads) | {"clock": "processor" if options.processor else "wall"}
    console = Console(width=140)
    with tempfile.TemporaryDirectory() as folder:
        data, other = Path(folder) / "drives", Path(folder) / "parity"
        simulate(recipe, data)
        if "strapdown" in options.parts:
            apart = mechanisation(bench, str(data), length_s := min(60.0, options.length_s))
            console.print(f"loop and windows end {apart:.1e} m apart after {length_s:g} s: the loop is first order")
        works = {
            "filters": lambda: filters(bench, data, recipe.imu, options.length_s, options.models),
            "epochs": lambda: epochs(bench, data, recipe.imu, options.models),
            "peers": lambda: peers(bench, other, 1.0, options.kf_gins),
            "tuning": lambda: tuning(bench, data, recipe.imu),
            "training": lambda: training(bench, str(data), options.hours),
            "scaling": lambda: scaling(bench, data, recipe.imu, options.length_s),
        }
        for part, work in works.items():
            if part in options.parts:
                console.print(f"{part} …")
                work()
    title = f"{described['processor']}, {options.threads} threads, {described['clock']} time, torch {torch.__version__}"
    console.print(bench.table(title))
    bench.write(options.out, described)
    console.print(f"{options.out}/bench.json, {options.out}/bench.png")


if __name__ == "__main__":
    main()
