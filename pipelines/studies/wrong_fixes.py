"""Filters when some positions of the receiver are wrong: outages of real drives, errors added to their fixes.

    python -m pipelines.studies.wrong_fixes --real <folder with kitti, rtkx, wid, wid_mru, linkoping>

The outages are those of :mod:`pipelines.studies.plus`. From the tenth second after the start on, fixes get errors that
the reported 1σ does not know: single ones off by 3 or 30 m (1σ per axis), or all of them by one error of 3 m for ten
seconds, about every 50 s. Writes ``table.md``: RMS / geometric mean of the horizontal error at the end of the outage
over the rows [m], mean NEES, and the ratio of ``plus`` to itself with the fixes as they are.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from pipelines.studies.plus import REAL, Case, Row, load, real_cases, score, simulated_cases
from pipelines.studies.simulated_laws import INJECTED, simulate_sets
from torch import Tensor

from dlkf.base.provenance import describe_provenance
from dlkf.command.composing import imu_preset, tuning_preset
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_causal
from dlkf.filters.integration import Estimator
from dlkf.filters.shipped import trained_filter

FIRST_S, LASTS_S, EVERY_S = 10, 10, (20, 60)  # from the start on; of a step, and the time between two
LONGEST_S = 3600


def single(share: float, size: float) -> Callable[[torch.Generator], Float[Tensor, "T 3"]]:
    """Errors [m] of 1σ ``size`` per axis in a share of the seconds."""

    def draw(g: torch.Generator) -> Tensor:
        hit = torch.rand(LONGEST_S, 1, generator=g, dtype=torch.float64) < share
        return hit * size * torch.randn(LONGEST_S, 3, generator=g, dtype=torch.float64)

    return draw


def steps(size: float) -> Callable[[torch.Generator], Float[Tensor, "T 3"]]:
    """One error [m] of 1σ ``size`` per axis for ``LASTS_S`` seconds, again and again."""

    def draw(g: torch.Generator) -> Tensor:
        errors, k = torch.zeros(LONGEST_S, 3, dtype=torch.float64), FIRST_S
        while k < LONGEST_S:
            k += int(torch.randint(*EVERY_S, (1,), generator=g))
            errors[k : k + LASTS_S] = size * torch.randn(3, generator=g, dtype=torch.float64)
            k += LASTS_S
        return errors

    return draw


ERRORS: Mapping[str, Callable[[torch.Generator], Tensor] | None] = {
    "none": None,
    "3 m in one of ten": single(0.1, 3.0),
    "1 m in one of five": single(0.2, 1.0),
    "30 m in one of twenty": single(0.05, 30.0),
    "3 m for 10 s": steps(3.0),
}


def with_errors(case: Case, draw: Callable[[torch.Generator], Tensor] | None) -> Case:
    """A case whose positions have these errors, the same in every outage of a drive."""
    if draw is None:
        return case
    batch = case.batch
    of_drives = {d: draw(torch.Generator().manual_seed(zlib.crc32(d.encode()))) for d in sorted(set(batch.drive))}
    errors = torch.stack([of_drives[d][: batch.size[1]] for d in batch.drive])
    errors[:, :FIRST_S] = 0.0
    gnss = batch.gnss.clone()
    gnss[..., :3] += torch.where(batch.gnss_valid[..., :3], errors, 0.0)
    return replace(case, batch=replace(batch, gnss=gnss))


def rivals() -> dict[str, Estimator]:
    """The constants without a gate and with it, and ``plus``."""
    imu, tuning = imu_preset("automotive_mems"), tuning_preset("any_car")
    names = ("mbkf33_car+vibration_speed", "mbkf33_car_gated+vibration_speed")
    return {**{n: build_causal(n, imu, "no", tuning=tuning) for n in names}, "plus": trained_filter("plus")}


def table(rows: Mapping[str, list[Row]]) -> list[str]:
    """A line for each kind of error."""
    names = list(next(iter(rows.values()))[0].errors)
    lines = [f"| errors | {' | '.join(names)} | plus : without errors |", f"|:--|{'--:|' * (len(names) + 1)}"]

    def means(some: list[Row], name: str) -> list[float]:
        return [float(np.exp(np.mean([np.log(mean_error(r.errors[name], s)) for r in some]))) for s in ("rms", "log")]

    clean = means(rows["none"], "plus")
    for kind, some in rows.items():
        cells = []
        for name in names:
            rms, geometric = means(some, name)
            cells.append(f"{rms:.1f} / {geometric:.2f} ({np.mean([r.nees[name] for r in some]):.1f})")
        ratio = " / ".join(f"{a / b:.2f}" for a, b in zip(means(some, "plus"), clean))
        lines.append(f"| {kind} | {' | '.join(cells)} | {ratio} |")
    return lines


def main() -> None:
    """Spoil, run, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, required=True, help="folder of real datasets")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where test sets lie, or are made")
    arguments.add_argument("--out", type=Path, default=Path("outputs/wrong_fixes"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    simulate_sets(options.data, options.real, tuple(INJECTED))
    cases: list[Case] = []
    for name in (*INJECTED, *REAL):
        drives = load((options.data if name in INJECTED else options.real) / name)
        cases += simulated_cases(name, drives) if name in INJECTED else real_cases(name, drives)
    filters, rows = rivals(), {}
    for kind, draw in ERRORS.items():
        rows[kind] = [row for case in cases for row in score(with_errors(case, draw), filters)]
        print(table(rows)[-1], flush=True)
    (options.out / "table.md").write_text("\n".join(table(rows)) + "\n")
    (options.out / "manifest.json").write_text(json.dumps(describe_provenance(), indent=1) + "\n")


if __name__ == "__main__":
    main()
