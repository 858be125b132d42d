"""How a training went, on the page of its evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dlkf.base.colours import COLOURS
from dlkf.report.drawing import Figure
from dlkf.report.plots import line, stack_panels

ABOUT = (
    "Training has the weights, outages and decimated fixes of its epoch, validation equal weights: their levels "
    "are not comparable."
)
LOSSES = {"train/loss": "training", "val/loss": "validation"}
AT_END = "val/outage_end_m"


def learning_curve(losses: Mapping[str, Sequence[float]]) -> Figure:
    """Loss of training and validation, and the error at the end of validation's outages where there are some.

    ``losses`` has columns ``epoch``, ``train/loss``, ``val/loss``, ``val/outage_end_m``; NaN where unknown.
    """
    epochs = np.asarray(losses["epoch"], float)
    at_end = bool(np.isfinite(losses[AT_END]).any())
    more = ["Validation, error at the end of outages, geometric mean [m]"] if at_end else []
    figure = stack_panels(["Loss", *more], height=150)
    drawn = [(name, label, 1) for name, label in LOSSES.items()]
    for k, (name, label, row) in enumerate([*drawn, (AT_END, "validation", 2)] if at_end else drawn):
        y = np.asarray(losses[name], float)
        known = np.isfinite(y)
        trace = line(epochs[known], y[known], label, COLOURS[min(k, 1)], legend=row == 1)
        figure.add_trace(trace | {"mode": "lines+markers", "marker": {"size": 4}}, row)
    for row in range(1, figure.rows + 1):
        figure.set_log_scale(row)
    figure.update_xaxis(figure.rows, title={"text": "Epoch"})
    return figure
