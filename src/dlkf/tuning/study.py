"""Fit a filter's over-bounding factors on training drives and check them on test drives (R016, R018); what that, or
noise found without a reference, leaves behind."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd
import yaml

from dlkf.base.errors import InputError
from dlkf.base.files import write_into
from dlkf.data.drive import Batch, Drive
from dlkf.data.splits import Split, split_rows
from dlkf.data.stack import DriveStack
from dlkf.evaluation.metrics import OBJECTIVES, PVA, outage_intervals
from dlkf.evaluation.protocol import Protocol, Scenes, describe_short
from dlkf.evaluation.summary import FEW
from dlkf.evaluation.table import ResultTable, as_markdown, format_number
from dlkf.filters.build import FilterName, build_causal, has_prior, is_filter
from dlkf.filters.tuning import FittedOn, Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.running.noise_fit import NO_OFFSET, NoiseFit
from dlkf.tuning.search import Trial, evaluate_objective, tune_under_bar

LIKELIHOOD = "likelihood"  # the objective that needs no reference (dlkf.running.noise_fit)
OF_OUTAGES = "log, rms, median: horizontal error at the end of the outages [m], geometric mean, RMS, median over them."
OF_SEGMENTS = (
    "pva: geometric mean of the RMS of position [m], velocity [m/s] and attitude [rad] over each segment. "
    "Fitted on the training drives alone."
)


@dataclass(frozen=True)
class TuningResult:
    """Factors before and after, the trials, and the objectives' values: (side, objective, before, after)."""

    model: str
    before: Tuning
    after: Tuning
    trials: tuple[Trial, ...]
    errors: tuple[tuple[str, str, float, float], ...]
    left_out: tuple[str, ...] = ()  # drives, and why
    compared: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # by side: outages (or segments), drives

    @property
    def changed(self) -> dict[str, float]:
        """Settings that are not the defaults."""
        default = Tuning().factors()
        return {k: v for k, v in self.after.factors().items() if v != default[k]}

    def metrics(self) -> dict[str, float]:
        """For a log: ``train/outage_rms/tuned``, ``test/pva/untuned`` and the like."""
        return {
            f"{side}/{objective if objective == PVA else f'outage_{objective}'}/{when}": value
            for side, objective, *values in self.errors
            for when, value in zip(("untuned", "tuned"), values)
        }


def check_settings(model: str, objective: str) -> None:
    """Raises InputError for a name that is no Kalman filter to be tuned, or an unknown objective."""
    if not is_filter(model) or model == "ins":
        raise InputError(f"model={model} has no noise to tune; give the name of a Kalman filter, such as mbkf21")
    if "rts" in FilterName.parse(model).endings:
        raise InputError(f"model={model} is smoothed, its noise is that of the filter; tune it without _rts")
    if has_prior(model) and objective == LIKELIHOOD:
        raise InputError(f"model={model}: the noise of an IMU does not depend on a prior; give the name without _prior")
    if objective not in (known := (*OBJECTIVES, PVA, LIKELIHOOD)):
        raise InputError(f"objective={objective} is none of {', '.join(known)}")


def train_test_drives(
    drives: Sequence[Drive], split: Split, fractions: Sequence[float], seed: int, length_s: float
) -> dict[str, list[Drive]]:
    """Training and test drives, whole recordings on one side; split as in :mod:`dlkf.data.splits`.

    Raises InputError for a split that cuts drives: the test would be of the drives that were tuned on.
    """
    if split == "random":
        raise InputError("split=random puts parts of a drive on both sides; tune needs split=group, or groups by name")
    stack = DriveStack(drives)
    labels = split_rows(stack, split, fractions, seed, length_s)
    out = {}
    for side in ("train", "test"):
        rows = zip(stack.first_row.tolist(), stack.epochs.tolist())
        out[side] = [d for d, (row, n) in zip(stack, rows) if bool((labels[side][row : row + n] >= 0).any())]
    return out


def withhold_outages(
    drives: Sequence[Drive], protocol: Protocol, segments: int | None = None, left_out: list[str] | None = None
) -> list[Batch]:
    """Batches of drives with their outages, if there are any, of at most so many segments, spread evenly.

    What is left out of them, and why, is added to ``left_out``. Raises InputError if the protocol has an outage and
    none fits.
    """
    scenes = Scenes(drives, protocol, limit=segments)
    kept = scenes.withhold()
    if left_out is not None:
        short = [describe_short(scenes.short, len(drives), protocol)] if scenes.short else []
        left_out += [*scenes.skipped.values(), *short]
    if protocol.outage and not any(bool((~b.available & b.truth_valid & b.present).any()) for b in kept):
        longest = max(d.epochs * d.epoch_s for d in drives)
        raise InputError(
            f"no outage fits into the reference of the training drives (the longest has {longest:.0f} s); make "
            "outage.first_s, outage.duration_s or length_s smaller, or take objective=likelihood, which needs neither"
        )
    return kept


def search(
    model: str,
    imu: ImuSpec,
    drives: Mapping[str, Sequence[Drive]],
    protocol: Protocol,
    *,
    start: Tuning,
    objective: str,
    rounds: int,
    segments: int | None,
    prior: Prior | None = None,
) -> TuningResult:
    """Fit on ``drives["train"]``, then errors before and after on both sides; ``prior`` of a filter with ``_prior``."""
    if protocol.outage is None and objective != PVA:
        raise InputError(f"objective={objective} scores outages, but outage=null has none; give objective={PVA}")
    left_out: list[str] = []
    training = withhold_outages(drives["train"], protocol, segments, left_out)
    after, _, trials = tune_under_bar(imu, training, model, rounds, start=start, objective=objective, prior=prior)
    batches = {"train": training}
    if drives["test"]:
        batches["test"] = withhold_outages(drives["test"], protocol, left_out=left_out)
    old, new = (build_causal(model, imu, "tuning does not", tuning=t, prior=prior) for t in (start, after))
    compared = {side: _count_compared(part, protocol.outage is not None) for side, part in batches.items()}
    objectives = (*OBJECTIVES, PVA) if protocol.outage else (PVA,)
    errors = [
        (side, name, evaluate_objective(old, part, name), evaluate_objective(new, part, name))
        for side, part in batches.items()
        for name in objectives
    ]
    return TuningResult(model, start, after, tuple(trials), tuple(errors), tuple(left_out), compared)


def _count_compared(batches: Sequence[Batch], outages: bool) -> tuple[int, int]:
    """Outages that are scored, or segments, and the drives that they are of."""
    each: Counter[str] = Counter()
    for batch in batches:
        hidden = ~batch.available & batch.truth_valid & batch.present
        rows = outage_intervals(hidden.cpu().numpy()).segment if outages else range(len(hidden))
        each.update(batch.drive[row] for row in rows)
    return each.total(), len(each)


def tuning_table(result: TuningResult, dataset: str) -> ResultTable:
    """Errors before and after, on both sides."""
    rows = [
        [side, objective, format_number(before), format_number(after), format_number(after / before)]
        for side, objective, before, after in result.errors
    ]
    outages = any(objective != PVA for _, objective, *_ in result.errors)
    kind = "outage" if outages else "segment"
    compared = [describe_compared(side, kind, *counts) for side, counts in result.compared.items()]
    objectives = [OF_OUTAGES, OF_SEGMENTS] if outages else [OF_SEGMENTS]
    factors = ", ".join(f"{k}={v:g}" for k, v in result.changed.items()) or "all as they were"
    return ResultTable(
        title=f"{result.model} on {dataset}: {factors}",
        note=" ".join([*compared, *objectives, *(f"Left out: {line}." for line in result.left_out)]),
        columns=["Drives", "Objective", "Before", "After", "Ratio"],
        rows=rows,
    )


def describe_compared(side: str, kind: str, count: int, drives: int) -> str:
    """How much the errors of one side are of."""
    many = f"{side}: {count} {kind}{'s' * (count != 1)} of {drives} drive{'s' * (drives != 1)}"
    return many + (", too few to conclude from." if side == "test" and count < FEW else ".")


def noise_table(model: str, dataset: str, imu: ImuSpec, tuning: Tuning, found: NoiseFit) -> ResultTable:
    """Every value before and after, of noise that was found without a reference."""
    before, after = NoiseFit(imu, tuning, NO_OFFSET, NO_OFFSET, 0.0, 0.0).describe(), found.describe()
    return ResultTable(
        title=f"{model} on {dataset}: noise under which the fixes are most likely",
        note=f"SI units; mean −ln p of a fix {format_number(found.before)} before, {format_number(found.after)} after. "
        f"No reference was used. {found.describe_offset()}".strip(),
        columns=["Value", f"As {imu.name}", "Found"],
        rows=[[key, format_number(before[key]), format_number(after[key])] for key in after],
    )


def write_noise(out: str | Path, found: NoiseFit, table: ResultTable, fitted_on: FittedOn) -> list[str]:
    """Write imu/<name>.yaml, tuning/<name>.yaml and table.md into ``out``, all or none; their names."""
    factors = found.tuning.factors() | {"fitted_on": asdict(fitted_on)}
    name = found.imu.name
    return _write(out, table, {f"imu/{name}": found.imu.as_preset(), f"tuning/{name}": factors})


def write_tuning(
    out: str | Path, name: str, result: TuningResult, table: ResultTable, fitted_on: FittedOn
) -> list[str]:
    """Write tuning/<name>.yaml, table.md, search.csv and errors.json into ``out``, all or none; their names."""
    factors = result.after.factors() | {"fitted_on": asdict(fitted_on)}
    trials = pd.DataFrame(result.trials, columns=["factor", "value", "objective"])
    more = {
        "search.csv": trials.to_csv(index=False, lineterminator="\n"),
        "errors.json": json.dumps(result.metrics(), indent=1) + "\n",
    }
    return _write(out, table, {f"tuning/{name}": factors}, more)


def _write(
    out: str | Path, table: ResultTable, presets: Mapping[str, Any], more: Mapping[str, str] = MappingProxyType({})
) -> list[str]:
    """Presets under the table's title, table.md and ``more`` files, all or none; their names."""
    head = f"# {table.title}\n"
    files = {f"{key}.yaml": head + yaml.safe_dump(values, sort_keys=False) for key, values in presets.items()}
    files |= {"table.md": as_markdown(table), **more}
    with write_into(out) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
    return list(files)
