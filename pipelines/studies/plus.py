"""``plus`` against classical filters with one set of factors, each tuned on the drives that ``plus`` was trained on.

    python -m pipelines.studies.plus --train data/fleet data/wide --test data/val_fleet data/val_city \\
        --real data/rtkx data/kitti_consumer --out outputs/plus

Pieces of 60 s with GNSS, an outage, and 5 s after it, from the truth plus an error of 0.1 m, 0.1 m/s, 1° and 2° (1σ);
simulated pieces end to end, those of real motion every 10 s. Nobody is told the IMU: the classical filters start
from an automotive MEMS and have factors tuned by the geometric mean on pieces of the training drives, which are kept
in <out>/factors.yaml: the best of the searches that begin with no factors and with those of the filters before it;
one of them a second time, by gradient instead of search (:mod:`dlkf.tuning.descent`).
Beside them stands ``mbkf33_car`` that is told the preset of the drive's IMU, where it has one, and has its tuned
factors but those of the IMU: no rival, but what such knowledge is worth. Prints, and writes into <out>, Markdown tables
of the horizontal error at the end of the outages: all filters, then trainings from other seeds (``--model`` takes
several), then ``plus`` with parts of its network switched off; and a figure of its ratios to the best of the others.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
import yaml
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from dlkf.colours import COLOURS
from dlkf.config import config_dir
from dlkf.data.drive import Batch
from dlkf.data.masks import withhold, within
from dlkf.data.segments import StartLaw, cut_pieces, make_batch
from dlkf.data.stack import DriveStack
from dlkf.data.store import load_dataset
from dlkf.evaluation.bootstrap import Comparison, compare
from dlkf.evaluation.figures import png
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_causal, build_filter
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Mbkf
from dlkf.filters.plus import ANY_MEMS, PlusConfig, PlusFilter
from dlkf.filters.shipped import trained_filter
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import imu_spec
from dlkf.running.batched import run_filter
from dlkf.tuning.descent import descended
from dlkf.tuning.search import outage_error, tuned

BY_GRADIENT = "mbkf33_car, by gradient"
CLASSICAL = ("mbkf21_nhc", "mbkf21_car", "mbkf33_car", BY_GRADIENT)
START = StartLaw(position_m=0.1, velocity_mps=0.1, roll_pitch_deg=1.0, yaw_deg=2.0)
BEFORE_S, AFTER_S, REAL_STRIDE_S = 60.0, 5.0, 10.0
PARTS = tuple(("across", "fix", "process", "offset", "speed")[:k] for k in range(6))
TOLD, OF_IMU = "mbkf33_car", ("accel_noise", "gyro_noise", "accel_walk", "gyro_walk")
STATISTICS = ("rms", "geomean")
SEED = 7


class Row(NamedTuple):
    """Errors of every filter at the ends of the outages of one dataset [m], and NEES of those with a covariance."""

    name: str
    outage_s: float
    groups: list[str]
    errors: dict[str, np.ndarray]
    nees: dict[str, float]
    told: np.ndarray | None = None


def load(folders: Sequence[str]) -> DriveStack:
    """Drives of datasets."""
    return DriveStack([d for f in folders for d in load_dataset(f, rate_hz=50.0, epoch_s=1.0, dtype=torch.float64)])


def outages(stack: DriveStack, outage_s: float, stride_s: float | None = None, most: int | None = None) -> Batch:
    """Pieces with an outage, of at most so many, spread evenly."""
    length = BEFORE_S + outage_s + AFTER_S
    pieces = cut_pieces(stack, length, stride_s or length)
    pieces = pieces[:: -(-len(pieces) // most)] if most else pieces
    generator = torch.Generator().manual_seed(SEED)
    batch = make_batch(stack, pieces, dtype=torch.float64, start=START, generator=generator)
    return withhold(batch, within(batch, BEFORE_S, outage_s))


def opponents(train: Sequence[str], out: Path) -> dict[str, Estimator]:
    """Classical filters with the factors of ``out/factors.yaml``, found on training drives where it lacks them."""
    file, spec = out / "factors.yaml", imu_spec(ANY_MEMS)
    known: dict[str, dict[str, float]] = yaml.safe_load(file.read_text()) if file.is_file() else {}
    pieces: list[Batch] = []
    for name in CLASSICAL:
        if name not in known:
            pieces = pieces or [outages(load(train), 60.0, most=90)]
            if name == BY_GRADIENT:
                kalman = build_filter(filter_of(name), spec, tuning=Tuning())
                assert isinstance(kalman, Mbkf)
                factors = descended(kalman, pieces[0], end_of(60.0, pieces[0]))
            else:
                before = CLASSICAL[: CLASSICAL.index(name)]
                starts = (Tuning(), *(Tuning(**known[n]) for n in before if n in known))
                searches = (tuned(spec, pieces, name=name, start=s, objective="log", rounds=2) for s in starts)
                factors, _ = min(searches, key=lambda found: found[1])
            known[name] = asdict(factors)
            error = outage_error(build_causal(filter_of(name), spec, "tuning does not", tuning=factors), pieces)
            print(f"{name}: {error:.2f} m geometric mean on {pieces[0].size[0]} training pieces", flush=True)
            file.write_text(yaml.safe_dump(known))
    return {
        name: build_causal(filter_of(name), spec, "a stream cannot", tuning=Tuning(**known[name])) for name in CLASSICAL
    }


def filter_of(name: str) -> str:
    """Name of the filter of an opponent."""
    return name.partition(",")[0]


def end_of(outage_s: float, batch: Batch) -> int:
    """The last epoch of the outage of such pieces."""
    return round((BEFORE_S + outage_s) / batch.epoch_s) - 1


def told_errors(
    batch: Batch, outage_s: float, imus: Mapping[str, str], factors: Mapping[str, float]
) -> np.ndarray | None:
    """Errors at the end of the outage [m] of a filter that knows each drive's IMU; None where that is no preset."""
    kinds = [imus[d].split(" ")[0] for d in batch.drive]
    files = {kind: config_dir() / "imu" / f"{kind}.yaml" for kind in set(kinds)}
    if not all(file.is_file() for file in files.values()):
        return None
    out = np.empty(len(kinds))
    end = end_of(outage_s, batch)
    for kind, file in files.items():
        known = build_causal(
            TOLD, imu_spec(yaml.safe_load(file.read_text())), "a stream cannot",
            tuning=Tuning(**{k: v for k, v in factors.items() if k not in OF_IMU}),
        )  # fmt: skip
        e = (run_filter(batch, known).posterior.p_n - batch.truth.p_n)[:, end, :2].norm(dim=-1).numpy()
        out = np.where([k == kind for k in kinds], e, out)
    return out


def scored(
    name: str, batch: Batch, outage_s: float, filters: Mapping[str, Estimator], groups: Mapping[str, str]
) -> Row:
    """Errors at the end of the outage; NEES of the horizontal position over it."""
    end, nees, errors = end_of(outage_s, batch), {}, {}
    first = round(BEFORE_S / batch.epoch_s)
    for filter_name, estimator in filters.items():
        solution = run_filter(batch, estimator)
        e = (solution.posterior.p_n - batch.truth.p_n)[..., :2]
        errors[filter_name] = e[:, end].norm(dim=-1).numpy()
        if solution.std is not None:
            square = 0.5 * (e / solution.std[..., :2]).square().sum(-1)[:, first : end + 1]
            nees[filter_name] = float(square[batch.truth_valid[:, first : end + 1]].mean())
    return Row(name, outage_s, [groups[d] for d in batch.drive], errors, nees)


def markdown(rows: Sequence[Row], filters: Sequence[str], model: str) -> list[str]:
    """RMS / median per filter; of ``model`` over the best other one by geometric mean also the ratios."""
    told = any(row.told is not None for row in rows)
    head = ["data", "outage [s]", "pieces", *filters, "RMS ratio", "geometric ratio", "NEES"]
    head += [f"{TOLD}, told its IMU"] if told else []
    lines = _head(head)
    for row in rows:
        cells = [*_first(row), str(len(row.groups)), *(_both(row.errors[f]) for f in filters)]
        cells += [*_ratios(row, filters, model), f"{row.nees[model]:.1f}"]
        if told:
            cells.append("" if row.told is None else _both(row.told))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def of_seeds(rows: Sequence[Row], models: Sequence[str]) -> list[str]:
    """The same trainings from several seeds: RMS / median, and ratios to the best classical filter."""
    lines = _head(["data", "outage [s]", *(x for m in models for x in (m, "RMS ratio", "geometric ratio", "NEES"))])
    for row in rows:
        cells = _first(row)
        for m in models:
            cells += [_both(row.errors[m]), *_ratios(row, [*CLASSICAL, m], m), f"{row.nees[m]:.1f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _head(names: Sequence[str]) -> list[str]:
    return [f"| {' | '.join(names)} |", f"|:--|{'--:|' * (len(names) - 1)}"]


def _first(row: Row) -> list[str]:
    return [row.name, f"{row.outage_s:g}"]


def _both(errors: np.ndarray) -> str:
    return f"{mean_error(errors, 'rms'):.1f} / {np.median(errors):.1f}"


def _ratios(row: Row, filters: Sequence[str], model: str) -> list[str]:
    cells = []
    for c in against_best(row, filters, model):
        band = "" if np.isnan(c.ratio_low) else f" [{c.ratio_low:.2f}, {c.ratio_high:.2f}]"
        cells.append(f"{c.ratio:.2f}{band}")
    return cells


def against_best(row: Row, filters: Sequence[str], model: str) -> list[Comparison]:
    """Of the RMS and of the geometric mean, to the best other filter by geometric mean."""
    best = min((f for f in filters if f != model), key=lambda f: mean_error(row.errors[f], "log"))
    return [compare(row.errors[model], row.errors[best], statistic=s, groups=row.groups) for s in STATISTICS]


def forest(rows: Sequence[Row], filters: Sequence[str], model: str) -> Figure:
    """Ratios to the best other filter with their 95 % intervals, a line per dataset and outage."""
    figure = Figure(figsize=(7.2, 1.2 + 0.24 * len(rows)), layout="constrained")
    ax = figure.add_subplot()
    for k, (statistic, label, colour) in enumerate(zip(STATISTICS, ("RMS", "geometric mean"), COLOURS)):
        c = [against_best(row, filters, model)[k] for row in rows]
        ratio = np.array([x.ratio for x in c])
        bounds = np.array([(x.ratio_low, x.ratio_high) for x in c])
        y = np.arange(len(rows)) + (0.14 if statistic == "rms" else -0.14)
        ax.hlines(y, bounds[:, 0], bounds[:, 1], color=colour, lw=1.2)
        ax.plot(ratio, y, "o", ms=4, color=colour, label=label)
    ax.axvline(1.0, color="black", lw=0.8)
    ax.set_yticks(range(len(rows)), [f"{row.name}, {row.outage_s:g} s" for row in rows])
    ax.invert_yaxis()
    ax.set_xscale("log")
    ticks = (0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks], minor=False)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set_xlabel(f"error of {model} / error of the best tuned classical filter of that line")
    ax.grid(axis="x", color="#EEEEEE")
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper right", ncols=2, frameon=False)
    return figure


def with_parts(model: PlusFilter, parts: Sequence[str]) -> PlusFilter:
    """The same weights with only some parts in force."""
    part = PlusFilter(PlusConfig.from_mapping(replace(model.config, parts=tuple(parts)).plain()))
    part.load_state_dict(model.state_dict())
    return part.eval()


def main() -> None:
    """Tune, score, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", nargs="+", default=["plus"], help="weights: plus, or folders; the first is plus")
    parser.add_argument("--train", nargs="+", required=True, help="datasets that the classical filters are tuned on")
    parser.add_argument("--test", nargs="*", default=[], help="simulated datasets")
    parser.add_argument("--real", nargs="*", default=[], help="datasets of real motion, cut every 10 s")
    parser.add_argument("--outages", nargs="+", type=float, default=[30.0, 60.0])
    parser.add_argument("--ablation", action="store_true", help="also plus with parts switched off")
    parser.add_argument("--out", type=Path, default=Path("outputs/plus"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    models = {f"plus, {k + 1}" if k else "plus": trained_filter(folder) for k, folder in enumerate(args.model)}
    model = models["plus"]
    assert isinstance(model, PlusFilter)
    filters = {**opponents(args.train, args.out), **models}
    shown = [*CLASSICAL, "plus"]
    factors = yaml.safe_load((args.out / "factors.yaml").read_text())[TOLD]
    rows, ablated = [], []
    for folder in (*args.test, *args.real):
        stack = load([folder])
        groups = {d.name: d.group for d in stack}
        table = pd.read_parquet(Path(folder) / "drives.parquet", columns=["drive", "imu"])
        imus = dict(zip(table.drive, table.imu, strict=True))
        stride = REAL_STRIDE_S if folder in args.real else None
        for outage_s in args.outages:
            batch = outages(stack, outage_s, stride)
            told = told_errors(batch, outage_s, imus, factors)
            rows.append(scored(Path(folder).name, batch, outage_s, filters, groups)._replace(told=told))
            print(markdown(rows[-1:], shown, "plus")[-1], flush=True)
            if args.ablation:
                variants = {"+".join(p) or "none": with_parts(model, p) for p in PARTS}
                ablated.append(scored(Path(folder).name, batch, outage_s, variants, groups))
    lines = markdown(rows, shown, "plus")
    if len(models) > 1:
        lines += ["", *of_seeds(rows, list(models))]
    if ablated:
        names = list(ablated[0].errors)
        lines += ["", *markdown(ablated, names, names[-1])]
    (args.out / "table.md").write_text("\n".join(lines) + "\n")
    (args.out / "ratios.png").write_bytes(png(forest(rows, shown, "plus")))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
