"""Whether samples tell a stationary car from a moving one, and what of its standstills a filter finds in outages.

    python -m pipelines.studies.standstills data/plus/others --real data/real/rtkx data/real/wid data/real/wid_mru

A row for each dataset, of its seconds at rest (below 0.1 m/s at both ends) and in motion (above 1 m/s): the median
vibration level at rest, the level that 0.5 % of the seconds in motion are below, and the share of the seconds at rest
that are below it, for the level of all samples and for that of means over 0.1 s
(:mod:`dlkf.filters.stationarity`). Then ``plus`` over the outages of :mod:`pipelines.studies.plus`: seconds at rest
in them, those of them that it found, and seconds in motion (above 0.3 m/s) that it took for a standstill.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from pipelines.studies.plus import Case, load, real_cases, simulated_cases
from torch import Tensor

from dlkf.data.drive import Drive
from dlkf.filters.constraints import CarConstraints, CarMemory
from dlkf.filters.integration import Epoch, integrate
from dlkf.filters.plus import PlusFilter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.sources import Predicted
from dlkf.filters.stationarity import AVERAGE_S, VibrationLevel, vibration_level

STANDING, MOVING, TAKEN = 0.1, 1.0, 0.3  # m/s
LEAST = 0.005  # share of the seconds in motion
KINDS = ("all samples", f"means over {AVERAGE_S:g} s")


def vibration_levels(drives: Iterable[Drive]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) of the seconds at rest and of those in motion, by :data:`KINDS`."""
    at_rest, in_motion = [], []
    for drive in drives:
        n = round(AVERAGE_S * drive.rate_hz)
        means = drive.imu.unflatten(1, (-1, n)).mean(2)
        level = torch.stack((vibration_level(drive.imu), vibration_level(means)), -1)
        speed = drive.ref_v_e.norm(dim=-1)
        speed = torch.stack((speed[:-1], speed[1:]), -1)
        known = drive.ref_valid[:-1] & drive.ref_valid[1:]
        at_rest.append(level[known & (speed.amax(-1) < STANDING)])
        in_motion.append(level[known & (speed.amin(-1) > MOVING)])
    return torch.cat(at_rest).numpy(), torch.cat(in_motion).numpy()


@dataclass(frozen=True)
class Recorded(CarConstraints):
    """Constraints that write down where they find a standstill."""

    found: list[Tensor] = field(default_factory=list, compare=False)

    def detect_rest(
        self, epoch: Epoch, turning: Float[Tensor, "B 3"], prediction: Predicted, memory: CarMemory
    ) -> tuple[Bool[Tensor, " B"], VibrationLevel, Float[Tensor, "B 3"]]:
        """As without recording."""
        resting, level, variance = super().detect_rest(epoch, turning, prediction, memory)
        self.found.append(resting)
        return resting, level, variance


def count_standstills(cases: Iterable[Case]) -> tuple[int, int, int, int]:
    """Seconds of outages at rest, those found, seconds in motion, those taken for a standstill."""
    total = np.zeros(4, int)
    for case in cases:
        filter_: Any = trained_filter("plus")
        assert isinstance(filter_, PlusFilter)
        sources, found = [], []
        for s in filter_.kalman.sources:
            is_car = isinstance(s, CarConstraints)
            sources.append(Recorded(s.tuning, s.states, found, adapts_noise=s.adapts_noise) if is_car else s)
        filter_.kalman = replace(filter_.kalman, sources=tuple(sources))
        batch = case.batch
        with torch.no_grad():
            integrate(batch, filter_)
        speed = torch.cat((batch.start.v_n[:, None], batch.truth.v_n), 1)[..., :2].norm(dim=-1)
        speed = torch.stack((speed[:, :-1], speed[:, 1:]), -1)
        outage = ~batch.available & batch.present & batch.truth_valid
        rest, motion = outage & (speed.amax(-1) < STANDING), outage & (speed.amin(-1) > TAKEN)
        taken = torch.stack(found, 1)
        total += [int(x.sum()) for x in (rest, rest & taken, motion, motion & taken)]
    return tuple(int(x) for x in total)  # type: ignore[return-value]


def format_row(name: str, drives: Sequence[Drive], cases: Iterable[Case]) -> str:
    """The row of a dataset in the table."""
    rest, motion = vibration_levels(drives)
    if not len(rest) or not len(motion):
        raise SystemExit(f"{name}: no second at rest, or none in motion")
    least = np.quantile(motion, LEAST, axis=0)
    cells = [name, str(len(rest)), str(len(motion))]
    for k in range(len(KINDS)):
        below = np.mean(rest[:, k] < least[k])
        cells += [f"{np.median(rest[:, k]):.1e}", f"{least[k]:.1e}", f"{100 * below:.0f} %"]
    return f"| {' | '.join((*cells, *map(str, count_standstills(cases))))} |"


def main() -> None:
    """A table of all datasets."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("datasets", nargs="*", type=Path, help="simulated datasets")
    arguments.add_argument("--real", nargs="+", type=Path, default=[], help="real ones, from their own alignment")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    head = ["data", "at rest [s]", "in motion [s]"]
    head += [f"{x}, {kind}" for kind in KINDS for x in ("level at rest", "least in motion", "rest below it")]
    head += ["at rest in outages [s]", "found", "in motion [s]", "taken"]
    print(f"| {' | '.join(head)} |\n|:--|{'--:|' * (len(head) - 1)}")
    for folder, cases in (*((x, real_cases) for x in options.real), *((x, simulated_cases) for x in options.datasets)):
        drives = load(folder)
        print(format_row(folder.name, drives, cases(folder.name, drives)), flush=True)


if __name__ == "__main__":
    main()
