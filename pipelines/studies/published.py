"""Outages as others publish them, beside their figures: ``python -m pipelines.studies.published FOLDER …``.

The folders are what ``dlkf evaluate outage=i2nav mode=drives`` left, 30 s without GNSS every 90 s. Printed are RMS and
median of the horizontal error at the end, and the error as industry states it: as a share of the distance driven, and
in how many outages it stays below 25 m per km (Teltonika: 8 of 10 drives, without wheel speed). Outages of less than
:data:`LEAST_M` are left out of the shares: a car that stands has no distance.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dlkf.base.errors import InputError

LEAST_M = 50.0
LIMIT = 25.0 / 1000.0


class OutageStatistic(NamedTuple):
    """Outages, those with a distance; RMS and median [m]; median share of the distance; share of those below LIMIT."""

    count: int
    driven: int
    rms_m: float
    median_m: float
    drift: float
    within: float


def outage_statistic(error_m: np.ndarray, distance_m: np.ndarray) -> OutageStatistic:
    """Of the errors at the ends of outages and the distances driven in them; what has no truth (NaN) is left out."""
    known = ~np.isnan(error_m)
    error, distance = error_m[known], distance_m[known]
    if not len(error):
        raise InputError("no outage has a known error at its end")
    far = distance >= LEAST_M
    share = error[far] / distance[far]
    none = (float("nan"), float("nan"))
    drift = (float(np.median(share)), float(np.mean(share <= LIMIT))) if far.any() else none
    rms, median = float(np.sqrt(np.mean(error**2))), float(np.median(error))
    return OutageStatistic(len(error), int(far.sum()), rms, median, *drift)


def rows_of(folder: Path) -> list[str]:
    """A row of the table for each filter of an evaluation."""
    try:
        content = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{folder}: no metrics.json; give folders that dlkf evaluate left") from None
    rows = []
    for result in content["results"]:
        outages = result["per_outage"]
        distance = np.array([o["distance_m"] for o in outages], float)
        for name in outages[0]["end"] if outages else ():
            error = np.array([o["end"][name]["horizontal"] for o in outages], float)
            s = outage_statistic(error, distance)
            shares = f"{100 * s.drift:.1f} | {100 * s.within:.0f} % of {s.driven}"
            rows.append(f"| {content['dataset']} | {name} | {s.count} | {s.rms_m:.2f} | {s.median_m:.2f} | {shares} |")
    return rows


def main() -> None:
    """Read, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", help="what evaluate left")
    options = parser.parse_args()
    print("| data | filter | outages | RMS [m] | median [m] | of distance, median [%] | within 25 m per km |")
    print("|:--|:--|--:|--:|--:|--:|--:|")
    for folder in options.folders:
        print("\n".join(rows_of(folder)))


if __name__ == "__main__":
    main()
