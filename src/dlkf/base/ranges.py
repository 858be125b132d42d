"""Settings that are drawn for every drive: a mapping in which ranges take the place of numbers.

A range is a mapping with one of these keys, and perhaps ``absent``, the probability that the value is 0 instead:

    {uniform: [a, b]}   {log_uniform: [a, b]}   {normal: [mean, std]}   {choice: [x, y, …]}

What is chosen may hold ranges itself. A mapping with ``one_of`` has variants by name, each with a ``share`` of the
draws (1 if it has none); the drawn one is merged into the mapping, and what stands beside ``one_of`` wins,
so that a key of the command line does.

Every value has a generator of its own, from the seed and the path of its key: to fix one leaves all others as drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any
from zlib import crc32

import numpy as np

from dlkf.base.errors import InputError
from dlkf.base.settings import is_number

KINDS = ("uniform", "log_uniform", "normal", "choice")
Pick = Callable[[str, np.ndarray], int]  # path and shares to the index of a variant
Value = Callable[[str, Mapping[str, Any]], Any]  # path and range to a value


def draw_ranges(config: Any, seed: np.random.SeedSequence) -> Any:
    """The mapping with every range replaced by a draw. InputError for a range that is none."""

    def generator(path: str) -> np.random.Generator:
        key = (*seed.spawn_key, crc32(path.encode()))
        return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))

    def value(path: str, config: Mapping[str, Any]) -> Any:
        rng, kind = generator(path), _find_kind(path, config)
        is_absent = rng.random() < config.get("absent", 0.0)
        span = config[kind]
        if kind == "choice":
            drawn = span[int(rng.integers(len(span)))]
        elif kind == "normal":
            drawn = float(span[0] + span[1] * rng.standard_normal())
        elif kind == "uniform":
            drawn = float(rng.uniform(*span))
        else:
            drawn = math.exp(rng.uniform(math.log(span[0]), math.log(span[1])))
        return 0.0 if is_absent else drawn

    def pick(path: str, shares: np.ndarray) -> int:
        return int(generator(f"{path}.one_of").choice(len(shares), p=shares))

    return _resolve(config, "", pick, value)


def range_middle(config: Any) -> Any:
    """The mapping with the middle of every range: mean, geometric mean, first choice, the most probable variant."""

    def value(path: str, config: Mapping[str, Any]) -> Any:
        kind = _find_kind(path, config)
        span = config[kind]
        if config.get("absent", 0.0) > 0.5:
            return 0.0
        if kind in ("choice", "normal"):
            return span[0]
        return math.sqrt(span[0] * span[1]) if kind == "log_uniform" else 0.5 * (span[0] + span[1])

    return _resolve(config, "", lambda path, shares: int(np.argmax(shares)), value)


def has_ranges(config: Any) -> bool:
    """Whether anything in a mapping is drawn."""
    if isinstance(config, Mapping):
        return "one_of" in config or _is_range(config) or any(map(has_ranges, config.values()))
    return isinstance(config, (list, tuple)) and any(map(has_ranges, config))


def _resolve(config: Any, path: str, pick: Pick, value: Value) -> Any:
    if isinstance(config, Mapping):
        if _is_range(config):
            drawn = value(path, config)
            return _resolve(drawn, f"{path}.chosen", pick, value) if "choice" in config else drawn
        if "one_of" in config:
            above = {k: v for k, v in config.items() if k != "one_of"}
            config = _merge(_choose_variant(config["one_of"], path, pick), above)
            return _resolve(config, path, pick, value)
        return {key: _resolve(x, f"{path}.{key}" if path else str(key), pick, value) for key, x in config.items()}
    if isinstance(config, (list, tuple)):
        return [_resolve(x, f"{path}.{k}", pick, value) for k, x in enumerate(config)]
    return config


def _choose_variant(variants: Any, path: str, pick: Pick) -> Mapping[str, Any]:
    where = f"{path}.one_of" if path else "one_of"
    if not isinstance(variants, Mapping) or not all(isinstance(x, Mapping) for x in variants.values()):
        raise InputError(f"{where}: is {variants!r}, must be a mapping of variants, each a mapping")
    shares = [variant.get("share", 1.0) for variant in variants.values()]
    if not all(isinstance(x, (int, float)) and x >= 0 for x in shares) or not sum(shares) > 0:
        raise InputError(f"{where}: shares {shares} must be numbers ≥ 0, not all 0")
    chosen = list(variants.values())[pick(path, np.array(shares, dtype=float) / sum(shares))]
    return {key: x for key, x in chosen.items() if key != "share"}


def _merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Both mappings in one; where both have a key, mappings are merged likewise and else the one ``above`` stands."""
    merged = dict(below)
    for key, x in above.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(x, Mapping) and not _is_range(x) and not _is_range(old)
        merged[key] = _merge(old, x) if both else x  # type: ignore[arg-type]
    return merged


def _is_range(config: Mapping[str, Any]) -> bool:
    return any(kind in config for kind in KINDS)


def _find_kind(path: str, config: Mapping[str, Any]) -> str:
    """The type of a range; InputError for two types in one, or limits that are none."""
    kinds = [key for key in config if key in KINDS]
    where = f"{path}: range {dict(config)}"
    if len(kinds) != 1 or set(config) - {kinds[0], "absent"}:
        raise InputError(f"{where} must have one of {', '.join(KINDS)}, and perhaps absent")
    absent, span = config.get("absent", 0.0), config[kinds[0]]
    if not is_number(absent) or not 0 <= absent <= 1:
        raise InputError(f"{where}: absent must be a probability")
    if not isinstance(span, (list, tuple)) or not span:
        raise InputError(f"{where}: {kinds[0]} must be a list")
    if kinds[0] == "choice":
        return "choice"
    if len(span) != 2 or not all(map(is_number, span)):
        raise InputError(f"{where}: {kinds[0]} must be two numbers")
    if kinds[0] == "normal":
        if span[1] < 0:
            raise InputError(f"{where}: the std must not be negative")
    elif span[0] > span[1] or (kinds[0] == "log_uniform" and span[0] <= 0):
        raise InputError(f"{where}: must rise" + (" from above 0" if kinds[0] == "log_uniform" else ""))
    return kinds[0]
