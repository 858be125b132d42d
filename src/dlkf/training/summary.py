"""A study in few numbers and few words, for the tracking server."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from dlkf.evaluation.report import all_tables
from dlkf.evaluation.table import as_markdown
from dlkf.training.study import Outcome


def key_metrics(outcome: Outcome) -> dict[str, float]:
    """``test/<filter>/…`` for the MLflow comparison: outage errors, RMS over the pieces, bias slopes, times."""
    metrics = {f"time/{k}_s": v for k, v in outcome.seconds.items()}
    for result in outcome.results:
        prefix = "test" if len(outcome.results) == 1 else f"test/{result['kind']}"
        for name, values in result["filters"].items():
            flat = {"position_rms_m": values["pieces"]["position"]["all"]["rms"]}
            flat["velocity_rms_mps"] = values["pieces"]["velocity"]["all"]["rms"]
            flat["attitude_rms_rad"] = values["pieces"]["attitude"]["all"]["rms"]
            if "outages" in values:
                flat["outage_position_rms_m"] = values["outages"]["rms"]["position"]["rms"]
                flat["outage_horizontal_rms_m"] = values["outages"]["rms"]["horizontal"]["rms"]
                flat["outage_end_horizontal_m"] = values["outages"]["end"]["horizontal"]["rms"]
            slopes = values["imu_error"].get("injected_slope") or []
            flat |= {f"bias_slope_{axis}": s for axis, s in zip(("ax", "ay", "az", "gx", "gy", "gz"), slopes)}
            metrics |= {f"{prefix}/{name}/{k}": float(v) for k, v in flat.items() if v is not None}
    return {k: v for k, v in metrics.items() if math.isfinite(v)}


def note(config: Mapping[str, Any], outcome: Outcome) -> str:
    """The tables as a Markdown note of the run."""
    datasets = ", ".join(config["data"]["datasets"])
    tables = "\n".join(as_markdown(t) for t in all_tables(datasets, outcome.results))
    return f"{config['name']}: {config['model']['kind']} on {datasets}, seed {config['seed']}\n\n{tables}"
