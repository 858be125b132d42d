"""How well a filter tells standing from moving in outages, and what that is worth.

    python -m pipelines.studies.standstills data/fleet data/city --real data/rtkx

Segments of 60 s with GNSS, 60 s without and 5 s after it, from the truth plus an error; end to end, real ones every
10 s. Of the outages' seconds: how many the car stood at their beginning and end (slower than 1 cm/s, on real drives
10 cm/s), how many of those the filter took for a standstill, and in how many it did though the car moved faster than
0.3 m/s. Then the horizontal error at the end, RMS / median [m], over all segments and, as ratios of geometric means,
without zero-velocity updates and with those that the truth would give.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from dlkf.data.drive import Batch
from dlkf.data.masks import outage_within, withhold_fixes
from dlkf.data.segments import StartLaw, cut_segments, make_batch
from dlkf.data.stack import DriveStack
from dlkf.data.store import load_dataset
from dlkf.evaluation.bootstrap import compare
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_filter
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.model_based import Mbkf
from dlkf.filters.plus import ANY_MEMS, PlusFilter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.batched import run_filter

START = StartLaw(position_m=0.1, velocity_mps=0.1, roll_pitch_deg=1.0, yaw_deg=2.0)
BEFORE_S, OUTAGE_S, AFTER_S, REAL_STRIDE_S = 60.0, 60.0, 5.0, 10.0
SEED = 7
MOVING_SPEED = 0.3  # m/s
HEAD = ("data", "filter", "standing [s]", "found", "taken in motion", "end, RMS / median [m]", "without", "known")
Rule = Literal["found", "none", "known"]


@dataclass(frozen=True)
class Watched(CarConstraints):
    """Constraints that note in which windows they take the car for standing, and may follow another rule."""

    rule: Rule = "found"
    truth: Tensor | None = None  # (B, T) whether it stands
    seen: list[Tensor] = field(default_factory=list)

    def resting(self, epoch, turning, prediction, memory):
        """As the filter has it, never, or as the truth has it."""
        found, liveliness = super().resting(epoch, turning, prediction, memory)
        k = len(self.seen)
        self.seen.append(found)
        if self.rule == "none":
            found = torch.zeros_like(found)
        elif self.rule == "known":
            assert self.truth is not None
            found = self.truth[:, k]
        return found, liveliness


def watched(estimator: Mbkf | PlusFilter, rule: Rule, truth: Bool[Tensor, "B T"]) -> tuple[Mbkf | PlusFilter, Watched]:
    """The same filter with its constraints watched."""
    kalman = estimator.kalman if isinstance(estimator, PlusFilter) else estimator
    of_car = next(s for s in kalman.sources if isinstance(s, CarConstraints))
    eye = Watched(of_car.tuning, of_car.states, rule, truth)
    kalman = replace(kalman, sources=tuple(eye if s is of_car else s for s in kalman.sources))
    if not isinstance(estimator, PlusFilter):
        return kalman, eye
    copy = PlusFilter(estimator.config)
    copy.load_state_dict(estimator.state_dict())
    copy.kalman = kalman
    return copy.eval(), eye


def line(
    name: str, label: str, estimator: Mbkf | PlusFilter, batch: Batch, at_most: float,
    before_s: float = BEFORE_S, outage_s: float = OUTAGE_S,
) -> str:  # fmt: skip
    """One row of the table; a car stands at ``at_most`` [m/s]."""
    speed = batch.truth.v_n.norm(dim=-1)
    start = torch.cat((speed[:, :1], speed[:, :-1]), 1)
    stands, moves = (speed < at_most) & (start < at_most), (speed > MOVING_SPEED) & (start > MOVING_SPEED)
    inside = slice(round(before_s / batch.epoch_s), round((before_s + outage_s) / batch.epoch_s))
    errors, found = {}, torch.zeros_like(stands)
    for rule in ("found", "none", "known"):
        filter_, eye = watched(estimator, rule, stands)
        solution = run_filter(batch, filter_)
        off = (solution.posterior.p_n - batch.truth.p_n)[:, inside.stop - 1, :2]
        errors[rule] = off.norm(dim=-1).numpy()
        found = torch.stack(eye.seen, 1) if rule == "found" else found
    seconds = [batch.epoch_s * float(x[:, inside].sum()) for x in (stands, found & stands, found & moves)]
    ratios = [compare(errors[r], errors["found"], statistic="geomean", groups=batch.drive) for r in ("none", "known")]
    cells = [name, label, *(f"{s:.0f}" for s in seconds)]
    cells.append(f"{mean_error(errors['found'], 'rms'):.1f} / {np.median(errors['found']):.1f}")
    for r in ratios:
        band = "" if np.isnan(r.ratio_low) else f" [{r.ratio_low:.2f}, {r.ratio_high:.2f}]"
        cells.append(f"{r.ratio:.2f}{band}")
    return f"| {' | '.join(cells)} |"


def outages(folder: str, stride_s: float | None) -> Batch:
    """Segments of a dataset with an outage, every ``stride_s``, else end to end."""
    stack = DriveStack(load_dataset(folder, rate_hz=50.0, epoch_s=1.0, dtype=torch.float64))
    length = BEFORE_S + OUTAGE_S + AFTER_S
    segments = cut_segments(stack, length, stride_s or length)
    generator = torch.Generator().manual_seed(SEED)
    batch = make_batch(stack, segments, dtype=torch.float64, start=START, generator=generator)
    return withhold_fixes(batch, outage_within(batch, BEFORE_S, OUTAGE_S))


def main(argv: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*", help="simulated datasets")
    parser.add_argument("--real", nargs="*", default=[], help="real datasets, cut every 10 s")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    classical = build_filter("mbkf21_car", imu_spec(ANY_MEMS), tuning=Tuning())
    plus = trained_filter("plus")
    assert isinstance(classical, Mbkf) and isinstance(plus, PlusFilter)
    print(f"| {' | '.join(HEAD)} |\n|:--|:--|{'--:|' * (len(HEAD) - 2)}")
    for folder in (*args.data, *args.real):
        real = folder in args.real
        batch = outages(folder, REAL_STRIDE_S if real else None)
        for label, estimator in (("mbkf21_car", classical), ("plus", plus)):
            print(line(Path(folder).name, label, estimator, batch, 0.1 if real else 0.01), flush=True)


if __name__ == "__main__":
    main()
