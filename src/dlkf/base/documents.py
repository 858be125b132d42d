"""YAML from untrusted files: plain values only, one line for malformed YAML, no unbounded alias expansion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dlkf.base.errors import InputError

LARGEST_BYTES, MOST_VALUES = 4_000_000, 500_000  # of a preset or a model's card, with what it repeats by aliases


def read_yaml(path: Path) -> Any:
    """The values in a file. InputError, naming it, where they cannot be read or are beyond what a setting is."""
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise InputError(f"{path} has {path.stat().st_size / 1e6:.0f} MB, which no settings have")
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        count = _count(values, {})
    except (yaml.YAMLError, ValueError, OSError) as error:
        if isinstance(error, InputError):
            raise
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is not readable YAML: {said}") from None
    except RecursionError:
        raise InputError(f"{path} is not readable YAML: it is nested too deeply, or contains itself") from None
    if count > MOST_VALUES:
        raise InputError(f"{path} stands for {count:.3g} values by its aliases, which no settings have")
    return values


def _count(value: Any, known: dict[int, int]) -> int:
    """Values in it, those behind an alias every time they stand there."""
    if not isinstance(value, (dict, list)):
        return 1
    if id(value) not in known:
        known[id(value)] = MOST_VALUES + 1  # until it is counted: what contains itself has no end
        within = value if isinstance(value, list) else [*value.keys(), *value.values()]
        known[id(value)] = 1 + sum(_count(x, known) for x in within)
    return known[id(value)]
