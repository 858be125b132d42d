"""What starting from IMU and GNSS alone is worth.

    python -m pipelines.studies.start_up data/city data/kitti

For every dataset with a reference that has attitude: each drive started by the rule of a stream (first motion, course)
and with ``align.search_s``, ``align.from_rest``; as recorded, in motion from its first second on, in reverse all along
(the body axes turned about), with velocities of 1 m/s white noise, and, where a drive stops twice, backing out between
the two standstills and then going forward. Printed: drives started, epochs before the start, error of the heading
there against the reference (RMS, median, largest), and its RMS over the stated 1σ.

With ``--imu``: what the starts are worth to filters in outages of 30 s, at the same times for all of them, counted
from first motion (every 60 s, in runs 10 s apart, the first after 20 s): horizontal error at the end.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
import yaml
from torch import Tensor

from dlkf.config import config_dir
from dlkf.data.alignment import ALIGN, AlignConfig, Start
from dlkf.data.drive import Drive
from dlkf.data.masks import withhold
from dlkf.data.segments import whole_drives
from dlkf.data.store import load_dataset
from dlkf.errors import InputError
from dlkf.filters.build import build_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.attitude import vector_from_rotation
from dlkf.navigation.earth import EARTH_RATE, ned_axes
from dlkf.navigation.imu_errors import ImuSpec, imu_spec
from dlkf.running.batched import run_filter
from dlkf.running.standstill import at_rest, runs
from dlkf.running.start import align_each

CONFIGS = {
    "course": ALIGN,
    "search": AlignConfig(search_s=20.0),
    "search, from rest": AlignConfig(search_s=20.0, from_rest=True),
}
HEAD = (
    "| scenario | start | started | epochs before it, mean | heading error RMS / median / max [°] | RMS over 1σ "
    "| beyond 90° | s |\n|:--|:--|--:|--:|--:|--:|--:|--:|"
)

OUTAGES = "| filter | start | outages | median [m] | RMS [m] | 95 % [m] |\n|:--|:--|--:|--:|--:|--:|"


def in_motion(drive: Drive) -> Drive | None:
    """From the first boundary faster than 5 m/s on."""
    fast = torch.nonzero(drive.gnss_v_e.norm(dim=-1) > 5).flatten()
    return drive.part(int(fast[0]), drive.epochs) if len(fast) and drive.epochs - fast[0] > 30 else None


def in_reverse(drive: Drive) -> Drive:
    """The same drive by a car that faces the other way."""
    about = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    imu = torch.cat((drive.imu[..., :3] @ about, drive.imu[..., 3:] @ about), -1)
    return replace(drive, imu=imu, ref_C_eb=drive.ref_C_eb @ about, lever_arm_b=about @ drive.lever_arm_b)


def bad_velocity(drive: Drive) -> Drive:
    """Velocities with 1 m/s of white noise per axis, and said so."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(drive.gnss_v_e.shape, generator=generator, dtype=torch.float64)
    std = torch.cat((drive.gnss_std[:, :3], torch.hypot(drive.gnss_std[:, 3:], torch.ones(3).double())), -1)
    return replace(drive, gnss_v_e=drive.gnss_v_e + noise, gnss_std=std)


def backing_out(drive: Drive) -> Drive | None:
    """From the second standstill backwards to the first, in reverse gear, and forward from there as recorded.

    Backwards in time a car's specific force is the same and its rates are turned round; error and Earth rate are not.
    """
    stops = runs(at_rest(drive))
    if len(stops) < 2 or not bool(drive.ref_imu_error.isfinite().all()):
        return None
    first, last = stops[0][1] - 1, stops[1][0] + 3
    span = torch.arange(last - 1, first - 1, -1)
    error = drive.ref_imu_error[span, 3:] + EARTH_RATE * drive.ref_C_eb[span, 2]
    back = drive.imu[span].flip(1).double()
    back[..., 3:] = 2 * error.unsqueeze(1) - back[..., 3:]
    rows = torch.cat((torch.arange(last, first - 1, -1), torch.arange(first + 1, drive.epochs + 1)))
    sign = torch.ones(len(rows), 1, dtype=torch.float64)
    sign[: last - first] = -1
    whole = replace(drive, imu=torch.cat((back, drive.imu[first:])))
    taken = {n: getattr(drive, n)[rows] for n in vars(drive) if n.startswith(("gnss_", "ref_")) or n == "quality"}
    return replace(whole, **taken | {n: taken[n] * sign for n in ("gnss_v_e", "ref_v_e")})


SCENARIOS: dict[str, Callable[[Drive], Drive | None]] = {
    "as recorded": lambda drive: drive,
    "in motion": in_motion,
    "in reverse": in_reverse,
    "backing out": backing_out,
    "bad velocity": bad_velocity,
}


def heading_errors(drives: Sequence[Drive], starts: Sequence[Start | InputError]) -> tuple[Tensor, Tensor]:
    """Error of the heading [rad] and its 1σ, of the drives started where the reference has attitude."""
    found = []
    for drive, start in zip(drives, starts):
        if isinstance(start, Start) and bool(drive.ref_C_eb[start.first].isfinite().all()):
            C_ne = ned_axes(*torch.tensor([start.lat, start.lon], dtype=torch.float64)).mT
            error = vector_from_rotation(C_ne @ drive.ref_C_eb[start.first] @ start.state.C_nb.mT)[2]
            found.append((float(error), float(start.std[8])))
    error, std = torch.tensor(found, dtype=torch.float64).reshape(-1, 2).unbind(-1)
    return error, std


def outages(recorded: Sequence[Drive], imu: ImuSpec, model: str, velocity_std: float) -> None:
    """Horizontal error at the end of outages with every kind of start."""
    estimator = build_filter(model, imu, tuning=Tuning(velocity_std=velocity_std))
    moving = [s for s in align_each(recorded) if isinstance(s, Start)]
    for name, config in CONFIGS.items():
        starts = [s for s in align_each(recorded, config) if isinstance(s, Start)]
        batch = whole_drives(recorded, starts)
        lead = torch.tensor([s.first - m.first for s, m in zip(starts, moving)])[:, None]
        since = torch.arange(1, batch.size[1] + 1) + lead
        ends = []
        for offset in range(0, 60, 10):
            phase = (since - 20 - offset) % 60
            hidden = (since > 20 + offset) & (phase > 0) & (phase <= 30)
            end = run_filter(withhold(batch, hidden), estimator)
            error = (end.posterior.p_n - batch.truth.p_n)[..., :2].norm(dim=-1)
            ends.append(error[hidden & (phase == 30) & batch.truth_valid])
        error = torch.cat(ends)
        values = error.median(), error.square().mean().sqrt(), error.quantile(0.95)
        print(f"| {model} | {name} | {len(error)} | " + " | ".join(f"{x:.2f}" for x in values) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+")
    parser.add_argument("--imu", help="a preset of conf/imu, for outages instead of headings")
    parser.add_argument("--velocity-std", type=float, default=1.0, help="factor on the receiver's")
    args = parser.parse_args()
    for folder in args.datasets:
        recorded = load_dataset(folder, dtype=torch.float64)
        if args.imu:
            imu = imu_spec(yaml.safe_load((config_dir() / "imu" / f"{args.imu}.yaml").read_text()))
            print(f"\n{folder}\n{OUTAGES}")
            for model in ("mbkf15", "mbkf15_nhc"):
                outages(recorded, imu, model, args.velocity_std)
            continue
        print(f"\n{folder}\n{HEAD}")
        for scenario, made in SCENARIOS.items():
            drives = [d for d in map(made, recorded) if d is not None]
            for name, config in CONFIGS.items() if drives else ():
                began = time.perf_counter()
                starts = align_each(drives, config)
                took = time.perf_counter() - began
                first = torch.tensor([s.first for s in starts if isinstance(s, Start)], dtype=torch.float64)
                error, std = heading_errors(drives, starts)
                degrees = error.abs() * 180 / math.pi
                row = [scenario, name, f"{len(first)} of {len(drives)}", f"{first.mean():.1f}"]
                row += [f"{degrees.square().mean().sqrt():.2f} / {degrees.median():.2f} / {degrees.max():.1f}"
                        if len(degrees) else "–"]  # fmt: skip
                row += [f"{(error / std).square().mean().sqrt():.2f}" if len(degrees) else "–"]
                print("| " + " | ".join([*row, str(int((degrees > 90).sum())), f"{took:.1f}"]) + " |", flush=True)


if __name__ == "__main__":
    main()
