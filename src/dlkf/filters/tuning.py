"""Settings of model-based filters: factors fitted on training drives, and a prior IMU error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

from dlkf.base.errors import InputError


@dataclass(frozen=True)
class FittedOn:
    """The recordings that factors were fitted on, of a dataset by its folder's name and the digest of its data."""

    dataset: str
    digest: str
    recordings: Sequence[str]


@dataclass(frozen=True)
class Tuning:
    """Over-bounding factors on standard deviations, ≥ 1 as a rule, fitted on training drives only (R016, R018).

    ``accel_noise``, ``gyro_noise`` scale √S of the white noise; ``accel_walk``, ``gyro_walk`` that of the bias
    random walk; ``position_std``, ``velocity_std`` the GNSS stds. ``walk_floor_accel`` [m/s²/√s] and
    ``walk_floor_gyro`` [rad/s/√s] keep the bias states awake when the preset has no in-run instability, and
    ``position_floor`` [m], ``velocity_floor`` [m/s] keep R positive.

    Filters with constraints: ``lateral_std``, ``vertical_std`` [m/s] of the velocity across the car, once a
    second, ``rest_velocity_std`` [m/s], ``rest_rate_std`` [rad/s] of a standstill; ``rest_accel`` [m/s²] and
    ``rest_gyro`` [rad/s] are the spread of means over 0.1 s in the least shaken second of motion, until learned.
    Filters with further sensors: ``wheel_std`` [m/s] and ``baro_std`` [m] of an update interval's measurement where the
    file gives none, ``heading_std`` a factor on that of the heading.
    Filters with a gate: ``gate`` is the probability that a good fix passes. ``aekf``: ``forgetting`` is the share
    of the past in the adapted Q and R (0.3 in Akhlaghi et al. 2017, which lost wherever it was tried).
    ``fitted_on`` has no effect on a filter: with the same factors it is the same tuning.
    """

    accel_noise: float = 1.0
    gyro_noise: float = 1.0
    accel_walk: float = 1.0
    gyro_walk: float = 1.0
    position_std: float = 1.0
    velocity_std: float = 1.0
    walk_floor_accel: float = 1e-5
    walk_floor_gyro: float = 1e-7
    position_floor: float = 0.01
    velocity_floor: float = 0.01
    lateral_std: float = 0.2
    vertical_std: float = 0.2
    rest_velocity_std: float = 0.05
    rest_rate_std: float = 3e-4
    rest_accel: float = 0.12
    rest_gyro: float = 0.025
    wheel_std: float = 0.1
    heading_std: float = 1.0
    baro_std: float = 0.5
    gate: float = 0.9999
    forgetting: float = 0.995
    fitted_on: FittedOn | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        for name, value in self.factors().items():
            if not value > 0:
                raise InputError(f"tuning: {name} is {value!r}, must be above 0")
        for name in ("gate", "forgetting"):
            if not getattr(self, name) < 1:
                raise InputError(f"tuning: {name} is {getattr(self, name)!r}, must be below 1")

    def factors(self) -> dict[str, float]:
        """Name → value of what a filter takes."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "fitted_on"}


@dataclass(frozen=True)
class Prior:
    """What is known of an IMU error before a drive: mean and 1σ [m/s² x 3, rad/s x 3].

    Of a filter with more states also the elements of both sensor matrices, in the order of the states.
    """

    mean: Sequence[float]
    std: Sequence[float]

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) for x in self.mean):
            raise InputError(f"prior.mean is {list(self.mean)}, must be finite")
        if not all(0 < x < math.inf for x in self.std):
            raise InputError(f"prior.std is {list(self.std)}, must be above 0 and finite")

    def scale_spread(self, biases: float, matrices: float = 1.0) -> Prior:
        """The same mean with the 1σ of biases and of sensor matrices times a factor each."""
        std = (biases * s if i < 6 else matrices * s for i, s in enumerate(self.std))
        return Prior(self.mean, tuple(std))
