"""Findings shared by several drives of one car and IMU, for those with too little motion of their own."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlkf.base.settings import is_number

# settings that belong to the car, the IMU and the pair of clocks, and how far apart those of two drives may be
ALIKE = {
    "imu.accel.unit": 0.02,  # relative, of a number by gravity
    "imu.gyro.unit": 0.02,
    "imu.accel.axes": 4.0,  # degrees, twice of what is sure enough
    "imu.gyro.axes": 4.0,
    "gnss.velocity.unit": 0.0,
    "gnss.time.drift_ppm": 60.0,  # two crystals that warm up
}
FARTHEST_OFFSET_S = 0.05  # of a drive's own guess from the others', or three of its 1σ
OFFSETS = {"gnss.time.offset_s": 0.05, "imu.time.offset_s": 0.05}  # a delay, not two free clocks


def layout(mapping: Mapping[str, Any]) -> str:
    """What the logs of one car and IMU have in common: formats and columns."""
    imu = mapping["imu"]
    parts = [imu.get("format"), *(imu[key].get("columns") for key in ("accel", "gyro"))]
    return json.dumps(parts, default=str)


def pool_settings(mappings: Sequence[Mapping[str, Any]], *, offsets: bool) -> tuple[dict[str, Any], list[str]]:
    """Settings in which drives agree, as a mapping with these alone, and a line for each in which they do not.

    ``offsets`` between the clocks are among them where they are the same.
    """
    out: dict[str, Any] = {}
    apart: list[str] = []
    for name, limit in (ALIKE | (OFFSETS if offsets else {})).items():
        values = [v for v in (read_value(m, name) for m in mappings) if v not in (None, "auto")]
        if not values:
            continue
        value = _average_alike(values, limit)
        if value is not None:
            set_value(out, name, value)
        elif name not in OFFSETS:
            listed = ", ".join(dict.fromkeys(map(write_value, values)))
            apart.append(
                f"reader.{name} is not the same in all drives: {listed}; each keeps its own, set it if they are one"
            )
    return out, apart


def agrees(settings: Mapping[str, Any], offset_s: float, std: float) -> bool:
    """Whether a drive's own guess of the clocks' offset is that of the others, so that it is one and the same pair of
    clocks and not one that each recording sets again."""
    shared = next((v for name in OFFSETS if (v := read_value(settings, name)) is not None), None)
    return shared is not None and abs(offset_s - float(shared)) <= max(FARTHEST_OFFSET_S, 3 * std)


def list_settings(settings: Mapping[str, Any], before: str = "reader") -> str:
    """Settings as they are written on a command line."""
    said = []
    for key, value in settings.items():
        deeper = isinstance(value, Mapping) and "yaw" not in value
        said.append(list_settings(value, f"{before}.{key}") if deeper else f"{before}.{key}={write_value(value)}")
    return " ".join(said)


def write_value(value: Any) -> str:
    """A value as it is written on a command line."""
    if not isinstance(value, Mapping):
        return str(value)
    return "{" + ", ".join(f"{k}: {v}" for k, v in value.items()) + "}"


def _average_alike(values: Sequence[Any], limit: float) -> Any:
    """The mean of values within the limit; None where they are not."""
    first = values[0]
    if all(isinstance(v, Mapping) for v in values):
        turns = Rotation.from_euler("ZYX", [[v["yaw"], v["pitch"], v["roll"]] for v in values], degrees=True)
        mean = turns.mean()
        if np.degrees((mean.inv() * turns).magnitude()).max() > limit:
            return None
        yaw, pitch, roll = mean.as_euler("ZYX", degrees=True)
        return {"roll": round(float(roll), 2), "pitch": round(float(pitch), 2), "yaw": round(float(yaw), 2)}
    if all(map(is_number, values)):
        middle, spread = float(np.median(values)), float(np.ptp(values))
        if limit >= 0.03:
            return round(middle, 4) if spread <= limit else None
        return float(f"{middle:.6g}") if spread <= limit * abs(middle) else None
    return first if all(v == first for v in values) else None


def read_value(mapping: Any, name: str) -> Any:
    """The value of a setting such as ``imu.accel.unit``, None where there is none."""
    for key in name.split("."):
        mapping = mapping.get(key) if isinstance(mapping, Mapping) else None
    return mapping


def set_value(out: dict[str, Any], name: str, value: Any) -> None:
    """Set a setting in place."""
    *above, last = name.split(".")
    for key in above:
        out = out.setdefault(key, {})
    out[last] = value
