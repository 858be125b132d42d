"""Filters by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

from dlkf.errors import InputError
from dlkf.filters.integration import Estimator
from dlkf.filters.model_based import Ins, Mbkf15, Tuning
from dlkf.navigation.imu_errors import ImuSpec

MODEL_BASED: tuple[str, ...] = ("ins", "mbkf15", "mbkf15_prior")


def build_filter(
    name: str,
    imu: ImuSpec,
    *,
    tuning: Mapping[str, float] | Tuning | None = None,
    prior_mean: Sequence[float] | None = None,
    prior_std: Sequence[float] | None = None,
) -> Estimator:
    """A model-based filter for an IMU; ``prior_*`` (6 values, m/s² and rad/s) belong to ``mbkf15_prior``.

    Raises InputError for an unknown name, an unknown tuning factor, or a missing prior.
    """
    if name not in MODEL_BASED:
        raise InputError(f"unknown model {name!r}; known filters: {', '.join(MODEL_BASED)}")
    if name == "ins":
        return Ins()
    factors = tuning if isinstance(tuning, Tuning) else _tuning(tuning or {})
    if name == "mbkf15":
        return Mbkf15(imu, factors)
    if prior_mean is None or prior_std is None:
        raise InputError(
            "model mbkf15_prior needs the training set's mean IMU error: give prior.mean and prior.std "
            "(6 values each, m/s² then rad/s) or let dlkf.train find them"
        )
    if len(prior_mean) != 6 or len(prior_std) != 6:
        raise InputError("prior.mean and prior.std of mbkf15_prior must have 6 values (m/s² x3, rad/s x3)")
    return Mbkf15(imu, factors, tuple(map(float, prior_mean)), tuple(map(float, prior_std)))


def _tuning(factors: Mapping[str, float]) -> Tuning:
    known = {f.name for f in fields(Tuning)}
    for key, value in factors.items():
        if key not in known:
            raise InputError(f"unknown tuning factor {key!r}; known: {', '.join(sorted(known))}")
        if not isinstance(value, (int, float)) or not value > 0:
            raise InputError(f"tuning factor {key} is {value!r}, must be a number above 0")
    return Tuning(**factors)
