"""The core in C beside the Python stream, as the tables of ``docs/results/core.md``.

python -m tests.onboard.tables faults                          every fault of the tests
python -m tests.onboard.tables logs mbkf21_car plus            every real log beside this checkout, in shared/data/real
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dlkf.data.aid_tables import STANDARD
from dlkf.data.store import drive_rows
from dlkf.data.validate import read_drive
from dlkf.filters.aids.attach import with_aids
from dlkf.filters.build import build_filter
from dlkf.onboard.c_source import write_source
from dlkf.onboard.library import build
from dlkf.running.streaming import StreamingFilter
from dlkf.simulation.dataset import DatasetConfig, simulate_dataset
from dlkf.simulation.gnss.white import GnssConfig
from tests.cars import REAL
from tests.onboard.conftest import ARM, GRID, IMU, KIND, SENSORS, model_of
from tests.onboard.core import Core, Status
from tests.onboard.faults import FAULTS
from tests.onboard.streams import METRES, SOLUTION, Answers, Calls, calls, through_core, through_python

PLACE = [SOLUTION.index(c) for c in ("lat_deg", "lon_deg", "height_m")]
SCALE = np.array([METRES["lat_deg"], METRES["lon_deg"], 1.0])


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["faults", "logs"])
    parser.add_argument("models", nargs="*", default=["mbkf21_car"])
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as somewhere:
        if options.what == "faults":
            faults(Path(somewhere))
        for model in options.models if options.what == "logs" else ():
            logs(Path(somewhere) / model, model)


def faults(folder: Path) -> None:
    """A line for each fault: what each stream says of it, update intervals solved, how far positions are apart."""
    config = DatasetConfig(
        "town", hours=1 / 60, drive_minutes=1.0, gnss=GnssConfig(lever_arm_b=ARM), sensors=SENSORS
    )  # the drive of the tests
    data = simulate_dataset(config, IMU, 0, folder / "data", progress=False, workers=1)
    sent = calls(read_drive(data, drive_rows(data)[0], reference=False))
    estimator = with_aids(build_filter(KIND, IMU), STANDARD.values())
    library = exported(folder, estimator)
    for name, (fault, _) in FAULTS.items():
        stream, core = StreamingFilter(estimator, lever_arm_b=ARM), Core(library, ARM)
        python, c = both(stream, core, fault(sent))
        said = [
            words(python, {"lost": stream.counts["lost"], "diverged": stream.counts["diverged"]}),
            words(c, {"lost": core.count(Status.LOST), "diverged": core.count(Status.DIVERGED)}),
        ]
        print(f"| {name} | {said[0]} | {said[1]} | {solved(python, c)} |", flush=True)


def logs(folder: Path, model: str) -> None:
    """A line for each set of real drives."""
    folder.mkdir()
    estimator = model_of(model)
    library = exported(folder, estimator)
    for dataset in sorted(x.name for x in REAL.iterdir() if (x / "drives.parquet").is_file()):
        samples, intervals, squares, differing = 0, Counter(), 0.0, 0
        rows = drive_rows(REAL / dataset)
        for row in rows:
            tables = read_drive(REAL / dataset, row, reference=False)
            arm = tables.row.lever_arm_b
            python, c = both(StreamingFilter(estimator, lever_arm_b=arm), Core(library, arm), calls(tables))
            samples += len(tables.imu["t"])
            intervals.update(python=len(python.solution), c=len(c.solution))
            differing += sum(x != y for x, y in zip(python.words, c.words))
            squares += float(np.square(apart(python, c)).sum())
        rms = np.sqrt(squares / intervals["c"])
        print(f"| `{model}` | {dataset} | {len(rows)} | {samples:,} | {differing} | {intervals['python']:,}, "
              f"{intervals['c']:,} | {rms:.1e} |", flush=True)  # fmt: skip


def exported(folder: Path, estimator: Any) -> Path:
    """A filter as a library."""
    write_source(folder, estimator, GRID, "compared", {})
    return build(folder)


def both(stream: StreamingFilter, core: Core, sent: Calls) -> tuple[Answers, Answers]:
    """The same calls to both."""
    return through_python(stream, sent), through_core(core, sent)


def apart(python: Answers, c: Answers) -> np.ndarray:
    """Distances of positions [m] (T,); infinite where other update intervals are solved."""
    one, two = python.solution, c.solution
    if one.shape != two.shape or (one[:, 0] != two[:, 0]).any():
        return np.full(max(len(one), len(two)), np.inf)
    return np.linalg.norm((one - two)[:, PLACE] * SCALE, axis=1)


def words(answers: Answers, more: dict[str, int]) -> str:
    """What was said, other than taken."""
    said = {**{k: n for k, n in sorted(answers.counts.items()) if k != "taken"}, **{k: n for k, n in more.items() if n}}
    return ", ".join(f"{n} {k.replace('_', ' ')}" for k, n in said.items()) or "–"


def solved(python: Answers, c: Answers) -> str:
    """Update intervals of both, and the largest distance of their positions."""
    return f"{len(python.solution)}, {len(c.solution)} | {apart(python, c).max():.0e}"


if __name__ == "__main__":
    main()
