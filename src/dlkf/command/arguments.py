"""The command line before Hydra reads it: ordinary paths and words need no quotes, a number must be one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from dlkf.errors import InputError
from dlkf.settings import is_number

SWITCHED_OFF = ("outage", "injected_bias", "smoother", "export")  # where none means null


def check_options(arguments: list[str]) -> None:
    """InputError for an option (``--…``) that Hydra does not have, or a word that it does not take."""

    def refuse(message: str) -> NoReturn:
        raise InputError(f"{message}; settings are key=value, --help names them")

    parser = get_args_parser()
    parser.error = refuse
    parser.parse_args([word for word in arguments if word.startswith("-") or "=" not in word])


def readable(argument: str) -> str:
    """An override that Hydra's grammar takes: a value that it does not is quoted, ``~/`` is the home folder.

    ``out=Straße (1)`` → ``out='Straße (1)'``; in a list every word by itself. What is in the grammar stays as it is.
    InputError for the home of a user that is not there.
    """
    key, equals, value = argument.partition("=")
    if not equals or argument.startswith(("-", "~")):
        return argument
    listed = value.startswith("[") and value.endswith("]")
    words = [at_home(word.strip()) for word in value[1:-1].split(",")] if listed else []
    value = f"[{','.join(words)}]" if "~" in value and listed else at_home(value)
    if value.lower() == "none" and key in SWITCHED_OFF:
        value = "null"
    if _parses(f"{key}={value}"):
        return f"{key}={value}"
    if listed:
        inside = ",".join(word if _parses(f"{key}={word}") else _quoted(word) for word in words)
        if _parses(f"{key}=[{inside}]"):
            return f"{key}=[{inside}]"
    quoted = f"{key}={_quoted(value)}"
    return quoted if _parses(quoted) else argument


def at_home(path: str) -> str:
    """``~/…`` and ``~user/…`` written out, as shells do where they see a path. InputError for an unknown user."""
    if not path.startswith("~"):
        return path
    try:
        return str(Path(path).expanduser())
    except RuntimeError:
        user = path[1:].partition("/")[0]
        raise InputError(f"{path}: there is no user {user} here; for a folder of that name write ./{path}") from None


def _parses(override: str) -> bool:
    try:
        OverridesParser.create().parse_override(override)
    except (HydraException, ValueError):
        return False
    return True


def _quoted(value: str) -> str:
    return "'" + value.replace("'", "\\'") + "'"


def checked_seeds(values: Any, where: str = "") -> None:
    """InputError for a seed, at any depth, that no generator of random numbers takes."""
    for key, value in values.items() if isinstance(values, Mapping) else ():
        path = f"{where}{key}"
        if (key == "seed" or str(key).endswith("_seed")) and is_number(value) and not 0 <= value < 2**63:
            raise InputError(f"{path} is {value!r}, must be a whole number ≥ 0")
        checked_seeds(value, f"{path}.")
