"""IMU error model: what a sensor adds to the truth, and what a filter assumes about it.

Model (paper.md 2.7, paper eqs 7, 8): measured = (I + M) true + b + w, with M's diagonal the scale factors
and its off-diagonal the misalignments, b a turn-on bias plus an in-run part that is first-order
Gauss-Markov with time constant τ (a random walk of the same strength while t ≪ τ), w white noise.
Optional, none by default: a rate random walk, a warm-up drift and a second, faster Gauss-Markov part in b, a
gyroscope's g-dependent error G f, white noise that differs from axis to axis, quantisation and a full-scale range of
the output (Groves 4.4).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from dlkf.base.errors import InputError
from dlkf.base.ranges import range_middle
from dlkf.base.settings import Ranged, bounded_field, is_number, settings_from

DEG = math.pi / 180
MILLIGAL = 1e-5  # m/s²
NEEDED = ("noise_density", "turn_on_bias", "instability", "correlation_time", "scale_factor", "misalignment")


@dataclass(frozen=True)
class SensorErrors(Ranged, where="IMU preset", least=0):
    """One sigma of every error of a triad (accelerometers in m/s², gyroscopes in rad/s).

    ``noise_density`` √S of the white noise [unit/√Hz]; ``turn_on_bias`` [unit]; ``instability`` σ of the
    in-run bias [unit] with ``correlation_time`` τ [s]; ``scale_factor`` and ``misalignment`` [–].

    Optional: ``random_walk`` K of the bias [unit/√s]; ``warm_up`` σ of the drift c (1 − exp(−t/``warm_up_time``))
    as the unit warms up after switching on [unit, s]; ``g_sensitivity`` of a gyroscope, σ of the entries of
    G [rad/s per m/s²]; ``quantisation`` step of the output [unit], and its ``full_scale`` [unit], 0 for none;
    ``wander`` σ of a part of the bias that decays within ``wander_time`` [unit, s], as of a MEMS under
    supply and its mount; ``unevenness`` log-std of the factors by which the axes' white noise differs [–].
    """

    noise_density: float = 0.0
    turn_on_bias: float = 0.0
    instability: float = 0.0
    correlation_time: float = bounded_field(3600.0, 1e-9, math.inf)
    scale_factor: float = 0.0
    misalignment: float = 0.0
    random_walk: float = 0.0
    warm_up: float = 0.0
    warm_up_time: float = 600.0
    g_sensitivity: float = 0.0
    quantisation: float = 0.0
    full_scale: float = 0.0
    wander: float = 0.0
    wander_time: float = 5.0
    unevenness: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("warm_up", "wander"):
            if getattr(self, name) > 0 and getattr(self, f"{name}_time") <= 0:
                raise InputError(f"IMU preset: {name}_time is 0, must be positive seconds")
        if 0 < self.full_scale < 2 * self.quantisation:
            raise InputError(
                f"IMU preset: full_scale {self.full_scale} is below two steps of quantisation {self.quantisation}"
            )

    @property
    def noise_psd(self) -> float:
        """S of the white noise [unit²/Hz]."""
        return self.noise_density**2

    @property
    def walk_psd(self) -> float:
        """Driving noise of the in-run bias, 2σ²/τ + K² [unit²/s]."""
        return 2 * self.instability**2 / self.correlation_time + self.random_walk**2


@dataclass(frozen=True)
class ImuSpec:
    """An IMU as a preset of ``conf/imu/`` describes it; ``source`` is where the numbers come from."""

    name: str
    accel: SensorErrors
    gyro: SensorErrors
    source: str = ""

    def as_preset(self) -> dict[str, Any]:
        """The plain values that :func:`imu_spec` makes it of; optional errors that it does not have are left out."""
        usual = asdict(SensorErrors())
        sensors = {key: asdict(getattr(self, key)) for key in ("accel", "gyro")}
        kept = {s: {k: x for k, x in v.items() if k in NEEDED or x != usual[k]} for s, v in sensors.items()}
        return {"name": self.name, "source": self.source, **kept}


AUTO = "auto"  # the preset of imu=auto


def imu_spec(config: Mapping, *, auto: bool = False) -> ImuSpec:
    """The preset that a mapping with the keys of a ``conf/imu/*.yaml`` file describes.

    Every number of both sensors but the optional ones has to be there, and no unknown one, so that a misspelt
    key cannot become a silent zero.
    Of a preset with ranges (``conf/imu/wide.yaml``) it is the middle: what a filter assumes of an IMU drawn from it.
    Raises InputError for a missing or unknown key, a value that is no number ≥ 0, or the preset ``auto`` unless the
    caller finds the noise by itself.
    """
    config = range_middle(config)
    if not isinstance(config, Mapping):
        raise InputError(f"IMU preset is {config!r}, must be a mapping with name, accel, gyro")
    where = f"IMU preset {config.get('name', 'unnamed')}"
    texts = {key: str(config[key]) for key in ("name", "source") if key in config}
    sensors = {key: _sensor(config[key], f"{where}, {key}") for key in ("accel", "gyro") if key in config}
    spec = settings_from(ImuSpec, {**config, **texts, **sensors}, where)
    if spec.name == AUTO and not auto:
        raise InputError(
            "imu=auto: only navigate finds the noise by itself; give a preset here, or have one written by "
            "python -m dlkf.tune objective=likelihood"
        )
    if spec.accel.g_sensitivity:
        raise InputError(f"{where}, accel: g_sensitivity is an error of gyroscopes alone, leave it out")
    return spec


def _sensor(values: Any, where: str) -> SensorErrors:
    if isinstance(values, Mapping):
        if missing := [key for key in NEEDED if key not in values]:
            raise InputError(f"{where}: {', '.join(missing)} missing")
        values = {key: float(x) if is_number(x) else x for key, x in values.items()}
    try:
        return settings_from(SensorErrors, values, where)
    except InputError as error:
        raise InputError(str(error).replace("IMU preset:", f"{where}:", 1)) from None
