"""Filters by name: ``ins``, or a Kalman filter with endings for what it carries, as in ``mbkf21_nhc_gated``.

A sensor stands behind a plus, as in ``mbkf15+speed``, as do ``vibration_speed``, ``receiver``
(:data:`dlkf.filters.aids.attach.SOURCES`) and sources of measurements of one's own, as in
``mbkf21_nhc+my_sources:SpeedLimit``: a module on PYTHONPATH and a class in it (:mod:`dlkf.filters.sources`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from dlkf.base.classes import find_class
from dlkf.base.errors import InputError
from dlkf.filters.aids.attach import SOURCES, add_sources
from dlkf.filters.constraints import CarConstraints
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Ins, Mbkf
from dlkf.filters.smoother import Filter, SmoothedSolution
from dlkf.filters.sources import Source
from dlkf.filters.tuning import Prior, Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.state import ErrorStates

KALMAN: Mapping[str, str] = {"mbkf15": "none", "mbkf21": "scale", "mbkf33": "full", "aekf": "none"}
ENDINGS: Mapping[str, str] = {
    "prior": "starts from the training set's mean IMU error",
    "nhc": "non-holonomic constraints and zero-velocity updates",
    "car": "the same, with mounting angles, rear axle, sideslip and pitch gradient as states",
    "gated": "refuses outliers",
    "rts": "smoothed backwards over the whole drive (Rauch-Tung-Striebel)",
}
OWN_SOURCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
MODEL_BASED: tuple[str, ...] = ("ins", "mbkf15", "mbkf15_prior", "mbkf21", "mbkf33", "aekf")


class FilterName(NamedTuple):
    """``mbkf21_car_gated+speed``: base, endings, and what stands behind a plus."""

    base: str
    endings: tuple[str, ...]
    own: tuple[str, ...]

    @classmethod
    def parse(cls, name: str) -> FilterName:
        """Of any name."""
        kind, *own = name.split("+")
        base, *endings = kind.split("_")
        return cls(base, tuple(endings), tuple(own))

    def __str__(self) -> str:
        return "+".join(("_".join((self.base, *self.endings)), *self.own))

    def drop(self, ending: str) -> str:
        """The name without an ending."""
        return str(self._replace(endings=tuple(x for x in self.endings if x != ending)))

    def add(self, aids: Iterable[str]) -> str:
        """The name with these sensors behind a plus, of a filter with vehicle constraints; another unchanged."""
        more = (aid for aid in aids if aid not in self.own) if self.knows_car else ()
        return str(self._replace(own=(*self.own, *more)))

    @property
    def knows_car(self) -> bool:
        """Whether the filter has vehicle constraints."""
        return bool({"nhc", "car"} & set(self.endings))


def is_filter(name: str) -> bool:
    """Whether a name is that of a model-based filter."""
    base, endings, own = FilterName.parse(name)
    if base == "ins":
        return not (endings or own)
    if not all(part in SOURCES or OWN_SOURCE.fullmatch(part) for part in own):
        return False
    return base in KALMAN and len(set(endings)) == len(endings) and set(endings) <= set(ENDINGS)


def build_filter(name: str, imu: ImuSpec, *, tuning: Tuning | None = None, prior: Prior | None = None) -> Filter:
    """A model-based filter for an IMU; only names with ``_prior`` take the ``prior``.

    With the ending ``rts`` it is no estimator but a filter to be smoothed, which only looks back on whole drives.
    Raises InputError for an unknown name, a missing prior, or an own source that is missing.
    """
    if not is_filter(name):
        raise InputError(f"unknown model {name!r}; known filters: {describe_filters()}")
    if name == "ins":
        return Ins()
    base, endings, own = parsed = FilterName.parse(name)
    states = ErrorStates(KALMAN[base], structure="car" in endings)
    if has_prior(name):
        if prior is None:
            raise InputError(
                f"model {name} needs the training set's mean IMU error: give prior.mean and prior.std "
                f"({states.imu} values each, m/s² then rad/s) or let dlkf.train find them"
            )
        if len(prior.mean) != states.imu or len(prior.std) != states.imu:
            more = ", then the elements of both sensor matrices" if states.elements else ""
            raise InputError(
                f"prior.mean and prior.std of {name} must have {states.imu} values (m/s² x3, rad/s x3{more})"
            )
    factors = tuning or Tuning()
    sources: list[Source] = []
    if parsed.knows_car:
        sources.append(CarConstraints(factors, states))
    estimator = Mbkf(
        imu,
        factors,
        states,
        prior=prior if has_prior(name) else None,
        gated="gated" in endings,
        sources=tuple(sources),
        adaptive=base == "aekf",
    )
    kinds = [SOURCES.get(part) or find_class(part, "source", ("begin", "rows")) for part in own]
    estimator = add_sources(estimator, kinds)
    return SmoothedSolution(estimator) if "rts" in endings else estimator


def has_prior(name: str) -> bool:
    """Whether a filter of this name is given an IMU error before the drive."""
    return "prior" in FilterName.parse(name).endings


def check_prior_taken(names: Sequence[str]) -> None:
    """InputError where no filter of these names takes a prior that is given."""
    if not any(is_filter(name) and has_prior(name) for name in names):
        raise InputError(f"a prior has no effect on {', '.join(names)}; filters with _prior take one (mbkf15_prior)")


def build_causal(name: str, imu: ImuSpec, why: str, **given: Any) -> Estimator:
    """As :func:`build_filter`, for what needs an estimator; InputError with ``why`` for a smoothed one."""
    refuse_smoothed(name, why)
    built = build_filter(name, imu, **given)
    assert not isinstance(built, SmoothedSolution)
    return built


def refuse_smoothed(name: str, why: str) -> None:
    """InputError for the name of a filter that is to be smoothed."""
    parsed = FilterName.parse(name)
    if "rts" in parsed.endings:
        raise InputError(f"model {name} is smoothed: it looks ahead, {why}; take {parsed.drop('rts')}")


def filter_names() -> list[str]:
    """Names that are close to what somebody mistyped: every filter with no ending or one, and ``plus``."""
    return ["plus", *MODEL_BASED, *(f"{name}_{end}" for name in MODEL_BASED[1:] for end in ENDINGS)]  # ins has none


def describe_filters() -> str:
    """What to write after ``model=``, for messages."""
    endings = ", ".join("_" + ending for ending in ENDINGS)
    return f"{', '.join(MODEL_BASED)}; endings of a Kalman filter: {endings}; behind a plus: {', '.join(SOURCES)}"
