"""One set of noise factors found by gradient through the whole filter, beside those of ``dlkf.tune``'s search.

    python -m pipelines.studies.global_factors --train data/fleet data/wide --test test/fleet

Both have the same pieces of the training drives (60 s with GNSS, 60 s without), the same objective (geometric mean of
the horizontal error at the end of the outages), the same eight factors of ``mbkf33_car`` and the same start; the search
tries some five values of each, the gradient (Adam) moves all at once. If they end alike the gradient that ``plus`` is
trained with is right, and what a network gains is gained by changing factors, not by finding better constant ones.
Prints a Markdown table.
"""

from __future__ import annotations

import argparse

import torch
from pipelines.studies.plus import end_of, load, outages

from dlkf.filters.build import build_causal, build_filter
from dlkf.filters.model_based import Mbkf
from dlkf.filters.plus import ANY_MEMS
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.tuning.descent import FACTORS, descended
from dlkf.tuning.search import outage_error, tuned

NAME, OUTAGE_S = "mbkf33_car", 60.0


def main() -> None:
    """Search, descend, score both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", nargs="+", required=True, help="datasets that both are tuned on")
    parser.add_argument("--test", nargs="*", default=[], help="datasets to try them on")
    parser.add_argument("--steps", type=int, default=60, help="of the descent")
    args = parser.parse_args()
    torch.set_num_threads(1)
    spec = imu_spec(ANY_MEMS)
    batch = outages(load(args.train), OUTAGE_S, most=90)
    kalman = build_filter(NAME, spec, tuning=Tuning())
    assert isinstance(kalman, Mbkf)
    search, _ = tuned(spec, [batch], name=NAME, start=Tuning(), objective="log", rounds=2)
    gradient = descended(kalman, batch, end_of(OUTAGE_S, batch), steps=args.steps)
    found = {"start": Tuning(), "search": search, "gradient": gradient}
    tests = {folder: outages(load([folder]), OUTAGE_S) for folder in args.test}
    print(f"| factors | {' | '.join(FACTORS)} | training [m] |{''.join(f' {t} [m] |' for t in tests)}")
    print(f"|:--|{'--:|' * (len(FACTORS) + 1 + len(tests))}")
    for name, tuning in found.items():
        filter = build_causal(NAME, spec, "a stream cannot", tuning=tuning)
        errors = [outage_error(filter, [b]) for b in (batch, *tests.values())]
        values = [f"{getattr(tuning, f):.2g}" for f in FACTORS]
        print(f"| {name} | {' | '.join(values)} | {' | '.join(f'{e:.2f}' for e in errors)} |")


if __name__ == "__main__":
    main()
