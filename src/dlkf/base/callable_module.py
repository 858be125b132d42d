"""A command's module is also a function: ``dlkf.navigate(imu, gnss)`` beside ``python -m dlkf.navigate``."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


def make_callable(module: str, function: str) -> None:
    """Let an imported module be called as the function ``package.module:name``; nothing where it runs as a program."""
    if module == "__main__":
        return
    where, _, name = function.partition(":")

    class CallableModule(ModuleType):
        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            return getattr(import_module(where), name)(*args, **kwargs)

    sys.modules[module].__class__ = CallableModule
