"""An evaluation in few numbers and in one sentence: what a tracking server compares, what a person asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from dlkf.evaluation.table import number

ASKED_S = ("30", "60", "20", "10", "40", "50")  # times without GNSS, the first that the outages reach is told


def metrics_of(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """``test/<filter>/…``: errors in outages and over the pieces, slope of the IMU-error estimate; finite ones.

    With several kinds of data ``test/<kind>/<filter>/…``. The slopes are means over the three axes.
    """
    metrics: dict[str, float] = {}
    for result in results:
        prefix = "test" if len(results) == 1 else f"test/{result['kind']}"
        for name, values in result["filters"].items():
            pieces, flat = values["pieces"], {}
            flat["position_rms_m"] = pieces["position"]["all"]["rms"]
            flat["velocity_rms_mps"] = pieces["velocity"]["all"]["rms"]
            flat["attitude_rms_deg"] = math.degrees(pieces["attitude"]["all"]["rms"])
            if "outages" in values:
                flat["outage_position_rms_m"] = values["outages"]["rms"]["position"]["rms"]
                flat["outage_horizontal_rms_m"] = values["outages"]["rms"]["horizontal"]["rms"]
                flat["outage_end_horizontal_m"] = values["outages"]["end"]["horizontal"]["rms"]
            slopes = values["imu_error"].get("injected_slope") or []
            for sensor, three in (("accel", slopes[:3]), ("gyro", slopes[3:])):
                known = [s for s in three if s is not None]
                if known:
                    flat[f"bias_slope_{sensor}"] = sum(known) / len(known)
            metrics |= {f"{prefix}/{name}/{k}": float(v) for k, v in flat.items() if v is not None}
    return {k: v for k, v in metrics.items() if math.isfinite(v)}





def asked(result: Mapping[str, Any]) -> str | None:
    """The time without GNSS [s] that the answer is about, as the results name it; None without outages."""
    outages = [f["outages"]["at"] for f in result["filters"].values() if "outages" in f]
    if not outages or not outages[0]:
        return None
    return next((s for s in ASKED_S if s in outages[0]), next(iter(outages[0])))


def answer(result: Mapping[str, Any]) -> str:
    """The answer to "how far does it drift?" in one sentence, of the best filter and of the best classical one.

    "After 30 s without GNSS: 10 m in half of the cases, 24 m in 95 %, with dlkf; best classical (mbkf21_car) 14, 31."
    The best has the least median; of filters without outages, the least error over the pieces.
    """
    filters, seconds = result["filters"], asked(result)
    if seconds is None:
        errors = {n: f["pieces"]["horizontal"]["settled"] for n, f in filters.items()}
        lead = "With GNSS throughout"
    else:
        errors = {n: f["outages"]["at"][seconds]["horizontal"] for n, f in filters.items()}
        lead = f"After {seconds} s without GNSS"
    errors = {n: e for n, e in errors.items() if not math.isnan(e["median"])}
    if not errors:
        return "No filter could be scored: there is no valid truth where it counts."
    order = sorted(errors, key=lambda n: errors[n]["median"])
    best = errors[order[0]]
    text = f"{lead}: {number(best['median'])} m in half of the cases, {number(best['p95'])} m in 95 %, with {order[0]}"
    classical = next((n for n in order if is_classical(n)), None)
    if is_classical(order[0]):
        second = next((n for n in order[1:]), None)
        if second is not None:
            text += f"; next {second} {number(errors[second]['median'])}, {number(errors[second]['p95'])} m"
    elif classical is not None:
        text += f"; best classical ({classical}) {number(errors[classical]['median'])}, "
        text += f"{number(errors[classical]['p95'])} m"
    return text + "."


def is_classical(name: str) -> bool:
    """Whether a name in a table is that of a model-based filter."""
    return name == "ins" or name.split("_")[0] in ("mbkf15", "mbkf21", "mbkf33", "aekf")
