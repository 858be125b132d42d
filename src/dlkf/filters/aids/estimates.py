"""What filters estimate of sensors and receiver, for readers: words, unit and as many digits as 1σ allows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from dlkf.filters.g_sensitivity import NAMES
from dlkf.filters.receiver import ARM, DELAY, DRIFT, VELOCITY_DELAY

DEGREES, G = 180 / math.pi, 9.80665
DIGITS = 2  # of 1σ


class Readable(NamedTuple):
    """An estimate in words, its unit, and what its column is multiplied by."""

    words: str
    unit: str
    factor: float = 1.0


ESTIMATES: Mapping[str, Readable] = {
    "wheel_scale": Readable("Wheel scale error", "%", 100.0),
    "wheel_delay_s": Readable("Wheel delay", "ms", 1000.0),
    "wheel_right_m": Readable("Wheel right of IMU", "m"),
    "wheel_offset": Readable("Wheel offset", "m/s"),
    "heading_offset": Readable("Heading offset", "°", DEGREES),
    "baro_offset_m": Readable("Barometer offset", "m"),
    "baro_wind": Readable("Barometer share of dynamic pressure", "%", 100.0),
    DELAY: Readable("Delay of fixes", "ms", 1000.0),
    VELOCITY_DELAY: Readable("Velocity later than position", "ms", 1000.0),
    **{name: Readable(f"Antenna further {name.split('_')[1]}", "m") for name in ARM},
    DRIFT: Readable("Receiver's clock fast by", "ppm"),
    **{name: Readable("g-sensitivity " + " ".join(name.split("_")[-2:]), "°/s/g", DEGREES * G) for name in NAMES},
}


def label_estimate(name: str) -> str:
    """``Wheel delay\\n[ms]``; an estimate of a source of one's own keeps its name."""
    known = ESTIMATES.get(name)
    return f"{known.words}\n[{known.unit}]" if known else name


def describe_estimate(name: str, value: float, std: float) -> str:
    """``wheel delay −20 ± 5 ms``."""
    known = ESTIMATES.get(name, Readable(name, ""))
    return f"{known.words[0].lower()}{known.words[1:]} {format_estimate(name, value, std)} {known.unit}".rstrip()


def format_estimate(name: str, value: float, std: float) -> str:
    """``3.04 ± 0.35`` in the unit of :func:`label_estimate`; – if unknown."""
    factor = ESTIMATES[name].factor if name in ESTIMATES else 1.0
    value, std = value * factor, std * factor
    if not (math.isfinite(value) and math.isfinite(std)):
        return "–"
    decimals = max(0, DIGITS - 1 - math.floor(math.log10(float(f"{std:.{DIGITS - 1}e}")))) if std > 0 else 3
    return f"{value:.{decimals}f} ± {std:.{decimals}f}".replace("-", "−")
