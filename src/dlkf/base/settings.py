"""Settings from plain values: unknown keys and values of a wrong type are errors, in the same words everywhere.

Settings are frozen dataclasses; the ranges of their values stand beside the defaults, their units in the names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, field, fields, is_dataclass
from numbers import Real
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

from dlkf.base.errors import InputError, did_you_mean


class Settings(Protocol):
    """A dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


T = TypeVar("T", bound=Settings)
RANGE = "range"  # of a field's metadata


def settings_from(kind: type[T], config: Any, where: str) -> T:
    """A settings dataclass from a mapping of its fields; fields that are dataclasses themselves take mappings.

    InputError for an unknown or missing key, and for a value that is not of the field's type: a number (finite), a
    whole one, true or false, a name or path, a list of numbers or words, one of the literals; ``None`` where the field
    may have none. ``where`` is what a user calls the mapping, empty for the whole of a command's. An instance is handed
    on as it is.
    """
    if isinstance(config, kind):
        return config
    if not isinstance(config, Mapping):
        raise InputError(f"{where}: is {config!r}, must be a mapping")
    known = {name: hint for name, hint in get_type_hints(kind).items() if name in kind.__dataclass_fields__}
    head = f"{where}: " if where else ""
    if unknown := sorted(str(key) for key in config if key not in known):
        if not where:
            raise InputError(f"unknown config key {unknown[0]!r}; --cfg job prints all keys")
        near = did_you_mean(unknown[0], known) or ";"
        raise InputError(f"{head}unknown key {unknown[0]}{near} known are {', '.join(known)}")
    given = {key: convert_value(known[key], value, f"{where}.{key}" if where else key) for key, value in config.items()}
    optional = {f.name for f in fields(kind) if f.default is not MISSING or f.default_factory is not MISSING}
    if missing := [key for key in known if key not in given and key not in optional]:
        raise InputError(f"{head}{', '.join(missing)} missing")
    return kind(**given)


def convert_value(hint: Any, value: Any, where: str) -> Any:
    """A plain value as a field of this type has it; InputError where it is of another. Other types take anything."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for option in options:
        if isinstance(option, type) and is_dataclass(option):
            if isinstance(value, (Mapping, option)):
                return settings_from(option, value, where)
        elif _fits(option, value):
            if _is_list(option):
                return tuple(map(_kind_of_list(option), value))
            return int(value) if option is int else value
    wanted = " or ".join(dict.fromkeys(_describe_type(option) for option in options))
    remedy = ""
    if is_number(value) and any(_is_list(option) and str not in get_args(option) for option in options):
        remedy = f"; as a list: {where}=[{value:g},…]"
    elif str in options and is_number(value):
        remedy = f"; as a name: \"{where}='{value}'\""
    elif str in options and isinstance(value, (list, tuple)):
        remedy = f"; one at a time, or -m {where}={','.join(map(str, value))} for a run each"
    raise InputError(f"{where} is {value!r}, must be {wanted}{remedy}")


def _fits(option: Any, value: Any) -> bool:
    if option is NoneType:
        return value is None
    if option is int:
        return is_number(value) and value == int(value)
    if option is float:
        return is_number(value)
    if option in (bool, str):
        return isinstance(value, option)
    if get_origin(option) is Literal:
        return value in get_args(option)
    if _is_list(option):
        return isinstance(value, (list, tuple)) and all(_fits(_kind_of_list(option), x) for x in value)
    return isinstance(value, Mapping) if get_origin(option) is Mapping else True


def _is_list(option: Any) -> bool:
    return get_origin(option) in (tuple, list, Sequence) and set(get_args(option)) <= {float, int, str, ...}


def _kind_of_list(option: Any) -> Any:
    return next(x for x in get_args(option) if x is not ...)


def _describe_type(option: Any) -> str:
    if get_origin(option) is Literal:
        return f"one of {', '.join(map(str, get_args(option)))}"
    if _is_list(option):
        return "a list of words" if str in get_args(option) else "a list of numbers"
    if get_origin(option) is Mapping or (isinstance(option, type) and is_dataclass(option)):
        return "a mapping"
    return {NoneType: "null", bool: "true or false", str: "a name or path", int: "a whole number"}.get(
        option, "a number"
    )


def bounded_field(default: Any, low: float, high: float) -> Any:
    """A field of :class:`Ranged` settings: its default, and the least and the greatest value."""
    return field(default=default, metadata={RANGE: (low, high)})


class Ranged:
    """Settings whose numbers are checked against their ranges: of :func:`bounded_field`, else of the class, if any.

    InputError for a value outside, or none that is finite; ``where`` is what a user calls the settings.
    """

    _where: ClassVar[str]
    _range: ClassVar[tuple[float, float] | None]

    def __init_subclass__(cls, where: str, least: float | None = None, greatest: float = math.inf) -> None:
        cls._where, cls._range = where, None if least is None else (least, greatest)

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value, limits = getattr(self, f.name), f.metadata.get(RANGE, self._range)
            if limits is None or isinstance(value, (str, bool, list, tuple)) or value is None:
                continue
            if not is_number(value) or not limits[0] <= value <= limits[1]:
                low, high = (f"{limit:g}" for limit in limits)
                wanted = f"a finite number ≥ {low}" if high == "inf" else f"from {low} to {high}"
                raise InputError(f"{self._where}: {f.name} is {value!r}, must be {wanted}")


def is_number(value: Any) -> bool:
    """A finite number; true and false are none."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
