"""Noise estimated without a reference, as a preset and factors for the other commands."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import yaml

from dlkf.base.files import write_into
from dlkf.evaluation.table import ResultTable, as_markdown, format_number
from dlkf.filters.tuning import FittedOn, Tuning
from dlkf.navigation.imu_errors import NEEDED, ImuSpec
from dlkf.running.likelihood import NO_OFFSET, NoiseFit


def noise_table(model: str, dataset: str, imu: ImuSpec, tuning: Tuning, found: NoiseFit) -> ResultTable:
    """Every value before and after."""
    before, after = NoiseFit(imu, tuning, NO_OFFSET, NO_OFFSET, 0.0, 0.0).describe(), found.describe()
    rows = [[key, format_number(before[key]), format_number(after[key])] for key in after]
    return ResultTable(
        title=f"{model} on {dataset}: noise under which the fixes are most likely",
        note=f"SI units; mean −ln p of a fix {format_number(found.before)} before, {format_number(found.after)} after. "
        f"No reference was used. {found.describe_offset()}".strip(),
        columns=["Value", f"As {imu.name}", "Found"],
        rows=rows,
    )


def write_noise(out: str | Path, found: NoiseFit, table: ResultTable, fitted_on: FittedOn) -> list[str]:
    """Write imu/<name>.yaml, tuning/<name>.yaml and table.md into ``out``, all or none; their names."""
    factors = found.tuning.factors() | {"fitted_on": asdict(fitted_on)}
    name = found.imu.name
    usual = type(found.imu.accel)()
    sensors = {
        s: {k: v for k, v in asdict(getattr(found.imu, s)).items() if k in NEEDED or v != getattr(usual, k)}
        for s in ("accel", "gyro")
    }
    preset = {"name": name, "source": found.imu.source, **sensors}
    with write_into(out) as folder:
        for kind, values in (("imu", preset), ("tuning", factors)):
            (folder / kind).mkdir()
            text = f"# {table.title}\n{yaml.safe_dump(values, sort_keys=False)}"
            (folder / kind / f"{name}.yaml").write_text(text, encoding="utf-8")
        (folder / "table.md").write_text(as_markdown(table), encoding="utf-8")
    return [f"imu/{name}.yaml", f"tuning/{name}.yaml", "table.md"]
