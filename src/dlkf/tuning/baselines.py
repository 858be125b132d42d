"""The classical filters of a study, each tuned itself on training pieces with outages (R018; paper.md 4.6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import count
from typing import Any

from dlkf.console import counting
from dlkf.data.drive import Batch
from dlkf.filters.build import build_causal, build_filter, has_prior
from dlkf.filters.smoother import Filter
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.tuning.search import best_prior, factors_of, outage_error, tuned, without_prior

FIRST = "mbkf15"  # where the others' search starts, and what the mean IMU error is estimated with


@dataclass(frozen=True)
class Baselines:
    """Filters by name with the factors each was given, the mean IMU error, and what each with ``_prior`` is told."""

    imu: ImuSpec
    tunings: dict[str, Tuning]
    prior: Prior
    priors: dict[str, Prior]

    def build(self) -> dict[str, Filter]:
        """The filters."""
        return {n: build_filter(n, self.imu, tuning=t, prior=self.priors.get(n)) for n, t in self.tunings.items()}

    def described(self) -> dict[str, Any]:
        """Plain values for a report."""
        return {
            "imu": self.imu.name,
            "tuning": {n: asdict(t) for n, t in self.tunings.items() if n != "ins"},
            "prior": {n: {"mean": list(p.mean), "std": list(p.std)} for n, p in self.priors.items()},
        }


def tuned_baselines(
    names: Sequence[str], imu: ImuSpec, batches: Sequence[Batch], *, rounds: int, say: Callable[[str], None]
) -> Baselines:
    """Tune each of ``names`` on the outages of training pieces; 0 ``rounds`` leave the factors as they come.

    All but ``ins`` start at those of ``mbkf15``, one with ``_prior`` at those of the same filter without, and search
    over their own (:func:`dlkf.tuning.search.factors_of`).
    """
    first, _ = _searched(imu, batches, FIRST, rounds)
    prior = best_prior(imu, first, batches)
    priors: dict[str, Prior] = {}
    tunings: dict[str, Tuning] = {}
    for name in names:
        start = Tuning() if name == "ins" else tunings.get(without_prior(name), first)
        if has_prior(name):
            priors[name] = prior if name == f"{FIRST}_prior" else best_prior(imu, start, batches, name)
        if name in ("ins", FIRST):
            tunings[name] = start
            error = outage_error(build_causal(name, imu, "tuning does not", tuning=start), batches)
        else:
            tunings[name], error = _searched(imu, batches, name, rounds, start, priors.get(name))
        how = "tuned" if rounds and name != "ins" else "untuned"
        say(f"{name} {how}: {error:.2f} m at the end of the outages of training pieces (geometric mean)")
    return Baselines(imu, tunings, prior, priors)


def _searched(
    imu: ImuSpec,
    batches: Sequence[Batch],
    name: str,
    rounds: int,
    start: Tuning | None = None,
    prior: Prior | None = None,
) -> tuple[Tuning, float]:
    """A search under a bar of its own: it takes minutes on much data."""
    most, done = rounds * sum(map(len, factors_of(name).values())), count(1)
    with counting(f"Tuning {name}") as bar:
        given = {"name": name, "rounds": rounds, "start": start, "prior": prior}
        return tuned(imu, batches, **given, progress=lambda _: bar(next(done), most))
