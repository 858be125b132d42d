"""Source files of a user's own classes: a model needs them elsewhere, and a training that goes on needs the same."""

from __future__ import annotations

import ast
import hashlib
import shutil
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any

import dlkf
from dlkf.base.classes import TARGET


def find_own_modules(config: Any) -> dict[str, Path]:
    """Files of the loaded modules that the classes named in a configuration (``_target_``) need, by what they import.

    The key is the path below a folder of ``PYTHONPATH``, as in ``mine/gru.py``. Neither this package nor what is
    installed is among them.
    """
    found: dict[str, Path] = {}
    wanted, seen = list(_list_modules(config)), set()
    while wanted:
        name = wanted.pop()
        if not name or name in seen:
            continue
        seen.add(name)
        wanted.append(name.rpartition(".")[0])
        file = Path(getattr(sys.modules.get(name), "__file__", None) or "")
        if not _is_own(file):
            continue
        found[name.replace(".", "/") + ("/__init__.py" if file.name == "__init__.py" else ".py")] = file
        wanted += _list_imports(file, sys.modules[name].__package__)
    return dict(sorted(found.items()))


def digest_modules(modules: Mapping[str, Path]) -> dict[str, str]:
    """A digest of each file."""
    return {path: hashlib.sha256(file.read_bytes()).hexdigest()[:32] for path, file in modules.items()}


def copy_modules(modules: Mapping[str, Path], folder: Path) -> list[Path]:
    """The files below ``folder`` by their paths; returns what lies in it."""
    folder.mkdir(parents=True, exist_ok=True)
    for path, file in modules.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, folder / path)
    return sorted(folder.iterdir())


def find_missing_modules(config: Any, folder: Path) -> None:
    """Put ``folder`` behind the path where a module of the classes named in a configuration is not on it."""
    names = {name.partition(".")[0] for name in _list_modules(config)} - {""}
    if folder.is_dir() and any(name not in sys.modules and find_spec(name) is None for name in names):
        sys.path.append(str(folder))


def _list_modules(config: Any) -> Iterator[str]:
    if isinstance(config, Mapping):
        if isinstance(name := config.get(TARGET), str):
            yield name.rpartition(":" if ":" in name else ".")[0]
        for value in config.values():
            yield from _list_modules(value)


def _is_own(file: Path) -> bool:
    ours = [Path(sysconfig.get_path("stdlib")), Path(dlkf.__file__).parent]
    installed = {"site-packages", "dist-packages"}.intersection(file.parts)
    return file.suffix == ".py" and not installed and not any(file.is_relative_to(folder) for folder in ours)


def _list_imports(file: Path, package: str | None) -> Iterator[str]:
    """Names of modules, and of what may be one, that a file imports."""
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package or None)
            yield from (base, *(f"{base}.{alias.name}" for alias in node.names))
