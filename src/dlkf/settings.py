"""Settings of a simulation from plain mappings: every key known, every number a finite number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any, ClassVar, Protocol, TypeVar, get_type_hints

from dlkf.errors import InputError


class Settings(Protocol):
    """A dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


T = TypeVar("T", bound=Settings)


def built(kind: type[T], config: Any, where: str) -> T:
    """A config dataclass from a mapping; fields that are dataclasses themselves take mappings.

    InputError for an unknown key, and for a value that is not of the field's kind.
    """
    if isinstance(config, kind):
        return config
    if not isinstance(config, Mapping):
        raise InputError(f"{where}: is {config!r}, must be a mapping")
    known = {name: hint for name, hint in get_type_hints(kind).items() if name in kind.__dataclass_fields__}
    if unknown := sorted(str(key) for key in config if key not in known):
        raise InputError(f"{where}: unknown key {', '.join(unknown)}; known are {', '.join(known)}")
    return kind(**{key: _value(known[key], value, key, where) for key, value in config.items()})


def _value(kind: Any, value: Any, key: str, where: str) -> Any:
    if isinstance(kind, type) and is_dataclass(kind):
        return built(kind, value, key)
    if kind in (float, int):
        if not _is_number(value) or not math.isfinite(value):
            raise InputError(f"{where}: {key} is {value!r}, must be a number")
    elif getattr(kind, "__origin__", None) is tuple:
        if not isinstance(value, (list, tuple)) or not all(_is_number(x) for x in value):
            raise InputError(f"{where}: {key} is {value!r}, must be a list of numbers")
        return tuple(float(x) for x in value)
    elif kind is str and not isinstance(value, str):
        raise InputError(f"{where}: {key} is {value!r}, must be a word")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
