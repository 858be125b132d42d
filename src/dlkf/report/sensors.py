"""Further sensors on the page of ``navigate``: the updates of each drive and what was estimated at its end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dlkf.filters.aids.estimates import format_estimate, label_estimate
from dlkf.running.offline import Navigated

WORDS = {"speed": "Wheel speed", "baro": "Barometer"}  # of sensors; of others their name


def sensor_rows(drives: Sequence[Navigated]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows; no columns where no drive has an update of a sensor or an estimate worth a word."""
    columns: dict[str, dict[str, str]] = {}  # heading → drive → cell
    for result in drives:
        table = result.table
        for used in (column for column in result.sensor_columns if column.endswith("_used")):
            sensor = used.removesuffix("_used")
            ratio = table[f"{sensor}_innovation"] / table[f"{sensor}_innovation_std"]
            if seen := int(ratio.notna().sum()):
                words = WORDS.get(sensor) or sensor.replace("_", " ").capitalize()
                count, spread = int(table[used].sum()), np.sqrt((ratio**2).mean())
                columns.setdefault(f"{words},\nupdates used", {})[result.drive] = f"{count} of {seen}"
                columns.setdefault(f"{words},\ninnovation / σ", {})[result.drive] = f"{spread:.2f}"
        for name in (name for name in result.sensors() if f"std_{name}" in table):
            last = table.iloc[-1]
            cell = format_estimate(name, float(last[name]), float(last[f"std_{name}"]))
            columns.setdefault(label_estimate(name), {})[result.drive] = cell
    rows = [[result.drive, *(cells.get(result.drive, "–") for cells in columns.values())] for result in drives]
    return ["Drive", *columns] if columns else [], rows
