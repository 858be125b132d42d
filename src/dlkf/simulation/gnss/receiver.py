"""A GNSS receiver: its errors, and fixes and raw observations made from the satellites in view.

Range of a satellite = geometry + receiver clock − satellite clock + errors; every error is a zero-mean normal
process of stated size, so the covariance of a fix is known and is what the fix claims (columns ``std_*``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dlkf.base.errors import InputError
from dlkf.base.settings import Ranged, bounded_field, settings_from
from dlkf.simulation.imu import gauss_markov

Array = NDArray[np.floating]
LOWEST = math.radians(3.0)  # mappings and noise grow without bound towards the horizon
EARTH_RADIUS, IONOSPHERE = 6378.1363e3, 350e3  # m, radius and height of the thin shell (RTCA DO-229 A.4.4.10.4)
QUALITIES = (1, 2, 4, 5)
WHITE = "white"  # the receiver of a dataset without satellites


@dataclass(frozen=True)
class Receiver(Ranged, where="receiver", least=0, greatest=1e6):
    """1σ of the errors of one receiver, as a preset of ``conf/receiver/`` gives them; 0 switches an error off.

    White: ``std_range`` [m] and ``std_range_rate`` [m/s] at the zenith, growing downwards (:func:`multipath_growth`).
    First-order Gauss-Markov with a time constant [s]: ``multipath`` (per satellite, grows likewise),
    ``orbit`` (per satellite: what broadcast orbit and clock leave), ``iono`` and ``tropo`` (what the models leave
    of the vertical delay, shared by all satellites). ``ambiguity`` [m] per satellite while carrier ambiguities are
    open: until five satellites have been tracked for ``refix_s``; quality is 5 (RTK float) then.

    ``mask_deg``: lowest elevation used; ``reacquire_s``: time from view to use; no fix above ``max_pdop``.
    ``clock_phase``, ``clock_frequency``: PSDs of the receiver clock [m²/s, m²/s³]; ``quality``: NMEA GGA code.
    """

    name: str
    quality: int = 1
    mask_deg: float = bounded_field(10.0, 0, 59.99)
    std_range: float = bounded_field(0.3, 1e-6, 1e6)
    std_range_rate: float = bounded_field(0.05, 1e-6, 1e6)
    multipath: float = 0.0
    multipath_s: float = bounded_field(20.0, 1e-6, 1e6)
    orbit: float = 0.0
    orbit_s: float = bounded_field(7200.0, 1e-6, 1e6)
    iono: float = 0.0
    tropo: float = 0.0
    atmosphere_s: float = bounded_field(1800.0, 1e-6, 1e6)
    ambiguity: float = 0.0
    ambiguity_s: float = bounded_field(30.0, 1e-6, 1e6)
    refix_s: float = 10.0
    reacquire_s: float = 0.0
    max_pdop: float = bounded_field(20.0, 1e-6, 1e6)
    clock_phase: float = 0.01
    clock_frequency: float = 0.04
    almanac: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.quality not in QUALITIES:
            raise InputError(f"receiver {self.name}: quality {self.quality} is none of {QUALITIES} (NMEA GGA codes)")


def receiver_spec(config: Mapping | None) -> Receiver | None:
    """The receiver of a mapping like ``conf/receiver/*.yaml``; None for ``white``, which has no satellites.

    InputError for an unknown key or an impossible value.
    """
    if config is None or (isinstance(config, Mapping) and dict(config) == {"name": WHITE}):
        return None
    if not isinstance(config, Mapping) or config.get("name") in (None, WHITE):
        raise InputError(f"receiver: is {config!r}; give one of conf/receiver/*.yaml, white has nothing to set")
    return settings_from(Receiver, config, "receiver")


@dataclass(frozen=True)
class RangeErrors:
    """Errors of T epochs × S satellites and a receiver's own estimate of their size.

    ``range`` [m], ``rate`` [m/s]; ``variance`` and ``rate_variance`` of what is independent between satellites;
    ``common`` (K, T, S) 1σ [m] of what all satellites of an epoch share.
    """

    range: Array
    rate: Array
    variance: Array
    rate_variance: Array
    common: Array


def range_errors(
    rng: np.random.Generator, receiver: Receiver, elevation: Array, is_float: NDArray[np.bool_], dt: float
) -> RangeErrors:
    """Errors at elevations (T, S) [rad], ``dt`` [s] apart; ``is_float`` (T,): carrier ambiguities are open."""
    shape = elevation.shape
    lowered = multipath_growth(elevation)
    white, rate = rng.standard_normal((2, *shape))
    multipath = gauss_markov(rng, shape, dt / receiver.multipath_s)
    orbit = gauss_markov(rng, shape, dt / receiver.orbit_s)
    ambiguity = gauss_markov(rng, shape, dt / receiver.ambiguity_s) * is_float[:, None]
    vertical = gauss_markov(rng, (shape[0], 2), dt / receiver.atmosphere_s)
    common = np.stack((receiver.iono * iono_mapping(elevation), receiver.tropo * tropo_mapping(elevation)))
    independent = (
        lowered * (receiver.std_range * white + receiver.multipath * multipath)
        + receiver.orbit * orbit
        + receiver.ambiguity * ambiguity
    )
    return RangeErrors(
        independent + np.einsum("kts,tk->ts", common, vertical),
        receiver.std_range_rate * lowered * rate,
        lowered**2 * (receiver.std_range**2 + receiver.multipath**2)
        + receiver.orbit**2
        + receiver.ambiguity**2 * is_float[:, None],
        (receiver.std_range_rate * lowered) ** 2,
        common,
    )


def multipath_growth(elevation: Array) -> Array:
    """1σ of noise against its zenith value, √((1 + 1/sin² E)/2) (the a² + b²/sin² E of RTKLIB, a = b)."""
    return np.sqrt(0.5 + 0.5 / np.sin(np.maximum(elevation, LOWEST)) ** 2)


def tropo_mapping(elevation: Array) -> Array:
    """Slant over zenith delay of the troposphere, 1.001/√(0.002001 + sin² E) (RTCA DO-229 A.4.2.4)."""
    return 1.001 / np.sqrt(0.002001 + np.sin(np.maximum(elevation, LOWEST)) ** 2)


def iono_mapping(elevation: Array) -> Array:
    """Slant over vertical delay of a thin shell, (1 − (R cos E/(R + h))²)^−½ (RTCA DO-229 A.4.4.10.4)."""
    return 1 / np.sqrt(1 - (EARTH_RADIUS * np.cos(elevation) / (EARTH_RADIUS + IONOSPHERE)) ** 2)


def clock(rng: np.random.Generator, receiver: Receiver, rows: int, dt: float) -> tuple[Array, Array]:
    """Offset [m] and drift [m/s] (T,) of the receiver's clock: a random walk of phase and frequency (Groves 9.4.2).

    Starts within 1 ms and 0.5 ppm (1σ).
    """
    frequency, phase = rng.standard_normal((2, rows))
    first = rng.standard_normal(2) * (2.998e5, 149.9)
    jumps = math.sqrt(receiver.clock_frequency * dt) * frequency[1:]
    drift = first[1] + np.concatenate(((0.0,), np.cumsum(jumps)))
    own = math.sqrt(receiver.clock_frequency * dt**3 / 12 + receiver.clock_phase * dt) * phase[1:]
    return first[0] + np.concatenate(((0.0,), np.cumsum((drift[:-1] + 0.5 * jumps) * dt + own))), drift
