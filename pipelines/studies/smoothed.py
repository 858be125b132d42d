"""Post-processing: filters smoothed over whole drives with an outage in them (Rauch-Tung-Striebel).

    python -m pipelines.studies.smoothed --real <folder with kitti, rtkx, wid, wid_mru, linkoping>

Outages as in :mod:`pipelines.studies.plus`, in whole drives from their own alignment. With fixes after an outage the
error is greatest somewhere within it, so ``table.md`` has the largest horizontal error of each outage, RMS / geometric
mean [m], and the mean NEES over the outages. ``plus``, forward is the filter itself over the same outages.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from pipelines.studies.other_cars import markdown
from pipelines.studies.plus import REAL, SOURCES, Case, Row, constants, found_noise, load, real_cases
from pipelines.studies.simulated_laws import INJECTED, SIMULATED, simulate_sets

from dlkf.base.provenance import describe_provenance
from dlkf.data.store import dataset_digest
from dlkf.filters.integration import Estimator
from dlkf.filters.shipped import trained_filter
from dlkf.filters.smoother import Filter, SmoothedSolution
from dlkf.running.batched import run_filter

FIXED = ("mbkf21_car any_car", f"mbkf21_car{SOURCES} any_car", f"mbkf33_car{SOURCES} any_car")
FOUND = f"mbkf21_car{SOURCES}"
OF_SIMULATED = ("fleet", "others", "rough", "puck")
SIMULATED_BEFORE_S, SIMULATED_EVERY_S = 60, 300


def score_largest(case: Case, filters: Mapping[str, Filter]) -> Row | None:
    """The largest horizontal error in each outage that has a reference; None where none has."""
    batch, length = case.batch, case.lengths_s[0]
    hidden, valid = (~batch.available & batch.present).numpy(), batch.truth_valid.numpy()
    spans = [(b, slice(k, k + length)) for b, k in enumerate(case.first)]
    spans = [(b, s) for b, s in spans if hidden[b, s].sum() == length and valid[b, s].any()]
    if not spans:
        return None
    row = Row(case.name, case.before_s, length, {}, {}, [case.groups[b] for b, _ in spans])
    for name, model in filters.items():
        solution = run_filter(batch, model)
        assert solution.std is not None
        e = (solution.posterior.p_n - batch.truth.p_n)[..., :2].numpy()
        square = 0.5 * ((e / solution.std[..., :2].numpy()) ** 2).sum(-1)
        row.errors[name] = np.array([np.hypot(*e[b, s][valid[b, s]].T).max() for b, s in spans])
        row.nees[name] = float(np.mean([square[b, s][valid[b, s]].mean() for b, s in spans]))
    return row


def list_filters(found: Mapping[str, Estimator]) -> dict[str, Filter]:
    """Those of the table: smoothed, and ``plus`` itself."""
    causal = {name: constants()[name] for name in FIXED}
    causal |= {name: getattr(model, "estimator", model) for name, model in found.items()}
    plus = trained_filter("plus")
    return {name: SmoothedSolution(x) for name, x in causal.items()} | {
        "plus": SmoothedSolution(plus), "plus, forward": plus,
    }  # fmt: skip


def run(name: str, folder: Path) -> Sequence[Row]:
    """The rows of a dataset."""
    drives, real = load(folder), name in (*REAL, *INJECTED)
    filters = list_filters(found_noise(drives, (FOUND,)) if real else {})
    when = () if real else (SIMULATED_BEFORE_S, SIMULATED_EVERY_S)
    rows = [score_largest(case, filters) for case in real_cases(name, drives, *when)]
    return [row for row in rows if row is not None]


def main() -> None:
    """Simulate what is missing, run, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, help="folder of real datasets; without it only simulated ones")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where test sets lie, or are made")
    arguments.add_argument("--out", type=Path, default=Path("outputs/smoothed"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    simulate_sets(options.data, options.real, [n for n in (*OF_SIMULATED, *INJECTED) if n in SIMULATED or options.real])
    folders = {name: options.data / name for name in OF_SIMULATED}
    if options.real is not None:
        of_real = {name: options.real / name for name in REAL if (options.real / name).is_dir()}
        folders = {name: options.data / name for name in INJECTED} | of_real | folders
    tables: dict[bool, list[Row]] = {True: [], False: []}  # real motion, simulated
    for name, folder in folders.items():
        for row in run(name, folder):
            tables[name not in OF_SIMULATED].append(row)
            print(markdown([row])[-1], flush=True)
    text = "\n\n".join("\n".join(markdown(rows)) for rows in tables.values() if rows)
    (options.out / "table.md").write_text(f"{text}\n")
    made = {**describe_provenance(), "digests": {name: dataset_digest(folder) for name, folder in folders.items()}}
    (options.out / "manifest.json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
