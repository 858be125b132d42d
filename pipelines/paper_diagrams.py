"""Figures 1, 2, 3 and 5 of the paper, drawn anew: the loop, the two filters in it, the network, the vehicle.

    python pipelines/paper_diagrams.py                 outputs/paper/diagrams/figure1.png ... figure5.png

``paper_report.py`` has them on its page. The layers of figure 3 and their sizes are read from the filter that
``model=dlkf_literal`` makes, the distances of figure 5 are those of the paper's text (R104).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from torch import nn

from dlkf.base.colours import COLOURS
from dlkf.base.files import write_into
from dlkf.evaluation.figures import png
from dlkf.filters.learned import LearnedConfig, LearnedFilter
from dlkf.networks.features import CNN_CHANNELS, COMPONENTS

Place = tuple[float, float]
Box = tuple[float, float, float, float, str]  # centre, width, height, text
SENSOR, SHARED, ANSWER = "#E8F1FA", "#FFFFFF", "#FBEBDD"  # what measures, what all filters share, what they differ in
AHEAD_M, ROOF_M = 0.69, 1.34  # second antenna ahead of the rear axle, both above it (R104)

CAPTIONS = {
    "figure1": "Figure 1 (drawn anew): loosely coupled integration with a model-based Kalman filter",
    "figure2": "Figure 2 (drawn anew): the same loop with the network in the filter's place",
    "figure3": "Figure 3 (drawn anew): the network, sizes read from model=dlkf_literal",
    "figure5": "Figure 5 (drawn anew from the text): antennas on the test vehicle; outline not to scale",
}


def main() -> int:
    """Draw and write all of them."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--out", type=Path, default=Path("outputs/paper/diagrams"))
    out: Path = arguments.parse_args().out
    with write_into(out) as folder:
        for name, figure in diagrams().items():
            (folder / f"{name}.png").write_bytes(png(figure))
    print(f"{len(CAPTIONS)} figures in {out}")
    return 0


def diagrams() -> dict[str, Figure]:
    """The figures by name."""
    network = LearnedFilter(LearnedConfig())
    return {
        "figure1": loop_figure(KALMAN),
        "figure2": loop_figure(LEARNED),
        "figure3": network_figure(network),
        "figure5": vehicle_figure(),
    }


KALMAN = {
    "filter": "Kalman filter, 15 states\nP = Φ P Φᵀ + Q,  K = P Hᵀ (H P Hᵀ + R)⁻¹\nP = (I − K H) P (I − K H)ᵀ + K R Kᵀ",
    "correction": "δp, δv, δh = K z  (rows 1–9)",
    "error": "biases: K z added\n(rows 10–15)",
}
LEARNED = {
    "filter": (
        "CNN-LSTM\nin: a second of position, velocity, attitude and raw IMU,\n"
        "differences of posteriors and of fixes, innovation\nout: gain K (9 × 6), complete IMU error (6)"
    ),
    "correction": "δp, δv, δh = K z",
    "error": "IMU error, set\nby the network",
    "window": "position, velocity,\nattitude, raw IMU",
}


def loop_figure(words: Mapping[str, str]) -> Figure:
    """One filter step of :mod:`dlkf.filters.integration`: what measures, what is shared, who answers."""
    figure, axes = _canvas(9.6, 4.6, (0, 96), (0, 46))
    boxes: dict[str, Box] = {
        "imu": (9, 38, 14, 8, "IMU\nf, ω"),
        "sum": (29, 38, 14, 8, "take off\nIMU error"),
        "ins": (52, 38, 18, 8, "strapdown\np, v, C"),
        "out": (84, 38, 20, 8, "solution\np, v, C, IMU error"),
        "gnss": (9, 22, 14, 8, "GNSS receiver\np, v"),
        "z": (34, 22, 24, 8, "innovation\nz = GNSS − predicted"),
        "filter": (34, 6, 48, 11, words["filter"]),
        "back": (82, 6, 24, 8, words["correction"]),
    }
    fills = {"imu": SENSOR, "gnss": SENSOR, "filter": ANSWER, "back": ANSWER}
    for name, box in boxes.items():
        _box(axes, box, fills.get(name, SHARED))
    for path in (
        [(16, 38), (22, 38)], [(36, 38), (43, 38)], [(61, 38), (74, 38)], [(16, 22), (22, 22)],
        [(48, 34), (48, 22), (46, 22)], [(34, 18), (34, 11.5)], [(58, 6), (70, 6)],
        [(82, 10), (82, 29), (59, 29), (59, 34)], [(19, 11.5), (19, 30), (25, 30), (25, 34)],
    ):  # fmt: skip
        _arrow(axes, path)
    small = {"fontsize": 7, "color": "#444444"}
    axes.text(70, 29.6, "corrections are added", ha="center", **small)
    axes.text(47.5, 28, "predicted\nposition, velocity", ha="right", **small)
    axes.text(18.4, 14, words["error"], ha="right", va="center", **small)
    if "window" in words:
        _arrow(axes, [(55, 34), (55, 11.5)])
        axes.text(55.8, 17, words["window"], va="center", **small)
    axes.text(2, 44, "blue: sensors; orange: what differs between filters; white: shared by all filters", **small)
    return figure


def network_figure(filter: LearnedFilter) -> Figure:
    """The layers of a filter's network, from left to right, with their sizes."""
    net, samples = filter.network, filter.config.network.samples
    convolutions = [m for m in net.cnn if isinstance(m, nn.Conv1d)]
    dense = [m for m in net.dense if isinstance(m, nn.Linear)]
    cells = list(net.lstm)
    figure, axes = _canvas(11.5, 4.2, (0, 115), (0, 42))
    cnn = "\n".join(f"Conv1d {c.in_channels} → {c.out_channels}, kernel {c.kernel_size[0]}" for c in convolutions)
    components = (
        f"{COMPONENTS} numbers\n9  posteriors, difference\n9  last correction\n6  fixes, difference\n6  innovation"
    )
    dropout = "".join(f"dropout {m.p:g}" for m in net.dense if isinstance(m, nn.Dropout))
    boxes: list[Box] = [
        (10, 32, 18, 10, f"window, {samples} × {CNN_CHANNELS}\np, v, attitude (INS)\nf, ω (raw IMU)"),
        (36, 32, 24, 10, f"{cnn}\nLeakyReLU"),
        (10, 11, 18, 15, components),
        (36, 11, 24, 8, f"side by side\n{samples} + {COMPONENTS} = {cells[0].input_size}"),
        (62, 21, 18, 10, f"LSTM\n{len(cells)} layers of {cells[0].hidden_size}"),
        (84, 21, 18, 14, "\n".join(["dense", *(f"{d.in_features} → {d.out_features}" for d in dense), dropout])),
        (106, 32, 16, 9, "gain K\n9 × 6"),
        (106, 10, 16, 9, "IMU error\n6 numbers"),
    ]  # fmt: skip
    fills = [SENSOR, SHARED, SENSOR, SHARED, SHARED, SHARED, ANSWER, ANSWER]
    for box, fill in zip(boxes, fills):
        _box(axes, box, fill)
    for path in (
        [(19, 32), (24, 32)], [(36, 27), (36, 15)], [(19, 11), (24, 11)], [(48, 11), (62, 11), (62, 16)],
        [(71, 21), (75, 21)],
        [(93, 24), (95.5, 24), (95.5, 32), (98, 32)], [(93, 18), (95.5, 18), (95.5, 10), (98, 10)],
    ):  # fmt: skip
        _arrow(axes, path)
    count = sum(p.numel() for p in filter.parameters())
    axes.text(84, 9, f"{count / 1e6:.2f} million weights", fontsize=8, ha="center")
    return figure


def vehicle_figure() -> Figure:
    """Top and side view with the places of the antennas that the text gives; the outline is a stand-in."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    side, top = figure.subplots(1, 2)
    for axes, title in ((side, "side view"), (top, "top view")):
        axes.set_title(title, fontsize=9)
        axes.set_aspect("equal")
        axes.axis("off")
    side.set_ylim(-0.5, 2.0)
    x = [-0.9, -0.85, -0.2, 0.9, 1.7, 2.9, 3.4, 3.5, -0.9]
    z = [0.1, 0.8, ROOF_M, ROOF_M, 0.85, 0.75, 0.45, 0.1, 0.1]
    side.fill(x, z, facecolor=SENSOR, edgecolor="#444444")
    for wheel in (0.0, 2.6):
        side.add_patch(Circle((wheel, 0.0), 0.31, facecolor="#777777", edgecolor="#222222"))
    side.plot([-1.2, 3.8], [-0.31, -0.31], color="#222222", linewidth=1)
    top.add_patch(
        FancyBboxPatch(
            (-0.9, -0.85), 4.4, 1.7, boxstyle="round,pad=0,rounding_size=0.3", facecolor=SENSOR, edgecolor="#444444"
        )
    )
    top.plot([0, 0], [-0.8, 0.8], color="#777777", linewidth=3)
    for place, colour, name in (
        (0.0, COLOURS[1], "NavXperience 3G+C: RTK receiver, reference"),
        (AHEAD_M, COLOURS[0], "Tallysman TW7972: standard receiver"),
    ):
        side.plot([place], [ROOF_M + 0.06], "^", color=colour, markersize=9)
        top.plot([place], [0], "^", color=colour, markersize=9, label=name)
    side.annotate("", (-1.05, 0), (-1.05, ROOF_M), arrowprops={"arrowstyle": "<->"})
    side.text(-1.12, ROOF_M / 2, f"{ROOF_M} m", rotation=90, va="center", ha="right", fontsize=8)
    side.plot([-1.05, 0], [0, 0], color="#444444", linewidth=0.6, linestyle=":")
    for axes, height in ((side, ROOF_M + 0.32), (top, 0.25)):
        axes.annotate("", (0, height), (AHEAD_M, height), arrowprops={"arrowstyle": "<->"})
        axes.text(AHEAD_M / 2, height + 0.08, f"{AHEAD_M} m", ha="center", fontsize=8)
    side.add_patch(Rectangle((-0.7, 0.3), 0.4, 0.25, facecolor=ANSWER, edgecolor="#444444"))
    side.text(-0.5, 0.42, "box", ha="center", va="center", fontsize=6)
    top.text(0, -0.95, "rear axle", ha="center", va="top", fontsize=8)
    top.legend(loc="lower center", bbox_to_anchor=(0.5, -0.35), fontsize=7, frameon=False)
    return figure


def _canvas(width: float, height: float, x: Place, y: Place) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.axis("off")
    return figure, axes


def _box(axes: Axes, box: Box, fill: str) -> None:
    x, y, width, height, text = box
    corner = (x - width / 2, y - height / 2)
    axes.add_patch(
        FancyBboxPatch(
            corner, width, height, boxstyle="round,pad=0,rounding_size=1", facecolor=fill, edgecolor="#444444"
        )
    )
    axes.text(x, y, text, ha="center", va="center", fontsize=8)


def _arrow(axes: Axes, path: Sequence[Place]) -> None:
    """Straight parts through the places; the head is at the last."""
    for a, b in pairwise(path[:-1]):
        axes.plot(*zip(a, b), color="#222222", linewidth=1)
    axes.annotate(
        "", path[-1], path[-2], arrowprops={"arrowstyle": "-|>", "color": "#222222", "shrinkA": 0, "shrinkB": 0}
    )


if __name__ == "__main__":
    sys.exit(main())
