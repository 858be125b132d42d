"""The one way from the name of a class, of the package or of a user's own, to the class and to an object of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from inspect import Parameter, signature
from typing import Any, get_type_hints

from dlkf.errors import InputError
from dlkf.settings import fitted

TARGET = "_target_"  # the key that names a class among its settings


def class_named(name: str, where: str, needs: Collection[str] = ()) -> Callable[..., Any]:
    """What ``module:Class`` or ``module.Class`` names; its module's folder is in ``PYTHONPATH``.

    InputError where there is none, or where it lacks an attribute that it ``needs``. ``where`` is what a user wrote
    the name behind.
    """
    module, _, attribute = name.rpartition(":" if ":" in name else ".")
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"{where}={name}: {error}; give module:Class or module.Class, with the module's folder in PYTHONPATH"
        ) from None
    if not callable(found):
        raise InputError(f"{where}={name} is no class")
    return having(found, needs, f"{where}={name}")


def having(thing: Any, needs: Collection[str], what: str) -> Any:
    """A class or an object as it is; InputError where it lacks an attribute that it ``needs``."""
    if not all(hasattr(thing, attribute) for attribute in needs):
        raise InputError(f"{what} has no {' and '.join(a for a in needs if not hasattr(thing, a))}")
    return thing


def made(
    values: Mapping[str, Any], where: str, *, offered: Mapping[str, Any] | None = None, spare: Collection[str] = ()
) -> Any:
    """The object of the class that ``_target_`` names, made with the settings that stand beside it.

    What is ``offered`` is given where the class takes it; keys that are ``spare`` may stand there without being taken.
    InputError for a class that is not there, a setting it does not take or takes otherwise, and one that it misses.
    """
    target = f"{where}.{TARGET}"
    if not isinstance(values, Mapping) or not values.get(TARGET):
        raise InputError(f"{where} has no {TARGET}; it names the class, as module.Class")
    kind = class_named(str(values[TARGET]), target)
    takes = signature(kind).parameters
    anything = any(p.kind is Parameter.VAR_KEYWORD for p in takes.values())
    given = {k: v for k, v in values.items() if k != TARGET}
    if not anything:
        if unknown := sorted(set(given) - set(takes) - set(spare)):
            known = ", ".join(takes) or "nothing"
            raise InputError(f"{where}: {values[TARGET]} takes no {unknown[0]}; it takes {known}")
        given = {k: v for k, v in {**(offered or {}), **given}.items() if k in takes}
    needed = [k for k, p in takes.items() if p.default is Parameter.empty and p.kind not in VARIABLE]
    if missing := [k for k in needed if k not in given]:
        raise InputError(f"{where}: {', '.join(missing)} missing")
    hints = _hints(kind)
    return kind(**{k: fitted(hints.get(k, Any), v, f"{where}.{k}") for k, v in given.items()})


def _hints(kind: Any) -> dict[str, Any]:
    """The types of a constructor's arguments, none where they cannot be read."""
    try:
        return get_type_hints(kind.__init__)
    except (AttributeError, NameError, TypeError):
        return {}


VARIABLE = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
