"""Noise found without a reference against the noise that is true, or that somebody fitted: errors in outages.

    python -m pipelines.studies.found_noise data/consumer --true consumer --from automotive_mems
    python -m pipelines.studies.found_noise data/real --true roof_mems --halves

Noise is found on half of the drives (``--halves``: of each drive; ``--second``: the second half) from IMU and GNSS
alone, and scored on the other half, where the reference is used: segments every 10 s, an outage after 60 s, the start
0.1 m, 0.1 m/s, 1° and 2° off. Errors at the end of the outages [m], and the ratio to the filter with the true
noise.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from dlkf.base.errors import InputError
from dlkf.command.composing import imu_preset
from dlkf.data.segments import StartLaw
from dlkf.data.store import load_dataset
from dlkf.evaluation.outages import OutagePlan
from dlkf.evaluation.protocol import Protocol, Scenes
from dlkf.evaluation.results import summarise_scores
from dlkf.evaluation.run import score_scenes
from dlkf.evaluation.table import format_interval, format_number
from dlkf.filters.build import build_causal
from dlkf.filters.tuning import Tuning
from dlkf.onboard.compiled_filter import compile_or_keep
from dlkf.running.likelihood import Evidence, find_noise

START = StartLaw(position_m=0.1, velocity_mps=0.1, roll_pitch_deg=1.0, yaw_deg=2.0)


def main() -> None:
    """Find, score, print."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("dataset", type=Path)
    arguments.add_argument("--true", required=True, help="preset that is true, or was fitted")
    arguments.add_argument("--from", dest="start", default="automotive_mems", help="preset at which the search begins")
    arguments.add_argument("--models", nargs="+", default=["mbkf21_nhc"])
    arguments.add_argument("--halves", action="store_true", help="the first half of each drive against its second")
    arguments.add_argument("--second", action="store_true", help="found on the second half, scored on the first")
    arguments.add_argument("--lengths", type=float, nargs="+", default=[30.0, 60.0])
    options = arguments.parse_args()
    torch.set_num_threads(1)
    drives = load_dataset(options.dataset, rate_hz=50.0, epoch_s=1.0, dtype=torch.float64)
    if options.halves:
        seen = [d.part(0, d.epochs // 2) for d in drives]
        unseen = [d.part(d.epochs // 2, d.epochs) for d in drives]
    else:
        seen, unseen = drives[::2], drives[1::2]
    if options.second:
        seen, unseen = unseen, seen
    evidence, start, true = Evidence.of(seen), imu_preset(options.start), imu_preset(options.true)
    for model in options.models:
        clock = time.perf_counter()
        found = find_noise(evidence, model, start, Tuning(), compiler=compile_or_keep)
        print(f"\n{model}: found in {time.perf_counter() - clock:.0f} s; −ln p {found.before:.2f} → {found.after:.2f}")
        print("  " + ", ".join(f"{k} {format_number(v, digits=2)}" for k, v in found.described().items()))
        filters = {
            true.name: build_causal(model, true, "this does not"),
            start.name: build_causal(model, start, "this does not"),
            "found": build_causal(model, found.imu, "this does not", tuning=found.tuning),
        }
        for length in options.lengths:
            plan = OutagePlan(60.0, length, offsets_s=(0.0,))
            try:
                scenes = Scenes(unseen, Protocol("segments", 65.0 + length, 10.0, START, outage=plan, seed=0))
                scores = score_scenes(filters, scenes, groups={d.name: d.group for d in unseen})
            except InputError as error:
                print(f"  {length:g} s: {error}")
                continue
            result = summarise_scores(scores, baseline=true.name)
            end = ("outages", "end", "horizontal")
            for name in filters:
                sizes = " / ".join(format_number(result.value(name, *end, s)) for s in ("rms", "median"))
                both = " and ".join(format_interval(result.versus(name, *end, s)) for s in ("rms", "geomean"))
                print(f"  {length:g} s, {result.count['outages']} outages, {name}: RMS / median {sizes}; ratios {both}")


if __name__ == "__main__":
    main()
