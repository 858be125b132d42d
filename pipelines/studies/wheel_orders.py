"""What the wheels' orders show on real motion: turns of a wheel per metre, and the speed against that of the reference.

    python -m pipelines.studies.wheel_orders --real data/real

Runs ``plus`` over the outages of :mod:`pipelines.studies.plus`. First table: drives in which a line was detected, and
the tyre's circumference that their ends give, least and largest. Second: in outages, the measurements of ln(true speed
/ speed of the filter) that were used; slope of a line through them and what the reference says (1: they show the error
that there is), their RMS against the reference, the RMS of their own 1σ, and that of the error before them.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pipelines.studies.plus import REAL, Case, load, real_cases
from torch import Tensor

from dlkf.filters.integration import Epoch, integrate
from dlkf.filters.plus import PlusFilter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.sources import Measurement, Predicted
from dlkf.filters.wheel_orders import OrdersMemory, WheelOrders

SETS = (*REAL, "kitti")


@dataclass(frozen=True)
class Recorded(WheelOrders):
    """Wheel orders that write down what they measure."""

    blocks: list[dict[str, Tensor]] = field(default_factory=list, compare=False)
    epochs: list[int] = field(default_factory=lambda: [0], compare=False)

    def rows(
        self, epoch: Epoch, memory: OrdersMemory, prediction: Predicted
    ) -> tuple[Measurement | None, OrdersMemory]:
        """As ever."""
        row, after = super().rows(epoch, memory, prediction)
        self.epochs[0] += 1
        if row is not None:
            block = memory.block
            step = 0.5 * (epoch.start.v_n + epoch.window.end.v_n)[:, :2].norm(dim=-1)
            said = {"z": row.z[:, 0], "R": row.R[:, 0], "used": row.used[:, 0]}
            said["mean"] = (block.distance + step) / (block.elapsed + epoch.dt * epoch.imu.shape[1])
            wheels = after.wheels
            self.blocks.append(
                said | {"detected": wheels.detected, "turns": wheels.log_turns, "epoch": torch.tensor(self.epochs[0])}
            )
        return row, after


def recorded(case: Case) -> Sequence[Mapping[str, Tensor]]:
    """The blocks of a case."""
    filter_: Any = trained_filter("plus")
    assert isinstance(filter_, PlusFilter)
    kalman = filter_.kalman
    source = Recorded(None, kalman.tuning, kalman.states)
    sources = tuple(source if isinstance(s, WheelOrders) else s for s in kalman.sources)
    filter_.kalman = replace(kalman, sources=sources)
    with torch.no_grad():
        integrate(case.batch, filter_)
    return source.blocks


def measured(case: Case, blocks: Sequence[Mapping[str, Tensor]]) -> np.ndarray:
    """(n, 3) of what was used in outages: measured and true ln(v / v̂), R."""
    speed = case.batch.truth.v_n[..., :2].norm(dim=-1)
    speed = torch.cat((case.batch.start.v_n[:, None, :2].norm(dim=-1), speed), 1).numpy()
    hidden = (~case.batch.available & case.batch.present).numpy()
    rows = []
    for block in blocks:
        last = int(block["epoch"])  # epochs last − 3 … last − 1
        within = hidden[:, last - 3 : last].all(1) & block["used"].numpy()
        true = (0.5 * speed[:, last - 3] + speed[:, last - 2] + speed[:, last - 1] + 0.5 * speed[:, last]) / 3
        ratio = np.log(true / block["mean"].numpy())
        rows.append(np.stack((block["z"].numpy(), ratio, block["R"].numpy()), 1)[within & np.isfinite(ratio)])
    return np.concatenate(rows)


def main() -> None:
    """Both tables."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, required=True, help="folder of real datasets")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    circumference = ["| data | drives | with a line | circumference [m] |", "|:--|--:|--:|--:|"]
    speeds = ["| data | measurements | slope | RMS error [%] | 1σ [%] | before [%] |", "|:--|--:|--:|--:|--:|--:|"]
    for name in SETS:
        found: dict[str, float | None] = {}
        of_set = []
        for case in real_cases(name, load(options.real / name)):
            blocks = recorded(case)
            for number, drive in enumerate(case.batch.drive):
                here = blocks[-1]["detected"][number], blocks[-1]["turns"][number]
                found[drive] = math.exp(-float(here[1])) if bool(here[0]) else found.get(drive)
            of_set.append(measured(case, blocks))
        sizes = [x for x in found.values() if x is not None]
        spread = f"{min(sizes):.3f} to {max(sizes):.3f}" if sizes else "–"
        circumference.append(f"| {name} | {len(found)} | {len(sizes)} | {spread} |")
        z, true, R = np.concatenate(of_set).T if of_set else np.empty((3, 0))
        if len(z) > 1:
            slope = float((z * true).sum() / (true * true).sum())
            cells = [100 * math.sqrt(np.mean(x)) for x in ((z - true) ** 2, R, true**2)]
            speeds.append(f"| {name} | {len(z)} | {slope:.2f} | {' | '.join(f'{c:.1f}' for c in cells)} |")
    print("\n".join([*circumference, "", *speeds]))


if __name__ == "__main__":
    main()
