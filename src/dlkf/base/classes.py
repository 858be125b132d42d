"""Classes by name, of the package or of a user: find them, check their methods, make objects.

A name may come from a preset or a model of another author. So a class must have the methods of its kind before it is
called, and nothing of Python's standard library is ever called: ``os:system``, ``subprocess:Popen`` and ``io:FileIO``
are refused. Importing a named module runs it: a preset is code.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from importlib import import_module
from inspect import Parameter, isfunction, signature
from typing import Any, get_type_hints

from dlkf.base.errors import InputError
from dlkf.base.settings import convert_value

TARGET = "_target_"  # the key that names a class among its settings


def find_class(name: str, where: str, needs: Collection[str]) -> type[Any]:
    """The class that ``module:Class`` or ``module.Class`` names; its module's folder is in ``PYTHONPATH``.

    InputError where there is none, where it is no class or one of Python's own, and where it lacks one of the methods
    that it ``needs``. ``where`` is what a user wrote the name behind.
    """
    module, _, attribute = name.rpartition(":" if ":" in name else ".")
    if module.partition(".")[0] in sys.stdlib_module_names:
        raise InputError(
            f"{where}={name} is a part of Python and nothing that this package calls; give a class of yours"
        )
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(
            f"{where}={name}: {error}; give module:Class or module.Class, with the module's folder in PYTHONPATH"
        ) from None
    if not isinstance(found, type) or found.__module__.partition(".")[0] in sys.stdlib_module_names:
        raise InputError(f"{where}={name} is no class of yours or of this package")
    if lacking := [method for method in needs if not _has_method(found, method)]:
        raise InputError(f"{where}={name} has no {' and '.join(lacking)}")
    return found


def _has_method(kind: type[Any], method: str) -> bool:
    """Whether objects of a class have a method written in Python: a file of a library in C has a ``read`` too.

    A method of the class itself, as ``type.__call__``, is none of its objects'.
    """
    found = next((vars(base)[method] for base in kind.__mro__ if method in vars(base)), None)
    return isfunction(getattr(found, "__func__", found))


def instantiate(
    values: Mapping[str, Any],
    where: str,
    needs: Collection[str],
    *,
    offered: Mapping[str, Any] | None = None,
    spare: Collection[str] = (),
) -> Any:
    """The object of the class that ``_target_`` names, made with the settings beside it.

    The class must have the methods ``needs``, checked before it is called (:func:`find_class`). ``offered`` arguments
    are passed where the class takes them; ``spare`` keys are ignored where it does not. InputError for a missing class,
    an unknown, wrong or missing setting.
    """
    target = f"{where}.{TARGET}"
    if not isinstance(values, Mapping) or not values.get(TARGET):
        raise InputError(f"{where} has no {TARGET}; it names the class, as module.Class")
    kind = find_class(str(values[TARGET]), target, needs)
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
    return kind(**{k: convert_value(hints.get(k, Any), v, f"{where}.{k}") for k, v in given.items()})


def drop_spare(values: Any, where: str, needs: Collection[str], spare: Collection[str]) -> Any:
    """The settings beside ``_target_`` without the ``spare`` keys that its class does not take; all without a class."""
    if not isinstance(values, Mapping) or not values.get(TARGET):
        return values
    takes = signature(find_class(str(values[TARGET]), f"{where}.{TARGET}", needs)).parameters
    anything = any(p.kind is Parameter.VAR_KEYWORD for p in takes.values())
    return {k: v for k, v in values.items() if anything or k in takes or k not in spare}


def _hints(kind: Any) -> dict[str, Any]:
    """The types of a constructor's arguments, none where they cannot be read."""
    try:
        return get_type_hints(kind.__init__)
    except (AttributeError, NameError, TypeError):
        return {}


VARIABLE = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
