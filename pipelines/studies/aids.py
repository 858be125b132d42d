"""What wheel speed is worth: the same filters with and without it, over outages of 30 to 600 s, and what it costs.

    for kind in all obd; do python -m dlkf.simulate dataset=fleet sensors=$kind dataset.hours=3 seed=31 \\
        dataset.drive_minutes=15 out=data/fleet_$kind; done
    python -m pipelines.studies.aids data/fleet_all data/fleet_obd --aids speed --lengths 30 60 120 --first 150
    python -m pipelines.studies.aids data/fleet_all --aids speed --lengths 600 --first 240
    python -m pipelines.studies.aids data/fleet_all --lengths 60 --first 150
    python -m pipelines.studies.aids real/wid real/wid_mru --lengths 30 60 --first 45
    python -m pipelines.studies.aids data/fleet_all --cost

Writes a table per dataset to stdout, as Markdown. Every filter sees the same outages, one after the other with as much
GNSS between them; errors are horizontal, at the end of an outage. The interval of a ratio is that of the paired
bootstrap over recordings (:mod:`dlkf.evaluation.bootstrap`); of fewer than eight there is none. ``--cost``: processor
time of an update with each sensor of the dataset and without, alternately in one run.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dlkf.base.errors import InputError
from dlkf.command.composing import imu_preset, tuning_preset
from dlkf.data.aid_tables import AidTable
from dlkf.data.drive import Batch
from dlkf.data.segments import whole_drives
from dlkf.data.store import choose_aids, drive_rows, load_dataset
from dlkf.evaluation.bootstrap import compare
from dlkf.filters.aids.attach import aid_columns, find_tables, with_aids
from dlkf.filters.integration import BatchSolution, Estimator, Fix, advance
from dlkf.filters.smoother import Filter
from dlkf.navigation.calibration import ImuError
from dlkf.onboard.compiled_filter import CompiledFilter, compile_filter
from dlkf.onboard.functions import pack_fix
from dlkf.running.batched import run_filter
from dlkf.running.start import align_each
from dlkf.tracking.models import resolve_model

TIMED = 120  # updates of one drive that are timed
TURNS = 5  # of which the fastest counts


def aligned_batch(folder: str) -> Batch:
    """The drives of a dataset that can be aligned, from there on."""
    drives = load_dataset(folder, dtype=torch.float64)
    good = [(d, start) for d, start in zip(drives, align_each(drives)) if not isinstance(start, InputError)]
    return whole_drives([d for d, _ in good], [start for _, start in good])


def hide(batch: Batch, first: int, length: int) -> tuple[Batch, torch.Tensor]:
    """The batch without the fixes of outages, and (B, T) where one ends that the truth can score."""
    step = torch.arange(batch.size[1])
    into = torch.where(step >= first, (step - first) % (2 * length), 2 * length)
    hidden = (into < length).expand(batch.size[0], -1)
    whole = batch.present.roll(-1, 1)  # the outage lies inside the drive
    ends = (into == length - 1) & batch.truth_valid & batch.present & whole
    return replace(batch, available=batch.available & ~hidden), ends


def end_errors(batch: Batch, solution: BatchSolution, ends: torch.Tensor) -> np.ndarray:
    """Horizontal errors [m] where outages end."""
    error = (solution.posterior.p_n - batch.truth.p_n)[..., :2].norm(dim=-1)
    return error[ends].numpy()


def distances(batch: Batch, ends: torch.Tensor, length: int) -> np.ndarray:
    """Metres driven in each outage."""
    speed = torch.nan_to_num(batch.truth.v_n[..., :2].norm(dim=-1)) * batch.epoch_s
    way = speed.cumsum(1)
    return (way - way.roll(length, 1))[ends].numpy()


def found(solution: BatchSolution, model: Filter, batch: Batch) -> str:
    """What was estimated of the sensors at the end of each drive, the median over the drives, and what was refused."""
    if solution.aids is None:
        return "–"
    last = batch.present.sum(-1) - 1
    rows = dict(zip(aid_columns(model), solution.aids.unbind(-1)))
    end = {n: rows[n][torch.arange(len(last)), last].numpy() for n in ("wheel_scale", "wheel_delay_s") if n in rows}
    said = [f"{n} {np.median(x):.4f}" for n, x in end.items()]
    if "speed_used" in rows:
        seen = rows["speed_innovation"].isfinite() & batch.present
        said.append(f"{100 * float(1 - rows['speed_used'][seen].mean()):.1f} % refused")
    return ", ".join(said)


def statistics(error: np.ndarray, way: np.ndarray) -> str:
    """Geometric mean, median, RMS [m], and the median share of the way [%]."""
    mean = float(np.exp(np.log(error + 1e-3).mean()))
    share = float(np.median(error / way.clip(1.0)))
    return f"{mean:.2f}, {np.median(error):.2f}, {np.sqrt((error**2).mean()):.2f}, {100 * share:.2f}"


def ratio(ours: np.ndarray, theirs: np.ndarray, groups: Sequence[str], statistic: str = "geomean") -> str:
    """Of a statistic of errors, with its interval where there are recordings enough."""
    c = compare(ours, theirs, statistic=statistic, groups=groups)
    return f"{c.ratio:.2f}" if np.isnan(c.ratio_low) else f"{c.ratio:.2f} [{c.ratio_low:.2f}, {c.ratio_high:.2f}]"


def print_errors(
    folder: str, models: Sequence[str], lengths: Sequence[int], first: int, imu: str, tuning: str,
    chosen: Sequence[str] | None,
) -> None:  # fmt: skip
    """A table of one dataset."""
    spec, batch, tables = imu_preset(imu), aligned_batch(folder), choose_aids(folder, chosen)
    group_of = {row.name: row.group for row in drive_rows(folder)}
    aids = "+".join(table.name for table in tables)
    about = "geometric mean, median, RMS [m], % of distance"
    print(f"\n{Path(folder).name}, first outage after {first} s\n")
    print(f"| outage [s] | n | recordings | filter | without: {about} | with {aids} | ratio of geom. means | found |")
    print("|--:|--:|--:|:--|--:|--:|--:|:--|")
    for length in lengths:
        hidden, ends = hide(batch, first, length)
        if not ends.any():
            continue
        way = distances(batch, ends, length)
        groups = [group_of[batch.drive[int(row)]] for row in ends.nonzero()[:, 0]]
        for name in models:
            plain = resolve_model(name, spec, tuning=tuning_preset(tuning))
            aided = with_aids(plain, tables)
            solution = run_filter(hidden, aided)
            without, with_them = (end_errors(batch, s, ends) for s in (run_filter(hidden, plain), solution))
            print(
                f"| {length} | {len(groups)} | {len(set(groups))} | `{name}` | {statistics(without, way)} | "
                f"{statistics(with_them, way)} | {ratio(with_them, without, groups)} | "
                f"{found(solution, aided, batch)} |",
                flush=True,
            )


def print_costs(folder: str, models: Sequence[str], imu: str) -> None:
    """Time of an update with each sensor and without, 99th percentile: by torch, compiled, and the call in C."""
    spec, tables = imu_preset(imu), choose_aids(folder, None)
    batch = aligned_batch(folder).select(torch.tensor([0]))
    batch = replace(batch, present=batch.present & (torch.arange(batch.size[1]) < TIMED)).trim()
    print(f"\n{Path(folder).name}, one drive, {TIMED} updates\n")
    print("| filter | sensor | torch [ms], ratio | compiled [ms], ratio | in C [ms], ratio |\n|:--|:--|--:|--:|--:|")
    for name in models:
        plain = resolve_model(name, spec)
        sets: list[list[AidTable]] = [[], *([t] for t in tables), list(tables)]
        filters = [with_aids(plain, some) for some in sets]
        ways = [(model, compile_filter(model, 1 / batch.dt, batch.epoch_s)) for model in filters]
        turns = [[update_times(model, compiled, batch) for model, compiled in ways] for _ in range(TURNS)]
        p99 = 1e3 * np.quantile(np.min(turns, 0), 0.99, -1)  # (sets, ways)
        for some, times in zip(sets, p99):
            cells = [f"{x:.3f}, {x / without:.2f}" for x, without in zip(times, p99[0])]
            sensors = " + ".join(t.name for t in some) or "none"
            print(f"| `{name}` | {sensors} | {' | '.join(cells)} |", flush=True)


def update_times(model: Estimator, compiled: CompiledFilter, batch: Batch) -> np.ndarray:
    """(3, T) processor seconds of every update of one drive: by torch, compiled, and the call in C alone."""
    memory, bias = model.begin(batch)
    numbers, _ = compiled.begin(batch)
    state, error, frame = batch.start, ImuError.of(bias), batch.frame.prepare()
    seconds = np.zeros((3, batch.size[1]))
    usable = batch.gnss_valid & batch.available.unsqueeze(-1)
    with torch.inference_mode():
        for k in range(batch.size[1]):
            aids = {name: rows[:, k] for name, rows in batch.aids.items()}
            fix = Fix(batch.gnss[:, k], batch.gnss_std[:, k], usable[:, k], batch.gnss_lag[:, k], aids)
            imu, packed = batch.imu[:, k].contiguous(), pack_fix(fix, find_tables(model))
            began = time.process_time()
            memory, step = advance(
                model, memory, state, error, imu, fix, dt=batch.dt, frame=frame, lever_arm_b=batch.lever_arm_b
            )
            torched = time.process_time()
            after, _ = compiled.advance(numbers, imu, fix, frame)
            done = time.process_time()
            compiled.library.turn(numbers.numbers, imu, packed)
            seconds[:, k] = torched - began, done - torched, time.process_time() - done
            numbers, state, error = after, step.posterior, step.error
    return seconds


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("datasets", nargs="+")
    words.add_argument("--models", nargs="+", default=["mbkf21_car", "plus"])
    words.add_argument("--lengths", nargs="+", type=int, default=[30, 60, 120])
    words.add_argument("--first", type=int, default=150, help="s of GNSS before the first outage")
    words.add_argument("--imu", default="automotive_mems")
    words.add_argument("--tuning", default="any_car", help="of conf/tuning; plus has its own")
    words.add_argument("--aids", nargs="+", help="of speed, heading, baro; all that the dataset has")
    words.add_argument("--cost", action="store_true", help="what an update costs, instead of errors")
    options = words.parse_args()
    for folder in options.datasets:
        if options.cost:
            print_costs(folder, options.models, options.imu)
        else:
            print_errors(
                folder, options.models, options.lengths, options.first, options.imu, options.tuning, options.aids
            )


if __name__ == "__main__":
    main()
