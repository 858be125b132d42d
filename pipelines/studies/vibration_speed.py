"""What the spectrum of the vibration says of the speed on real motion, against the speed of the reference.

    python -m pipelines.studies.vibration_speed --real data/real --figure docs/figures/vibration.png

Runs ``plus`` over the outages of :mod:`pipelines.studies.plus`. A row for each dataset: the drives, and those whose
spectrum was trusted at the end of a run; then, of the measurements of ln(true speed / speed of the filter) that were
used in outages: how many, which share of the blocks in motion they are, the slope of a line through them and what the
reference says (1: they show the error that there is), their RMS against the reference, their own 1σ, and the RMS of the
error before them. Each counts with 1/R, as the filter weighs it.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from pipelines.studies.plus import REAL, Case, load, real_cases
from torch import Tensor

from dlkf.filters.integration import Epoch, integrate
from dlkf.filters.plus import PlusFilter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.sources import Measurement, Predicted
from dlkf.filters.vibration_spectrum import lines
from dlkf.filters.vibration_speed import VibrationMemory, VibrationSpeed
from dlkf.report.navigation import SHOWS

SETS = (*REAL, "kitti")


@dataclass(frozen=True)
class Recorded(VibrationSpeed):
    """A source that writes down what it measures."""

    blocks: list[dict[str, Tensor]] = field(default_factory=list, compare=False)
    epochs: list[int] = field(default_factory=lambda: [0], compare=False)

    def rows(
        self, epoch: Epoch, memory: VibrationMemory, prediction: Predicted
    ) -> tuple[Measurement | None, VibrationMemory]:
        """As ever."""
        row, after = super().rows(epoch, memory, prediction)
        self.epochs[0] += 1
        if row is not None:
            block = memory.block
            step = 0.5 * (epoch.start.v_n + epoch.window.end.v_n)[:, :2].norm(dim=-1)
            said = {"z": row.z[:, 0], "R": row.R[:, 0], "used": row.used[:, 0]}
            said["mean"] = (block.distance + step) / (block.elapsed + epoch.dt * epoch.imu.shape[1])
            self.blocks.append(
                said | {"share": after.share, "epoch": torch.tensor(self.epochs[0]), "shape": after.by_distance.value}
            )
        return row, after


def recorded(case: Case) -> Sequence[Mapping[str, Tensor]]:
    """The blocks of a case."""
    filter_: Any = trained_filter("plus")
    assert isinstance(filter_, PlusFilter)
    kalman = filter_.kalman
    source = Recorded(None, kalman.tuning, kalman.states)
    sources = tuple(source if isinstance(s, VibrationSpeed) else s for s in kalman.sources)
    filter_.kalman = replace(kalman, sources=sources)
    with torch.no_grad():
        integrate(case.batch, filter_)
    return source.blocks


def measured(case: Case, blocks: Sequence[Mapping[str, Tensor]]) -> np.ndarray:
    """(n, 4) of blocks in outages in motion: measured and true ln(v / v̂), R, and whether it was used."""
    speed = case.batch.truth.v_n[..., :2].norm(dim=-1)
    speed = torch.cat((case.batch.start.v_n[:, None, :2].norm(dim=-1), speed), 1).numpy()
    hidden = (~case.batch.available & case.batch.present).numpy()
    rows = []
    for block in blocks:
        last = int(block["epoch"])  # epochs last − 3 … last − 1
        within = hidden[:, last - 3 : last].all(1) & (block["mean"].numpy() > 3)
        true = (0.5 * speed[:, last - 3] + speed[:, last - 2] + speed[:, last - 1] + 0.5 * speed[:, last]) / 3
        ratio = np.log(true / block["mean"].numpy())
        said = np.stack((block["z"].numpy(), ratio, block["R"].numpy(), block["used"].numpy()), 1)
        rows.append(said[within & np.isfinite(ratio)])
    return np.concatenate(rows)


def draw(shapes: Mapping[str, Sequence[Tensor]], file: Path) -> None:
    """The learned shapes of pitch rate and vertical acceleration, mean and each drive."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
    F = lines(torch.empty(0, dtype=torch.float64)).numpy()
    for ax, axis, title in zip(axes, (4, 2), ("pitch rate", "vertical acceleration")):
        for k, (name, of) in enumerate(shapes.items()):
            every = torch.stack([shape[axis] for shape in of]).numpy()
            ax.plot(F, every.T, color=f"C{k}", lw=0.4, alpha=0.3)
            ax.plot(F, every.mean(0), color=f"C{k}", lw=1.6, label=name)
        ax.set(title=title, xlabel="spatial frequency [cycles/m]", xlim=(F[0], F[-1]))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("ln power less its trend")
    axes[1].legend(fontsize=8)
    figure.savefig(file, dpi=130)


def main() -> None:
    """The table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, required=True, help="folder of real datasets")
    arguments.add_argument("--figure", type=Path, help="picture of the learned shapes")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    print("| data | drives | trusted | measurements | of blocks [%] | slope | RMS error [%] | 1σ [%] | before [%] |")
    print(f"|:--|{'--:|' * 8}")
    shapes: dict[str, list[Tensor]] = {}
    for name in SETS:
        of_drive: dict[str, Tensor] = {}
        trusted: dict[str, bool] = {}
        of_set = []
        for case in real_cases(name, load(options.real / name)):
            blocks = recorded(case)
            for drive, share, shape in zip(case.batch.drive, blocks[-1]["share"], blocks[-1]["shape"]):
                of_drive[drive] = shape
                trusted[drive] = trusted.get(drive, False) or float(share) > SHOWS
            of_set.append(measured(case, blocks))
        shapes[name] = list(of_drive.values())
        every = np.concatenate(of_set)
        z, true, R, _ = every[every[:, 3] > 0].T
        cells = [name, str(len(trusted)), str(sum(trusted.values())), str(len(z)), f"{100 * len(z) / len(every):.0f}"]
        if len(z) > 1:
            cells.append(f"{(z * true / R).sum() / (true * true / R).sum():.2f}")
            cells += [f"{100 * math.sqrt(np.average(x, weights=1 / R)):.1f}" for x in ((z - true) ** 2, R, true**2)]
        print(f"| {' | '.join(cells)} |", flush=True)
    if options.figure is not None:
        draw(shapes, options.figure)


if __name__ == "__main__":
    main()
