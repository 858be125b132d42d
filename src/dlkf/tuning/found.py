"""Noise found without a reference, as a preset and factors that the other commands take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import yaml

from dlkf.console import counting
from dlkf.data.drive import Drive
from dlkf.evaluation.table import Table, as_markdown, number
from dlkf.files import staged
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import NEEDED, ImuSpec
from dlkf.running.likelihood import AS_TOLD, Evidence, Found, find_noise


def found_noise(
    drives: Sequence[Drive], model: str, imu: ImuSpec, tuning: Tuning, *, minutes: float, name: str
) -> Found:
    """:func:`dlkf.running.likelihood.find_noise` on drives, under a bar."""
    evidence = Evidence.of(drives, minutes)
    with counting(f"Noise for {model}") as progress:
        return find_noise(evidence, model, imu, tuning, called=name, progress=progress)


def noise_table(model: str, dataset: str, imu: ImuSpec, tuning: Tuning, found: Found) -> Table:
    """Every value before and after."""
    before, after = Found(imu, tuning, AS_TOLD, AS_TOLD, 0.0, 0.0).described(), found.described()
    rows = [[key, number(before[key]), number(after[key])] for key in after]
    return Table(
        title=f"{model} on {dataset}: noise under which the fixes are most likely",
        note=f"SI units; mean −ln p of a fix {number(found.before)} before, {number(found.after)} after. No reference "
        f"was used. {found.told_of_fixes()}".strip(),
        columns=["Value", f"As {imu.name}", "Found"],
        rows=rows,
    )


def write_noise(out: str | Path, found: Found, table: Table) -> list[str]:
    """Write imu/<name>.yaml, tuning/<name>.yaml and table.md into ``out``, all or none; their names."""
    name = found.imu.name
    usual = type(found.imu.accel)()
    sensors = {
        s: {k: v for k, v in asdict(getattr(found.imu, s)).items() if k in NEEDED or v != getattr(usual, k)}
        for s in ("accel", "gyro")
    }
    preset = {"name": name, "source": found.imu.source, **sensors}
    with staged(out) as folder:
        for kind, values in (("imu", preset), ("tuning", asdict(found.tuning))):
            (folder / kind).mkdir()
            text = f"# {table.title}\n{yaml.safe_dump(values, sort_keys=False)}"
            (folder / kind / f"{name}.yaml").write_text(text)
        (folder / "table.md").write_text(as_markdown(table))
    return [f"imu/{name}.yaml", f"tuning/{name}.yaml", "table.md"]
