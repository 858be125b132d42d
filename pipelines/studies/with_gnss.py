"""How far off filters are while there is GNSS, on simulated drives.

    python -m pipelines.studies.with_gnss fleet good phone puck puck_slow puck_white

The sets are those of :mod:`pipelines.studies.simulated_laws` in ``--data``. A row for each set and filter: RMS error of
the position forward, right and down [m] from 10 s, from a minute and from five minutes after the start on.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from pipelines.studies.plus import load

from dlkf.base.errors import InputError
from dlkf.data.segments import whole_drives
from dlkf.filters.integration import integrate
from dlkf.frames import navigation
from dlkf.onboard.compiled_filter import compile_filter
from dlkf.running.start import align_each

FILTERS = {
    "mbkf21_car": "any_car",
    "mbkf33_car+vibration_speed+receiver": "any_car",
    "plus": "untuned",  # finds its own noise
}
SINCE_S = (10, 60, 300, 850)


def main() -> None:
    """A table of all sets and filters."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("sets", nargs="+")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    spans = [f"{a} to {b} s" for a, b in pairwise(SINCE_S)]
    print(f"| data | filter | {' | '.join(spans)} |\n|:--|:--|{'--:|' * len(spans)}")
    for name in options.sets:
        drives = load(options.data / name)
        for model, tuning in FILTERS.items():
            filter_ = compile_filter(navigation.load(model, tuning=tuning), drives[0].rate_hz, drives[0].epoch_s)
            errors = []
            for drive in drives:
                (start,) = align_each([drive])
                if isinstance(start, InputError):
                    raise start
                batch = whole_drives([drive], [start])
                off = integrate(batch, filter_).posterior.p_n - batch.truth.p_n
                of_body = (batch.truth.C_nb.mT @ off.unsqueeze(-1)).squeeze(-1)[0]
                errors.append(torch.where(batch.truth_valid[0, :, None], of_body, torch.nan).numpy())
            cells = []
            for first, last in pairwise(SINCE_S):
                x = np.concatenate([e[first:last] for e in errors])
                cells.append(" / ".join(f"{v:.3g}" for v in np.sqrt(np.nanmean(x**2, axis=0))))
            print(f"| {name} | {model} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
