"""Filters whose receiver is wrong: outages of real and simulated drives, with errors added to the fixes before them.

    python -m pipelines.studies.wrong_fixes --real <folder with kitti, rtkx, wid, wid_mru, linkoping>

The outages are those of :mod:`pipelines.studies.plus` on real motion and on ``fleet``. From the first on, fixes get
errors that the reported 1σ does not know: positions off by 3, 1 or 30 m (1σ per axis) in some seconds, by one error of
3 m for ten seconds about every 50 s, or by 1 m in all; velocities (``kitti``, ``rtkx``, ``fleet``) off by 0.5 m/s in
all, or those of a second before. The entirely real drives start on those fixes. Writes ``table.md``: RMS / geometric mean of the
horizontal error at the end of the outage over the rows [m] and mean NEES, of constants without a gate and with it,
and of ``plus``, and its ratio to constants with a gate, geometric mean over all outages with a 95 % interval over
recordings.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from pipelines.studies.plus import REAL, Row, load, real_cases, recorded, score, simulated_cases
from pipelines.studies.simulated_laws import INJECTED, simulate_sets
from torch import Tensor

from dlkf.base.provenance import describe_provenance
from dlkf.command.composing import imu_preset, tuning_preset
from dlkf.data.drive import Drive
from dlkf.evaluation.bootstrap import compare
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_causal
from dlkf.filters.integration import Estimator
from dlkf.filters.shipped import trained_filter
from dlkf.navigation.state import POSITION, VELOCITY

LASTS_S, EVERY_S = 10, (20, 60)  # of a step, and the time between two
LONGEST_S = 3600
FLEET, BASE, STATISTICS = "fleet", "mbkf33_car", ("rms", "log")
Change = Callable[[Float[Tensor, "T 6"], torch.Generator], Float[Tensor, "T 6"]]


def single(share: float, size: float, part: slice = POSITION) -> Change:
    """Errors of 1σ ``size`` per axis [m, m/s] in a share of the seconds."""

    def change(gnss: Tensor, g: torch.Generator) -> Tensor:
        hit = torch.rand(LONGEST_S, 1, generator=g, dtype=gnss.dtype) < share
        gnss[:, part] += (hit * size * torch.randn(LONGEST_S, 3, generator=g, dtype=gnss.dtype))[: len(gnss)]
        return gnss

    return change


def steps(size: float) -> Change:
    """One error [m] of 1σ ``size`` per axis for ``LASTS_S`` seconds, again and again."""

    def change(gnss: Tensor, g: torch.Generator) -> Tensor:
        k = 0
        while k < len(gnss):
            k += int(torch.randint(*EVERY_S, (1,), generator=g))
            gnss[k : k + LASTS_S, POSITION] += size * torch.randn(3, generator=g, dtype=gnss.dtype)
            k += LASTS_S
        return gnss

    return change


def late(gnss: Tensor, g: torch.Generator) -> Tensor:
    """Velocities of the second before."""
    gnss[1:, VELOCITY] = gnss[:-1, VELOCITY].clone()
    return gnss


ERRORS: Mapping[str, Change | None] = {
    "none": None,
    "3 m in one of ten": single(0.1, 3.0),
    "1 m in one of five": single(0.2, 1.0),
    "30 m in one of twenty": single(0.05, 30.0),
    "3 m for 10 s": steps(3.0),
    "1 m in all": single(1.0, 1.0),
    "velocity 0.5 m/s in all": single(1.0, 0.5, VELOCITY),
    "velocity a second late": late,
}
OF_VELOCITIES = [name for name in ERRORS if name.startswith("velocity")]


def with_errors(drive: Drive, change: Change | None) -> Drive:
    """A drive whose fixes have these errors."""
    if change is None:
        return drive
    valid, fixes = drive.gnss_valid, torch.cat((drive.gnss_r_e, drive.gnss_v_e), -1)
    changed = change(fixes.clone(), torch.Generator().manual_seed(zlib.crc32(drive.name.encode())))
    if change is late:  # they need the one before
        valid = valid & torch.cat((valid[:1], valid[:-1]))
    return replace(drive, gnss_r_e=changed[:, POSITION], gnss_v_e=changed[:, VELOCITY], gnss_valid=valid)


def rivals() -> dict[str, Estimator]:
    """The constants of ``any_car`` without a gate and with it, those of ``gradient`` with it, and ``plus``."""
    imu, tuning = imu_preset("automotive_mems"), tuning_preset("any_car")
    gated = f"{BASE}_gated+vibration_speed"
    filters = {f"{n} any_car": build_causal(n, imu, "no", tuning=tuning) for n in (f"{BASE}+vibration_speed", gated)}
    filters[f"{gated} gradient"] = build_causal(gated, imu, "no", tuning=tuning_preset("gradient"))
    return {**filters, "plus": trained_filter("plus")}


def table(rows: Mapping[str, list[Row]]) -> list[str]:
    """A line for each kind of error; the ratio of ``plus`` to the constants of ``any_car`` with a gate."""
    names = list(next(iter(rows.values()))[0].errors)
    lines = [f"| errors | rows | {' | '.join(names)} | `plus` : {names[1]} |", f"|:--|{'--:|' * (len(names) + 2)}"]
    for kind, some in rows.items():
        cells = []
        for name in names:
            rms, geometric = (
                np.exp(np.mean([np.log(mean_error(r.errors[name], s)) for r in some])) for s in STATISTICS
            )
            cells.append(f"{rms:.1f} / {geometric:.2f} ({np.mean([r.nees[name] for r in some]):.1f})")
        ours, other = (np.concatenate([r.errors[name] for r in some]) for name in ("plus", names[1]))
        groups = [f"{recorded(r.name)} {g}" for r in some for g in r.groups]
        c = compare(ours, other, statistic="geomean", groups=groups)
        cells.append(f"{c.ratio:.2f} [{c.ratio_low:.2f}, {c.ratio_high:.2f}]")
        lines.append(f"| {kind} | {len(some)} | {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Add errors, run, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, required=True, help="folder of real datasets")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where test sets lie, or are made")
    arguments.add_argument("--out", type=Path, default=Path("outputs/wrong_fixes"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    simulate_sets(options.data, options.real, (*INJECTED, FLEET))
    filters, rows = rivals(), {}
    for name in (*INJECTED, *REAL, FLEET):
        drives = load((options.real if name in REAL else options.data) / name)
        moves = any(bool(d.gnss_valid[:, VELOCITY].any()) for d in drives)
        where = "simulated" if name == FLEET else "real motion"
        for kind, change in ERRORS.items():
            if moves or kind not in OF_VELOCITIES:
                wrong = [with_errors(d, change) for d in drives]
                for case in real_cases(name, wrong) if name in REAL else simulated_cases(name, wrong):
                    rows.setdefault(f"{kind}, {where}", []).extend(score(case, filters))
        print(name, flush=True)
    rows = dict(
        sorted(rows.items(), key=lambda x: (not x[0].endswith("motion"), [*ERRORS].index(x[0].rpartition(", ")[0])))
    )
    (options.out / "table.md").write_text("\n".join(table(rows)) + "\n")
    (options.out / "manifest.json").write_text(json.dumps(describe_provenance(), indent=1) + "\n")


if __name__ == "__main__":
    main()
