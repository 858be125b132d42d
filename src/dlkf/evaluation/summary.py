"""An evaluation in a few metrics for the tracking server and in one sentence for the reader."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from dlkf.evaluation.bootstrap import MIN_GROUPS
from dlkf.evaluation.results import Results
from dlkf.evaluation.scores import Scores
from dlkf.evaluation.table import DEGREES, format_length, format_number, format_ratios
from dlkf.filters.build import is_filter
from dlkf.filters.tuning import Tuning
from dlkf.running.innovations import OF_NETWORK, REMEDY, fit_sigma

FEW = 20  # outages or segments; fewer have no 95 %: their largest error stands instead
THROUGHOUT_S = 5.0  # the longest time without a fix that is no gap
END, SETTLED = ("outages", "end", "horizontal"), ("segments", "settled", "horizontal")
METRICS = {
    "outage_end_horizontal_m": (*END, "rms"),
    "outage_end_horizontal_median_m": (*END, "median"),
    "position_rms_m": ("segments", "all", "position", "rms"),
    "attitude_rms_deg": ("segments", "all", "attitude", "rms"),
}


def collect_metrics(results: Sequence[Results]) -> dict[str, float]:
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


def headline(result: Results) -> str:
    """The answer to "how far does the car drift?" in plain words: of the outages asked for, of the best
    filter and of the best classical one, or the next where the best is classical.

    "60 s without GNSS, 40 outages: plus ends 8.8 m from the reference in the median (1.4 % of the distance driven),
    within 33 m in 95 % of them; best classical filter mbkf21_car 10 m, 41 m." The best has the least median. Of fewer
    than :data:`FEW` outages the largest error takes the place of the 95 %, with a warning. A smoothed filter comes
    last: its errors are largest within the outage. Without outages the horizontal error over the settled part of the
    segments, with the longest time without a fix unless it is short.
    """
    span = result.count["outage_s"]
    where = END if span else SETTLED
    unit = "outage" if span else "segment"
    count = int(result.count.get(f"{unit}s") or 0)
    statistics = ("median", "p95") if count >= FEW else ("median", "max") if count > 1 else ("median",)
    errors = {n: tuple(result.value(n, *where, s) for s in statistics) for n in result.filters}
    order = sorted((n for n in errors if not math.isnan(errors[n][0])), key=lambda n: errors[n][0])
    if not order:
        return "No filter could be scored: there is no valid reference where it counts."
    smoothed = [n for n in order if n.endswith("_rts")]
    order = [n for n in order if n not in smoothed] or order
    best, texts = order[0], {n: [f"{format_number(x)} m" for x in errors[n]] for n in errors}
    gap = result.count.get("longest_without_fix_s", math.inf)
    own = "With GNSS throughout" if gap <= THROUGHOUT_S else "With all fixes of the drives"
    own += f", at most {gap:.3g} s without one" if THROUGHOUT_S < gap < math.inf else ""
    lead = f"{format_length(*span)} without GNSS" if span else own
    text = f"{lead}, {count} {unit}{'s' if count > 1 else ''}: {best} ends " if span else f"{lead}: {best} is "
    drift = result.value(best, "outages", "end", "drift", "median") if span else math.nan
    share = f" ({format_number(100 * drift, digits=2)} % of the distance driven)" if math.isfinite(drift) else ""
    text += _spread(texts[best], count, unit, share)
    other = next((n for n in order[1:] if is_filter(best) or is_filter(n)), None)
    if other is not None:
        which = "next" if is_filter(best) else "best classical filter"
        text += f"; {which} {other} {', '.join(texts[other])}"
    if span and smoothed:
        size = "" if best in smoothed else f": {smoothed[0]} {', '.join(texts[smoothed[0]])}"
        text += f"; smoothed with the fixes after it, where its errors are smallest{size}"
    few = f" Based on {count} {unit}{'s' if count > 1 else ''} only; larger errors can occur." if count < FEW else ""
    return f"{text}.{few}"


def describe_verdict(result: Results, name: str) -> str | None:
    """How a filter compares with the baseline and with the best other filter, by the geometric mean at the end of the
    outages: better, worse, no significant difference (the 95 % interval includes 1), or too few recordings for one.
    None without outages."""
    if not result.count["outage_s"] or name not in result.filters:
        return None
    medians = {n: result.value(n, *END, "median") for n in result.filters if n != name}
    best = min((n for n in medians if math.isfinite(medians[n])), key=medians.__getitem__, default=None)
    text = f"{name}: {format_number(result.value(name, *END))} m RMS at the end of the outages"
    baseline = result.baseline
    comparison = result.versus(name, *END, "geomean")
    if baseline is not None and comparison is not None:
        ratio, low, high = format_ratios(comparison.ratio, comparison.ratio_low, comparison.ratio_high)
        if comparison.groups < MIN_GROUPS:
            direction = "worse" if comparison.ratio > 1 else "better" if comparison.ratio < 1 else "neither is better"
            verdict = f"{ratio} by geometric mean: {direction}, but too few recordings for an interval"
        else:
            less, more = comparison.ratio_high < 1, comparison.ratio_low > 1
            direction = "better" if less else "worse" if more else "no significant difference"
            verdict = f"{ratio} [{low}, {high}] by geometric mean: {direction}"
        text += f"; {baseline} {format_number(result.value(baseline, *END))} m; {name} : {baseline} = {verdict}"
    if best is not None and best != baseline:
        text += f"; best other filter {best} {format_number(result.value(best, *END))} m"
    return f"{text}."


def describe_untuned(models: Iterable[str], tuning: Tuning, imu: str) -> str | None:
    """A line where Kalman filters stand beside a learned one with the noise of a preset as it is, else None."""
    named = list(models)
    kalman = [name for name in named if is_filter(name) and name != "ins"]
    if not kalman or all(map(is_filter, named)) or tuning != Tuning():
        return None
    return (
        f"{', '.join(kalman)}: noise of imu={imu} as it stands, untuned; before a comparison tune on other drives "
        "(dlkf tune), or give tuning=any_car for an unknown car"
    )


def sigma_warnings(scores: Scores) -> list[str]:
    """A line for each filter whose own 1σ is too small for its innovations, with the remedy (another for a network,
    which is given no noise) in the first that needs it."""
    lines: list[str] = []
    remedies: set[str] = set()
    for name, run in scores.filters.items():
        fit = fit_sigma(*run.innovation)  # segments count as independent
        if fit is not None and fit.too_small:
            remedy = fit.remedy(REMEDY if is_filter(name) else OF_NETWORK)
            lines.append(fit.short_warning(name) if remedy in remedies else fit.warning(name, remedy))
            remedies.add(remedy)
    return lines


def _spread(texts: Sequence[str], count: int, unit: str, share: str) -> str:
    """``share``: the median as a fraction of the distance, behind it."""
    where = " from the reference" if unit == "outage" else " off horizontally"
    if count >= FEW:
        return f"{texts[0]}{where} in the median{share}, within {texts[1]} in 95 % of them"
    if count == 1:
        return f"{texts[0]}{where}{share}"
    return f"{texts[0]}{where} in the median{share}, {texts[1]} in the largest"
