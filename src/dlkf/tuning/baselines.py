"""The classical filters of a study, each tuned on training segments for what is scored (R018; paper.md 4.6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from dlkf.data.drive import Batch
from dlkf.evaluation.metrics import PVA
from dlkf.filters.build import FilterName, build_causal, build_filter, has_prior
from dlkf.filters.smoother import Filter
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.tuning.search import best_prior, evaluate_objective, tune_under_bar

FIRST = "mbkf15"  # where the others' search starts, and what the mean IMU error is estimated with


@dataclass(frozen=True)
class Baselines:
    """Filters by name with the factors each was given, the mean IMU error, and the prior of each with ``_prior``."""

    imu: ImuSpec
    tunings: dict[str, Tuning]
    prior: Prior
    priors: dict[str, Prior]

    def build(self) -> dict[str, Filter]:
        """The filters."""
        return {n: build_filter(n, self.imu, tuning=t, prior=self.priors.get(n)) for n, t in self.tunings.items()}

    def describe(self) -> dict[str, Any]:
        """Plain values for a report."""
        return {
            "imu": self.imu.name,
            "tuning": {n: t.factors() for n, t in self.tunings.items() if n != "ins"},
            "prior": {n: {"mean": list(p.mean), "std": list(p.std)} for n, p in self.priors.items()},
        }


def tune_baselines(
    names: Sequence[str],
    imu: ImuSpec,
    batches: Sequence[Batch],
    *,
    rounds: int,
    say: Callable[[str], None],
    start: Tuning | None = None,
    objective: str = "log",
    longer: Sequence[Batch] | None = None,
) -> Baselines:
    """Tune each of ``names`` on training segments by an objective (:func:`dlkf.tuning.search.evaluate_objective`); 0
    ``rounds`` leave the factors at ``start``.

    The search for ``mbkf15`` begins at ``start``. All others but ``ins`` begin at the factors of ``mbkf15``, and search
    over their own (:func:`dlkf.tuning.search.list_factors`). One with ``_prior`` begins at those of the same filter
    without or at ``start``, with the prior that is best then, found on ``longer`` segments with GNSS throughout.
    """
    untuned = start or Tuning()
    first, least, _ = tune_under_bar(imu, batches, FIRST, rounds, objective=objective, start=start)
    prior, begin = best_prior(imu, [untuned, first], batches, f"{FIRST}_prior", objective, longer)
    priors: dict[str, Prior] = {}
    tunings: dict[str, Tuning] = {}
    for name in names:
        begun = Tuning() if name == "ins" else tunings.get(FilterName.parse(name).drop("prior"), first)
        if name == f"{FIRST}_prior":
            priors[name], begun = prior, begin
        elif has_prior(name):
            priors[name], begun = best_prior(imu, [untuned, begun], batches, name, objective, longer)
        if name == FIRST:
            tunings[name], error = first, least
        elif name == "ins":
            tunings[name] = begun
            estimator = build_causal(name, imu, "tuning does not", tuning=begun)
            error = evaluate_objective(estimator, batches, objective)
        else:
            tunings[name], error, _ = tune_under_bar(
                imu, batches, name, rounds, objective=objective, start=begun, prior=priors.get(name)
            )
        how = "tuned" if rounds and name != "ins" else "untuned"
        say(f"{name} {how}: {_describe_error(error, objective)}")
    return Baselines(imu, tunings, prior, priors)


def _describe_error(error: float, objective: str) -> str:
    """The objective's value in words."""
    if objective == PVA:
        return f"geometric mean of position (m), velocity (m/s), attitude (rad) on training segments {error:.4g}"
    return f"{error:.2f} m at the end of the outages of training segments (geometric mean)"
