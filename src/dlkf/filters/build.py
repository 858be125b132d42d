"""Filters by name: ``ins``, or a Kalman filter with endings for what it carries, as in ``mbkf21_nhc_gated``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

from dlkf.errors import InputError
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Ins, Mbkf
from dlkf.filters.smoother import Smoothed
from dlkf.filters.tuning import Tuning
from dlkf.navigation.imu_errors import ImuSpec
from dlkf.navigation.state import ErrorStates

KALMAN: Mapping[str, str] = {"mbkf15": "none", "mbkf21": "scale", "mbkf33": "full", "aekf": "none"}
ENDINGS: Mapping[str, str] = {
    "prior": "starts from the training set's mean IMU error",
    "nhc": "non-holonomic constraints and zero-velocity updates",
    "car": "the same, with mounting angles, rear axle and sideslip as states",
    "gated": "refuses outliers",
    "gm": "biases as first-order Gauss-Markov processes",
    "rts": "smoothed backwards over the whole drive (Rauch-Tung-Striebel)",
}
MODEL_BASED: tuple[str, ...] = ("ins", "mbkf15", "mbkf15_prior", "mbkf21", "mbkf33", "aekf")


def is_filter(name: str) -> bool:
    """Whether a name is that of a model-based filter."""
    base, *endings = name.split("_")
    if name == "ins":
        return True
    return base in KALMAN and len(set(endings)) == len(endings) and set(endings) <= set(ENDINGS)


def build_filter(
    name: str,
    imu: ImuSpec,
    *,
    tuning: Mapping[str, float] | Tuning | None = None,
    prior_mean: Sequence[float] | None = None,
    prior_std: Sequence[float] | None = None,
) -> Estimator:
    """A model-based filter for an IMU; ``prior_*`` (6 values, m/s² and rad/s) belong to names with ``_prior``.

    Raises InputError for an unknown name, an unknown tuning factor, or a missing prior.
    """
    if not is_filter(name):
        raise InputError(f"unknown model {name!r}; known filters: {known_filters()}")
    if name == "ins":
        return Ins()
    base, *endings = name.split("_")
    given = {}
    if "prior" in endings:
        if prior_mean is None or prior_std is None:
            raise InputError(
                f"model {name} needs the training set's mean IMU error: give prior.mean and prior.std "
                "(6 values each, m/s² then rad/s) or let dlkf.train find them"
            )
        if len(prior_mean) != 6 or len(prior_std) != 6:
            raise InputError(f"prior.mean and prior.std of {name} must have 6 values (m/s² x3, rad/s x3)")
        given = {"prior_mean": tuple(map(float, prior_mean)), "prior_std": tuple(map(float, prior_std))}
    estimator = Mbkf(
        imu,
        tuning if isinstance(tuning, Tuning) else _tuning(tuning or {}),
        ErrorStates(KALMAN[base], structure="car" in endings),
        gauss_markov="gm" in endings,
        constrained=bool({"nhc", "car"} & set(endings)),
        gated="gated" in endings,
        adaptive=base == "aekf",
        **given,
    )
    return Smoothed(estimator) if "rts" in endings else estimator


def known_filters() -> str:
    """What to write after ``model=``, for messages."""
    return f"{', '.join(MODEL_BASED)}; endings of a Kalman filter: {', '.join('_' + e for e in ENDINGS)}"


def _tuning(factors: Mapping[str, float]) -> Tuning:
    known = {f.name for f in fields(Tuning)}
    for key, value in factors.items():
        if key not in known:
            raise InputError(f"unknown tuning factor {key!r}; known: {', '.join(sorted(known))}")
        if not isinstance(value, (int, float)) or not value > 0:
            raise InputError(f"tuning factor {key} is {value!r}, must be a number above 0")
    for key in ("gate", "forgetting"):
        if not factors.get(key, 0.5) < 1:
            raise InputError(f"tuning factor {key} is {factors[key]!r}, must be below 1")
    return Tuning(**factors)
