"""Kalman gains of filters (R130–R137; figures 7–9 of the paper).

A gain (9 × 6) takes innovations of position and velocity to corrections of position, velocity and attitude, here in
North-East-Down: blocks K_pp [1], K_pv [s], K_vp [1/s], K_vv [1], K_hp [rad/m], K_hv [rad s/m].
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from dlkf.base.files import write_into
from dlkf.data.masks import withhold_fixes
from dlkf.evaluation.figures import png
from dlkf.evaluation.metrics import Array
from dlkf.evaluation.run import Scene
from dlkf.filters.smoother import Filter
from dlkf.running.batched import run_filter

BLOCKS = {"K_pp": (0, 0), "K_pv": (0, 3), "K_vp": (3, 0), "K_vv": (3, 3)}  # first row and column of their diagonals
ROWS = ("N", "E", "D", "v_N", "v_E", "v_D", "roll", "pitch", "yaw")
COLUMNS = ROWS[:6]


@dataclass(frozen=True)
class Gains:
    """Gain of one filter at the last fix of every segment (P, 9, 6), and mean and spread over all its fixes."""

    last: Array
    mean: Array  # (9, 6) over the fixes of all segments, the first ``settle_s`` of each left out
    std: Array  # (9, 6) likewise

    def block(self, name: str) -> float:
        """Mean of the diagonal of a block of :data:`BLOCKS`, over the segments' last fixes."""
        row, column = BLOCKS[name]
        return float(np.mean([self.last[:, row + k, column + k] for k in range(3)]))


def measure_gains(
    filters: Mapping[str, Filter], scenes: Iterable[Scene], *, settle_s: float = 10.0
) -> dict[str, Gains]:
    """Gains of those filters that have one."""
    last: dict[str, list[Array]] = {}
    used: dict[str, list[Array]] = {}
    for batch, mask in scenes:
        masked = withhold_fixes(batch, mask)
        for name, estimator in filters.items():
            solution = run_filter(masked, estimator)
            if solution.gain is None:
                continue
            K, fix = solution.gain.double().cpu(), solution.used.cpu()
            at = (fix * torch.arange(1, fix.shape[1] + 1)).argmax(1)
            last.setdefault(name, []).append(K[torch.arange(len(at)), at].numpy())
            settled = fix & (torch.arange(1, fix.shape[1] + 1) * batch.epoch_s > settle_s)
            used.setdefault(name, []).append(K[settled].numpy())
    return {
        name: Gains(np.concatenate(rows), np.concatenate(used[name]).mean(0), np.concatenate(used[name]).std(0))
        for name, rows in last.items()
    }


def write_gains(out: Path, gains: Mapping[str, Gains], title: str) -> None:
    """``gains.json`` (last gain of one segment, mean, spread, mean block diagonals) and ``figures/gains.png``."""
    content = {
        name: {
            "last": g.last[0].tolist(),
            "mean": g.mean.tolist(),
            "std": g.std.tolist(),
            **{block: g.block(block) for block in BLOCKS},
        }
        for name, g in gains.items()
    }
    with write_into(out) as folder:
        (folder / "gains.json").write_text(json.dumps(content, indent=1) + "\n")
        (folder / "figures").mkdir()
        panels = [(name, g.last[0]) for name, g in gains.items()]
        figure = heat_map(panels, len(panels), f"{title}: gain at the last fix of one segment")
        (folder / "figures" / "gains.png").write_bytes(png(figure, 100))


def heat_map(gains: Sequence[tuple[str, Array]], columns: int, title: str) -> Figure:
    """Gains (9, 6) side by side, every number in its cell; colour saturates at ±1."""
    rows = -(-len(gains) // columns)
    figure = Figure(figsize=(4.6 * columns, 5.0 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for ax, (name, K) in zip(axes, gains):
        image = ax.imshow(K, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
        for (i, j), value in np.ndenumerate(K):
            shade = "white" if abs(value) > 0.6 else "black"
            ax.text(j, i, _short(float(value)), ha="center", va="center", fontsize=7, color=shade)
        ax.set_title(name, fontsize=10)
        ax.set_xticks(range(6), COLUMNS, fontsize=8)
        ax.set_yticks(range(9), ROWS, fontsize=8)
        ax.set_xlabel("innovation [m, m/s]", fontsize=8)
    for ax in axes[len(gains) :]:
        ax.set_visible(False)
    figure.colorbar(image, ax=list(axes), shrink=0.6, label="gain")
    figure.suptitle(title, fontsize=11)
    return figure


def _short(value: float) -> str:
    return "0" if abs(value) < 5e-5 else f"{value:.2f}" if abs(value) >= 0.01 else f"{value:.0e}".replace("e-0", "e-")
