"""The streaming filter on the road: time per call, and hours of driving with everything that goes wrong.

    python -m pipelines.studies.streaming latency [--minutes 7]
    python -m pipelines.studies.streaming road --model mbkf15_gated --hours 10 --faults

``road``: one simulated drive at 50 Hz; position error, memory, covariance, and with ``--faults`` 5 % of the fixes
100 m off, half a minute of frozen fixes every half hour and ten minutes without any every two hours.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
import yaml
from rich.console import Console
from rich.table import Table

from dlkf.base.config import config_dir
from dlkf.data.tables import Columns
from dlkf.filters.build import build_filter
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.filters.smoother import Filter
from dlkf.navigation.geodetic import geodetic_from_ecef
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.replay import replay_drive
from dlkf.running.streaming import Status, StreamingFilter
from dlkf.simulation.drive import Rates, Seeds, simulate_drive
from dlkf.simulation.gnss.surroundings import Surroundings
from dlkf.simulation.gnss.white import GnssConfig
from dlkf.simulation.imu import draw_unit
from dlkf.simulation.motion.chassis import ChassisConfig
from dlkf.simulation.motion.routes import VehicleConfig

ARM = (1.0, 0.3, -1.2)
SPEC = imu_spec(yaml.safe_load((config_dir() / "imu" / "consumer.yaml").read_text()))
METRES = 6.37e6 * np.pi / 180  # per degree
GOOD, OUTLIER, FROZEN, MISSING = range(4)


def simulated(seconds: int, rate_hz: int, seed: int) -> tuple[Columns, Columns, Columns]:
    """IMU, GNSS and reference at 1 Hz of one drive."""
    seeds, unit = Seeds(*np.random.SeedSequence(seed).spawn(5)), draw_unit(np.random.default_rng(seed), SPEC)
    tables = simulate_drive(
        seeds, seconds, Rates(rate_hz, 1.0, 1), VehicleConfig(), ChassisConfig(), Surroundings(), SPEC, unit,
        GnssConfig(lever_arm_b=ARM),
    )  # fmt: skip
    imu, gnss, reference = ({str(c): f[c].to_numpy() for c in f} for f in (tables.imu, tables.gnss, tables.reference))
    return imu, gnss, reference


def spoiled(gnss: Columns) -> tuple[Columns, np.ndarray]:
    """The fixes with faults, and what is wrong with each."""
    n, rng = len(gnss["t"]), np.random.default_rng(1)
    gnss, fault = {c: x.copy() for c, x in gnss.items()}, np.full(n, GOOD)
    off, angle = rng.random(n) < 0.05, rng.uniform(0, 2 * np.pi, n)
    gnss["lat_deg"][off] += 100 * np.cos(angle[off]) / METRES
    gnss["lon_deg"][off] += 100 * np.sin(angle[off]) / METRES / np.cos(np.radians(gnss["lat_deg"][off]))
    fault[off] = OUTLIER
    for k in range(600, n - 700, 1800):
        fault[k + 1 : k + 31] = FROZEN
        for c in set(gnss) - {"t"}:
            gnss[c][k + 1 : k + 31] = gnss[c][k]
    for k in range(4500, n - 700, 7200):
        fault[k : k + 600] = MISSING
    return gnss, fault


def road(model: str, hours: float, faults: bool, anchor_m: float, seed: int) -> Iterator[str]:
    """Drive, and report once an hour and at the end."""
    imu, gnss, reference = simulated(round(hours * 3600), 50, seed)
    fault = np.full(len(gnss["t"]), GOOD)
    if faults:
        gnss, fault = spoiled(gnss)
    heard = {c: x[fault != MISSING] for c, x in gnss.items()}
    stream = StreamingFilter(build_filter(model, SPEC), rate_hz=50.0, lever_arm_b=ARM, anchor_m=anchor_m)
    error = np.full(len(fault), np.nan)
    frames, asymmetry, smallest = set(), 0.0, np.inf
    for receipt in replay_drive(stream, imu, heard):
        for e in receipt.estimates:
            lat, lon, _ = (float(x) for x in geodetic_from_ecef(e.frame.to_ecef(e.state.p_n)))
            k = round(e.t)
            north, east = np.degrees(lat) - reference["lat_deg"][k], np.degrees(lon) - reference["lon_deg"][k]
            error[k] = METRES * np.hypot(north, east * np.cos(lat))
            frames.add(tuple(e.frame.origin_e[0].tolist()))
            running: Any = stream._epochs.running
            if k % 60 == 0 and hasattr(running.memory, "P"):
                P = running.memory.P[0]
                sigma = P.diagonal().sqrt()
                asymmetry = max(asymmetry, float((P - P.T).abs().max()))
                smallest = min(smallest, float(torch.linalg.eigvalsh(P / torch.outer(sigma, sigma))[0]))
            if k % 3600 == 100:
                yield f"{k / 3600:5.2f} h: the stream takes {len(pickle.dumps(stream)):,} bytes, {len(frames)} frames"
    yield f"asymmetry of P {asymmetry:g}, smallest eigenvalue of its correlations {smallest:.3g}, {dict(stream.counts)}"
    for name, kind in (("good", GOOD), ("100 m off", OUTLIER), ("frozen", FROZEN), ("missing", MISSING)):
        e = error[(fault == kind) & np.isfinite(error)]
        if len(e):
            p50, p99 = np.percentile(e, [50, 99])
            yield f"{name}: {len(e)} epochs, error p50 {p50:.3f} m, p99 {p99:.3f} m, max {e.max():.2f} m"
    for name, kind in (("frozen", FROZEN), ("missing", MISSING)):
        ends = np.flatnonzero((fault[:-1] == kind) & (fault[1:] != kind))
        for k in ends[ends + 61 < len(error)]:
            after = ", ".join(f"+{s} s {error[k + s]:.2f}" for s in (1, 2, 5, 10, 60))
            yield f"{name} until {k / 3600:.2f} h: {error[k]:.2f} m, then {after}"


def latency(minutes: float) -> Table:
    """Time of the calls, fixes on time and 150 ms late; the processor's time is free of other work's."""
    imu, gnss, _ = simulated(round(60 * minutes), 100, 0)
    table = Table("filter", "fixes", "call", "p50 [ms]", "p99 [ms]", "processor p50 [ms]", "p99 [ms]")
    filters: dict[str, Filter] = {m: build_filter(m, SPEC) for m in ("mbkf15", "mbkf21_nhc", "mbkf15_gated")}
    filters["dlkf (2.2 M weights)"] = LearnedFilter(LearnedConfig()).eval()
    for name, estimator in filters.items():
        for late in (0.0, 0.15):
            stream = StreamingFilter(estimator, lever_arm_b=ARM)
            took = {"sample": [], "sample that ends an epoch": [], "fix": [], "fix after its epoch": [], "now()": []}
            feed = replay_drive(stream, imu, gnss, (gnss["t"] + late).tolist())
            fixes = count = 0
            while True:
                wall, own = time.perf_counter(), time.thread_time()
                if (receipt := next(feed, None)) is None:
                    break
                spent = time.perf_counter() - wall, time.thread_time() - own
                is_fix, fixes = sum(stream.counts.values()) > fixes, sum(stream.counts.values())
                ends = receipt.status is Status.REPLAYED if is_fix else bool(receipt.estimates)
                took[("fix after its epoch" if ends else "fix") if is_fix else
                     ("sample that ends an epoch" if ends else "sample")].append(spent)  # fmt: skip
                if (count := count + 1) % 37 == 0 and not stream.aligning:
                    wall, own = time.perf_counter(), time.thread_time()
                    stream.now()
                    took["now()"].append((time.perf_counter() - wall, time.thread_time() - own))
            for call, times in took.items():
                if len(times) > 50:
                    values = np.percentile(1e3 * np.array(times[10:]), [50, 99], axis=0).T.flatten()
                    fixes_come = f"{1e3 * late:.0f} ms late" if late else "on time"
                    table.add_row(name, fixes_come, call, *(f"{x:.3f}" for x in values))
    return table


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("latency", "road"))
    parser.add_argument("--minutes", type=float, default=7.0)
    parser.add_argument("--model", default="mbkf21_nhc")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--anchor-m", type=float, default=5000.0)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.what == "latency":
        Console(width=120).print(latency(options.minutes))
    else:
        for line in road(options.model, options.hours, options.faults, options.anchor_m, options.seed):
            print(line, flush=True)


if __name__ == "__main__":
    main()
