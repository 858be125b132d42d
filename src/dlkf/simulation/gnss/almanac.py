"""The GPS constellation as an almanac states it: orbital elements and clocks, read from a YUMA file.

The package carries one real almanac, ``gps_week2429.alm``; its first lines give its source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dlkf.base.errors import InputError

Array = NDArray[np.floating]
PACKAGED = Path(__file__).with_name("gps_week2429.alm")
PACKAGED_WEEK = 2429
FIELDS = {  # label of the YUMA format, without its unit, to name
    "ID": "prn",
    "Health": "health",
    "Eccentricity": "eccentricity",
    "Time of Applicability": "toa",
    "Orbital Inclination": "inclination",
    "Rate of Right Ascen": "node_rate",
    "SQRT": "sqrt_a",
    "Right Ascen at Week": "node",
    "Argument of Perigee": "perigee",
    "Mean Anom": "mean_anomaly",
    "Af0": "af0",
    "Af1": "af1",
    "week": "week",
}
ELEMENTS = ("eccentricity", "inclination", "node_rate", "sqrt_a", "node", "perigee", "mean_anomaly", "af0", "af1")
LIMITS = {"prn": (1, 63), "eccentricity": (0.0, 0.1), "sqrt_a": (4000.0, 7000.0), "inclination": (0.0, math.pi)}


@dataclass(frozen=True)
class Almanac:
    """Elements (S,) of the healthy satellites, as in IS-GPS-200 table 20-VI, angles in radians.

    ``node`` is the longitude of the ascending node at the start of the week, the other angles are those at the
    time of applicability ``toa`` [s of ``week``]; ``node_rate`` rad/s; ``sqrt_a`` √m; ``af0`` s, ``af1`` s/s.
    """

    week: int
    toa: float
    prn: NDArray[np.int64]
    eccentricity: Array
    inclination: Array
    node_rate: Array
    sqrt_a: Array
    node: Array
    perigee: Array
    mean_anomaly: Array
    af0: Array
    af1: Array


@cache
def read_almanac(path: str = "") -> Almanac:
    """The almanac in a YUMA file, or the packaged one where none is named. Unhealthy satellites are left out.

    A ten-bit week is taken to be the one nearest to that of the packaged almanac. InputError, with file and
    satellite, for a record with a missing, unreadable or impossible element, and for fewer than four satellites.
    """
    file = Path(path) if path else PACKAGED
    try:
        text = file.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise InputError(f"almanac {file}: cannot be read ({error.strerror}); give a YUMA file") from None
    records = [_record(block, file) for block in text.split("********") if "ID:" in block]
    healthy = [record for record in records if record["health"] == 0]
    if len(healthy) < 4:
        raise InputError(f"almanac {file}: {len(healthy)} healthy satellites, needs at least 4; give a YUMA file")
    if len({(record["week"], record["toa"]) for record in healthy}) > 1:
        raise InputError(f"almanac {file}: the satellites' times of applicability differ; give one almanac")
    prn = [int(record["prn"]) for record in healthy]
    if len(set(prn)) < len(prn):
        raise InputError(f"almanac {file}: a satellite appears twice; give one almanac")
    cycles = round((PACKAGED_WEEK - healthy[0]["week"]) / 1024) if healthy[0]["week"] < 1024 else 0
    return Almanac(
        int(healthy[0]["week"]) + 1024 * cycles,
        healthy[0]["toa"],
        np.array(prn),
        *(np.array([record[name] for record in healthy]) for name in ELEMENTS),
    )


def _record(block: str, file: Path) -> dict[str, float]:
    """One satellite's elements by name."""
    values: dict[str, float] = {}
    for line in block.splitlines():
        label, colon, value = line.partition(":")
        if colon and (name := FIELDS.get(label.split("(")[0].strip())):
            try:
                values[name] = float(value)
            except ValueError:
                raise InputError(f"almanac {file}: {label.strip()} is {value.strip()!r}, no number") from None
    where = f"almanac {file}, satellite {values['prn']:g}" if "prn" in values else f"almanac {file}"
    if missing := sorted(set(FIELDS.values()) - set(values)):
        raise InputError(f"{where}: {', '.join(missing)} missing; give a whole YUMA record")
    for name, value in values.items():
        low, high = LIMITS.get(name, (-math.inf, math.inf))
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"{where}: {name} is {value:g}, no satellite of a GPS almanac has that")
    return values
