"""An evaluation in few numbers and in one sentence: what a tracking server compares, what a person asks for."""

from __future__ import annotations

import math
from collections.abc import Sequence

from dlkf.evaluation.results import Results
from dlkf.evaluation.table import DEGREES, number

ASKED_S = ("30", "60", "20", "10", "40", "50")  # times without GNSS, the first that the outages reach is told
FEW = 20  # outages or pieces; fewer have no 95 %: their worst is told instead
END = ("outages", "end", "horizontal")
METRICS = {
    "outage_end_horizontal_m": (*END, "rms"),
    "outage_end_horizontal_median_m": (*END, "median"),
    "position_rms_m": ("pieces", "all", "position", "rms"),
    "attitude_rms_deg": ("pieces", "all", "attitude", "rms"),
}


def metrics_of(results: Sequence[Results]) -> dict[str, float]:
    """``test/<filter>/…``: the few numbers by which runs are compared, finite ones; the report has all.

    ``ratio_…`` are to the baseline, of the error at the end of the outages, RMS and geometric mean. With several kinds
    of data ``test/<kind>/<filter>/…``.
    """
    metrics: dict[str, float] = {}
    for result in results:
        prefix = "test" if len(results) == 1 else f"test/{result.kind}"
        for name in result.filters:
            flat = {key: result.value(name, *which) for key, which in METRICS.items()}
            flat["attitude_rms_deg"] *= DEGREES
            for statistic in ("rms", "geomean"):
                c = result.versus(name, *END, statistic)
                flat |= {} if c is None else {f"ratio_{statistic}": c.ratio}
            metrics |= {f"{prefix}/{name}/{k}": v for k, v in flat.items()}
    return {k: v for k, v in metrics.items() if math.isfinite(v)}


def asked(result: Results) -> str | None:
    """The time without GNSS [s] that the answer is about, as the results name it; None without outages."""
    reached = result.seconds_into_outage()
    return next((s for s in (*ASKED_S, *reached) if s in reached), None)


def answer(result: Results) -> str:
    """The answer to "how far does it drift?" in one sentence, of the best filter and of the best classical one.

    "After 30 s without GNSS: 10 m in half of the cases, 24 m in 95 %, with dlkf; best classical (mbkf21_car) 14, 31."
    The best has the least median; of filters without outages, the least error over the pieces. Of few outages the worst
    is told, of one just that.
    """
    seconds = asked(result)
    if seconds is None:
        where, lead, unit = ("pieces", "settled", "horizontal"), "With GNSS throughout", "piece"
    else:
        where, lead, unit = ("outages", f"at {seconds} s", "horizontal"), f"After {seconds} s without GNSS", "outage"
    count = int(result.count.get(f"{unit}s") or 0)
    statistics = ("median", "p95") if count >= FEW else ("median", "max") if count > 1 else ("median",)
    errors = {n: tuple(result.value(n, *where, s) for s in statistics) for n in result.filters}
    order = sorted((n for n in errors if not math.isnan(errors[n][0])), key=lambda n: errors[n][0])
    if not order:
        return "No filter could be scored: there is no valid truth where it counts."
    told = {n: tuple(map(number, errors[n])) for n in order}
    text = f"{lead}: {_spread(told[order[0]], count, unit)}, with {order[0]}"
    classical = next((n for n in order if is_classical(n)), None)
    if is_classical(order[0]):
        if order[1:]:
            text += f"; next {order[1]} {', '.join(told[order[1]])} m"
    elif classical is not None:
        text += f"; best classical ({classical}) {', '.join(told[classical])} m"
    return f"{text}."


def _spread(told: tuple[str, ...], count: int, unit: str) -> str:
    if count >= FEW:
        return f"{told[0]} m in half of the cases, {told[1]} m in 95 %"
    if count == 1:
        return f"{told[0]} m in one {unit}"
    return f"{told[0]} m in half of {count} {unit}s, {told[1]} m in the worst"


def is_classical(name: str) -> bool:
    """Whether a name in a table is that of a model-based filter."""
    return name == "ins" or name.split("_")[0] in ("mbkf15", "mbkf21", "mbkf33", "aekf")
