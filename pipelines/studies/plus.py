"""``plus`` against the best filters without prior information, on real drives and on simulated ones of other laws.

    python -m pipelines.studies.plus --real <folder with kitti, rtkx, wid, wid_mru, linkoping> --out outputs/plus
    python -m pipelines.studies.plus --train --out outputs/plus    the constants by gradient and fresh weights as well
    python -m pipelines.studies.plus --parts --real <real> --out outputs/plus_parts    against itself without its parts
    python -m pipelines.studies.plus --oracle --no-auto --sets good fleet others    beside a filter given the true noise
    python -m pipelines.studies.plus --no-auto --rate 10 --sets good fleet others    with IMU samples of 10 Hz
    python -m pipelines.studies.plus --no-auto --fix-interval 5 --sets good fleet    with a fix every five seconds

Makes the test sets that are missing (below ``--data``), runs every filter compiled over segments with GNSS for 60, 300
and 900 s and then none for 120 s (real drives: 30 or 60 s), and writes ``table.md`` and ``manifest.json`` (commit,
seeds, settings and digest of every dataset). Errors are horizontal, at the end of the outage, RMS / geometric mean [m].
The baselines start from ``imu=automotive_mems`` and constants from ``conf/tuning``, each alone, and with speed from
vibration, delay and antenna (``+vibration_speed+receiver``) as ``plus`` has them. The ratio is to the best of them by
the geometric mean of that row, a choice with hindsight; [ ] is its 95 % interval over recordings. Beside them stands
``imu=auto``, whose noise is found on the drives that are scored, with all their fixes, and with ``--oracle``
``mbkf33_car+vibration_speed+receiver`` given the IMU preset that each simulated drive was made with, and ``plus_imu``
given its biases, scale factors and misalignments. Last come, over all rows, every filter's errors, mean NEES, and the
ratio of ``plus`` to it over all outages, by recordings.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
import yaml
from pipelines.studies.ablations.plus_parts import parts
from pipelines.studies.aids import ratio
from pipelines.studies.simulated_laws import COMMON, INJECTED, PYTHON_INS, SILENT, SIMULATED, simulate_sets
from pipelines.studies.tuning.descent import tune_by_gradient

from dlkf.base.errors import InputError
from dlkf.base.provenance import describe_provenance
from dlkf.command.composing import imu_preset, tuning_preset
from dlkf.command.simulated import compose_recipe
from dlkf.data.alignment import ALIGN
from dlkf.data.drive import Batch, Drive
from dlkf.data.kinds import drive_rates
from dlkf.data.masks import withhold_fixes
from dlkf.data.resampling import usual_rate
from dlkf.data.segments import StartLaw, cut_segments, make_batch, whole_drives
from dlkf.data.stack import DriveStack
from dlkf.data.store import dataset_digest, load_dataset
from dlkf.evaluation.metrics import mean_error
from dlkf.filters.build import build_causal, build_filter
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Mbkf
from dlkf.filters.shipped import KNOWN_IMU, build_plus, trained_filter
from dlkf.filters.tuning import Tuning
from dlkf.onboard.compiled_filter import compile_filter, compile_or_keep
from dlkf.running.noise_fit import Evidence, find_noise
from dlkf.running.start import align_each
from dlkf.simulation.dataset import simulate

START, COARSE = StartLaw(0.1, 0.1, 1.0, 2.0), StartLaw(1.5, 0.3, 1.0, 3.0)
BEFORE_S, LENGTHS_S, MOST = (60, 300, 900), (30, 60, 120), 48
CONSTANTS = {"mbkf21_car": ("any_car", "gradient"), "mbkf33_car": ("any_car", "gradient")}
SOURCES = "+vibration_speed+receiver"
ORACLE = "true noise"
GIVEN = (ORACLE, KNOWN_IMU)  # a preset of each drive's IMU
REAL = ("rtkx", "wid", "wid_mru", "linkoping")
TRAINING: Mapping[str, tuple[str, ...]] = {
    "train_wide": ("simulated@dataset=wide", "seed=1", "dataset.hours=5.4", "dataset.drive_minutes=18"),
    "train_fleet": ("simulated@dataset=fleet", "seed=1", *COMMON),
    "train_still": ("simulated@dataset=fleet", "seed=12", *COMMON, *SILENT),
    "train_highway": ("simulated@dataset=highway", "seed=33", *COMMON),
}


@dataclass(frozen=True)
class Case:
    """Segments of one dataset with an outage from update ``first`` (B,) on, and its lengths that are scored [s]."""

    name: str
    before_s: int
    batch: Batch
    first: np.ndarray
    lengths_s: tuple[int, ...]
    groups: list[str]


@dataclass(frozen=True)
class Row:
    """Errors [m] by filter at the end of the outages of one length, NEES over them, and the recordings."""

    name: str
    before_s: int
    length_s: int
    errors: dict[str, np.ndarray]
    nees: dict[str, float]
    groups: list[str]


def load(folder: Path, rate_hz: float | None = None, fix_s: int = 1) -> list[Drive]:
    """Drives of a dataset, samples averaged to ``rate_hz``, else the usual, with a fix every ``fix_s`` seconds."""
    rate_hz = rate_hz or usual_rate(drive_rates(folder).values())
    drives = load_dataset(folder, rate_hz=rate_hz, epoch_s=1.0, dtype=torch.float64)
    return [replace(d, gnss_valid=d.gnss_valid & (torch.arange(d.epochs + 1) % fix_s == 0)[:, None]) for d in drives]


def simulated_cases(name: str, drives: Sequence[Drive]) -> Iterator[Case]:
    """Segments from the truth plus an error, end to end, at most so many."""
    stack, groups = DriveStack(drives), {d.name: d.group for d in drives}
    injected = name.startswith("kitti")
    plans = [(before, LENGTHS_S, before + 122.0, before + 122.0) for before in BEFORE_S]
    if injected:
        plans = [(22, (30,), 54.0, 30.0), (60, (30,), 92.0, 10.0), (60, (60,), 122.0, 10.0), (300, (60,), 362.0, 10.0)]
    for before, lengths, length, stride in plans:
        segments = cut_segments(stack, length, stride)
        if before == BEFORE_S[0] and not injected:
            segments = segments[:: -(-len(segments) // MOST)]
        if segments:
            law, draws = (COARSE if name.startswith("puck") else START), torch.Generator().manual_seed(7)
            batch = make_batch(stack, segments, dtype=torch.float64, start=law, generator=draws)
            if name.startswith("puck"):
                positions = batch.gnss_valid.clone()
                positions[..., 3:] = False
                batch = replace(batch, gnss_valid=positions)
            yield _case(name, before, batch, np.full(len(segments), before), lengths, groups)


def real_cases(name: str, drives: Sequence[Drive], before_s: int = 45, every_s: int = 10) -> Iterator[Case]:
    """Whole drives from their own alignment, an outage every so often from ``before_s`` on, each in its own run."""
    groups = {d.name: d.group for d in drives}
    starts = [(d, s) for d, s in zip(drives, align_each(drives, replace(ALIGN, from_rest=True, search_s=20.0)))]
    usable = [(d, s) for d, s in starts if not isinstance(s, InputError)]
    for length in (30, 60):
        runs = [(d, s, k) for d, s in usable for k in range(before_s, d.epochs - s.first - length, every_s)]
        if runs:
            batch = whole_drives([d for d, *_ in runs], [s for _, s, _ in runs])
            yield _case(name, before_s, batch, np.array([k for *_, k in runs]), (length,), groups)


def _case(
    name: str, before: int, batch: Batch, first: np.ndarray, lengths: tuple[int, ...], groups: Mapping[str, str]
) -> Case:
    t, start = torch.arange(batch.size[1]), torch.from_numpy(first)[:, None]
    hidden = (t >= start) & (t < start + lengths[-1])
    return Case(name, before, withhold_fixes(batch, hidden), first, lengths, [groups[d] for d in batch.drive])


def constants() -> dict[str, Estimator]:
    """The filters with factors of ``conf/tuning``, with ``automotive_mems``, alone and with the sources of ``plus``."""
    imu, found = imu_preset("automotive_mems"), {}
    for sources in ("", SOURCES):
        for kind, tunings in CONSTANTS.items():
            for tuning in tunings:
                name = kind + sources
                found[f"{name} {tuning}"] = build_causal(name, imu, "no", tuning=tuning_preset(tuning))
    return found


def found_noise(
    drives: Sequence[Drive], names: Sequence[str] = (*CONSTANTS, *(kind + SOURCES for kind in CONSTANTS))
) -> dict[str, Estimator]:
    """Filters, else those of :func:`constants`, with the noise that ``imu=auto`` finds for each on the drives."""
    evidence, imu, filters = Evidence.of(drives), imu_preset("automotive_mems"), {}
    for name in names:
        found = find_noise(evidence, name, imu, Tuning(), delay=False, compiler=compile_or_keep)
        filters[f"{name} auto"] = build_causal(name, found.imu, "no", tuning=found.tuning)
    return filters


def with_presets(case: Case, rows: Sequence[Row], folder: Path) -> list[Row]:
    """The rows with the errors of the filters that are given the preset of each drive's IMU: ``mbkf33_car`` with the
    sources of ``plus`` all of it, ``plus_imu`` all but the noise."""
    meta = pd.read_parquet(folder / "drives.parquet").set_index("group")["imu"]
    tuning = replace(Tuning(), lateral_std=0.07, vertical_std=0.1)
    presets = {k: imu_preset(k) for k in sorted(set(meta))}
    given = {ORACLE: {k: build_causal("mbkf33_car" + SOURCES, imu, "no", tuning=tuning) for k, imu in presets.items()}}
    given[KNOWN_IMU] = {k: build_plus(imu) for k, imu in presets.items()}
    for name, by_kind in given.items():
        found = []
        for row, of_kinds in zip(rows, score(case, by_kind), strict=True):
            kinds = [str(meta[g]) for g in row.groups]
            errors = np.array([of_kinds.errors[k][i] for i, k in enumerate(kinds)])
            nees = float(np.mean([of_kinds.nees[k] for k in kinds]))
            found.append(replace(row, errors=row.errors | {name: errors}, nees=row.nees | {name: nees}))
        rows = found
    return list(rows)


def score(case: Case, filters: Mapping[str, Estimator]) -> list[Row]:
    """A row for each length of outage that some segment holds."""
    batch, rows = case.batch, {}
    hidden, valid = (~batch.available & batch.present).numpy(), batch.truth_valid.numpy()
    for name, estimator in filters.items():
        with torch.inference_mode():
            solution = compile_filter(estimator, 1 / batch.dt, batch.epoch_s).integrate(batch)
        e = (solution.posterior.p_n - batch.truth.p_n)[..., :2].numpy()
        assert solution.std is not None
        square = 0.5 * ((e / solution.std[..., :2].numpy()) ** 2).sum(-1)
        for length in case.lengths_s:
            spans = [(b, slice(k, k + length)) for b, k in enumerate(case.first)]
            spans = [(b, s) for b, s in spans if s.stop <= e.shape[1] and hidden[b, s].all() and valid[b, s.stop - 1]]
            if spans:
                groups = [case.groups[b] for b, _ in spans]
                row = rows.setdefault(length, Row(case.name, case.before_s, length, {}, {}, groups))
                row.errors[name] = np.array([np.hypot(*e[b, s.stop - 1]) for b, s in spans])
                row.nees[name] = float(np.mean([square[b, s][valid[b, s]].mean() for b, s in spans]))
    return list(rows.values())


def markdown(rows: Sequence[Row]) -> list[str]:
    """RMS / geometric mean of every filter, ratios of ``plus`` to the best other one without ``auto``, its NEES."""
    after = [name for name in rows[0].errors if name.endswith(" auto") or name in GIVEN]
    baselines = [name for name in rows[0].errors if name != "plus" and name not in after]
    head = ["data", "GNSS [s]", "outage [s]", "outages (recordings)", "plus", "RMS ratio", "geometric", "NEES"]
    head += [*baselines, *after]
    lines = [f"| {' | '.join(head)} |", f"|:--|{'--:|' * (len(head) - 1)}"]
    for row in rows:
        best = min(baselines, key=lambda f: mean_error(row.errors[f], "log"))
        cells = [row.name, str(row.before_s), str(row.length_s), f"{len(row.groups)} ({len(set(row.groups))})"]
        errors = {n: f"{mean_error(e, 'rms'):.1f} / {mean_error(e, 'log'):.2f}" for n, e in row.errors.items()}
        cells.append(errors["plus"])
        cells += [ratio(row.errors["plus"], row.errors[best], row.groups, s) for s in ("rms", "geomean")]
        cells.append(f"{row.nees['plus']:.1f}")
        cells += [f"**{errors[name]}**" if name == best else errors[name] for name in (*baselines, *after)]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def pooled(rows: Sequence[Row]) -> list[str]:
    """Over rows, real and simulated apart: geometric means of each filter's RMS and geometric mean [m], mean NEES; and
    the ratio of ``plus`` to it, geometric mean over all outages with its interval."""
    names = list(rows[0].errors)
    lines = [f"| over all rows | {' | '.join(names)} |", f"|:--|{'--:|' * len(names)}"]
    real = {*REAL, *INJECTED}
    kinds = {"real motion": [r for r in rows if r.name in real]}
    kinds |= {
        f"simulated, {t} s of GNSS": [r for r in rows if r.name not in real and r.before_s == t] for t in BEFORE_S
    }
    for kind, chosen in kinds.items():
        if chosen:
            means = [
                [np.exp(np.mean([np.log(mean_error(r.errors[n], s)) for r in chosen])) for s in ("rms", "log")]
                for n in names
            ]
            nees = [np.mean([r.nees[n] for r in chosen]) for n in names]
            cells = [f"{a:.2f} / {b:.2f} ({c:.1f})" for (a, b), c in zip(means, nees)]
            lines.append(f"| {kind} | {' | '.join(cells)} |")
            both = np.concatenate([r.errors["plus"] for r in chosen])
            groups = [f"{recorded(r.name)} {g}" for r in chosen for g in r.groups]
            others = {name: np.concatenate([r.errors[name] for r in chosen]) for name in names if name != "plus"}
            ratios = [ratio(both, others[name], groups) if name in others else "" for name in names]
            lines.append(f"| `plus` : it | {' | '.join(ratios)} |")
    return lines


def recorded(name: str) -> str:
    """The trips of a dataset: those of ``kitti_*`` are the same, and those of ``wid`` and ``wid_mru``."""
    return name.partition("_")[0] if name in (*INJECTED, *REAL) else name


def train(data: Path, out: Path) -> None:
    """Constants by gradient into ``out/tuning``, and fresh weights of ``plus`` by its experiment."""
    for name, words in TRAINING.items():
        if not (data / name).is_dir():
            simulate(compose_recipe(*words), data / name, workers=1)
    stack = DriveStack([d for name in TRAINING for d in load(data / name)])
    segments = cut_segments(stack, 242.0, 242.0)
    segments = segments[:: -(-len(segments) // 44)]
    batch = make_batch(stack, segments, dtype=torch.float64, start=START, generator=torch.Generator().manual_seed(7))
    t = torch.arange(batch.size[1])
    batch = withhold_fixes(batch, ((t >= 180) & (t < 240)).expand(batch.size[:2]))
    (out / "tuning").mkdir(parents=True, exist_ok=True)
    for name in CONSTANTS:
        start = Tuning(10.0, 2.0, 5.0, 5.0, 1.5, 1.5, lateral_std=0.1, vertical_std=0.15)
        kalman = build_filter(name, imu_preset("automotive_mems"), tuning=start)
        assert isinstance(kalman, Mbkf)
        found = tune_by_gradient(kalman, batch, 239, steps=30)
        file = out / "tuning" / f"gradient_{name}.yaml"
        file.write_text(yaml.safe_dump(asdict(found), sort_keys=False))
    subprocess.run([sys.executable, "-m", "dlkf.train", "+experiment=plus", "seed=0"], check=True)


def main() -> None:
    """Simulate, find, run, write."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--real", type=Path, help="folder of real datasets; without it only simulated ones")
    arguments.add_argument("--data", type=Path, default=Path("data/plus"), help="where test sets lie, or are made")
    arguments.add_argument("--sets", nargs="+", help="only these datasets; others of your own lie in --data too")
    arguments.add_argument("--no-auto", action="store_true", help="without imu=auto, which takes most of the time")
    arguments.add_argument("--oracle", action="store_true", help="beside a filter given the noise of simulated drives")
    arguments.add_argument("--parts", action="store_true", help="against itself without a part")
    arguments.add_argument("--model", default="plus", help="weights: plus, or a folder")
    arguments.add_argument("--rate", type=float, help="of the IMU samples that the filters get [Hz], else the usual")
    arguments.add_argument("--fix-interval", type=int, default=1, help="of the fixes that the filters get [s]")
    arguments.add_argument("--train", action="store_true", help="constants and weights anew, first")
    arguments.add_argument("--out", type=Path, default=Path("outputs/plus"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.train:
        train(options.data, options.out)
    wanted = options.sets or (*SIMULATED, *PYTHON_INS, *INJECTED)
    simulate_sets(options.data, options.real, wanted)
    folders = {name: options.data / name for name in (*SIMULATED, *PYTHON_INS)}
    if options.real is not None:
        real = {name: options.real / name for name in REAL if (options.real / name).is_dir()}
        folders = {**{name: options.data / name for name in INJECTED}, **real, **folders}
    if options.sets is not None:
        folders = {name: folders.get(name, options.data / name) for name in options.sets}
    for name, folder in folders.items():
        if not folder.is_dir():
            arguments.error(f"no dataset {name}: {folder} is no folder; real ones need --real")
    rows, digests = [], {}
    for name, folder in folders.items():
        drives, digests[name] = load(folder, options.rate, options.fix_interval), dataset_digest(folder)
        found = {} if options.no_auto or options.parts else found_noise(drives)
        baselines = parts(options.model) if options.parts else {**constants(), **found}
        filters = {**baselines, "plus": trained_filter(options.model)}
        for case in real_cases(name, drives) if name in REAL else simulated_cases(name, drives):
            scored = score(case, filters)
            simulated = name in SIMULATED or name in PYTHON_INS
            rows += with_presets(case, scored, folder) if options.oracle and simulated else scored
            print("\n".join(markdown(rows[-1:])[2:]), flush=True)
    lines = [*markdown(rows), "", *pooled(rows)]
    (options.out / "table.md").write_text("\n".join(lines) + "\n")
    made = {**describe_provenance(), "rate_hz": options.rate, "fix_interval_s": options.fix_interval}
    made |= {"simulated": dict(SIMULATED), "injected": INJECTED, "digests": digests}
    (options.out / "manifest.json").write_text(json.dumps(made, indent=1) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
