"""The command line before Hydra reads it: ordinary paths and words need no quotes, a number must be one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from dlkf.errors import InputError
from dlkf.settings import is_number

CLOSED = ("prior", "tracking")  # sections whose keys are those of the primary file
SWITCHED_OFF = ("outage", "injected_bias", "smoother", "export")  # where none means null


def readable(argument: str) -> str:
    """An override that Hydra's grammar takes: a value that it does not is quoted, ``~/`` is the home folder.

    ``out=Straße (1)`` → ``out='Straße (1)'``; in a list every word by itself. What is in the grammar stays as it is.
    """
    key, equals, value = argument.partition("=")
    if not equals or argument.startswith(("-", "~")):
        return argument
    if value.startswith("~/"):
        value = str(Path(value).expanduser())
    if value.lower() == "none" and key in SWITCHED_OFF:
        value = "null"
    if _parses(f"{key}={value}"):
        return f"{key}={value}"
    if value.startswith("[") and value.endswith("]"):
        words = [word.strip() for word in value[1:-1].split(",")]
        listed = ",".join(word if _parses(f"{key}={word}") else _quoted(word) for word in words)
        if _parses(f"{key}=[{listed}]"):
            return f"{key}=[{listed}]"
    quoted = f"{key}={_quoted(value)}"
    return quoted if _parses(quoted) else argument


def _parses(override: str) -> bool:
    try:
        OverridesParser.create().parse_override(override)
    except (HydraException, ValueError):
        return False
    return True


def _quoted(value: str) -> str:
    return "'" + value.replace("'", "\\'") + "'"


def checked_types(name: str, cfg: DictConfig, overrides: Sequence[str]) -> None:
    """InputError for a word where the defaults of ``conf/<name>.yaml`` have a number or a switch."""
    parsed = _parsed(overrides)
    words = {
        o.get_key_element(): value
        for o in parsed
        if not o.is_delete()
        and not {"@", "/"} & set(o.get_key_element())
        and isinstance(value := OmegaConf.select(cfg, o.get_key_element()), str)
    }
    if not words:
        return
    presets = [text for o, text in zip(parsed, overrides) if o.get_key_element() not in words and not _inside(cfg, o)]
    usual = compose(name, overrides=presets)
    for key, value in words.items():
        default = OmegaConf.select(usual, key, throw_on_missing=False)
        if isinstance(default, bool):
            raise InputError(f"{key} is {value!r}, must be true or false")
        if isinstance(default, (int, float)):
            raise InputError(f"{key} is {value!r}, must be a number")


def checked_keys(name: str, cfg: DictConfig, overrides: Sequence[str]) -> None:
    """InputError for a key added with ``+`` that the command does not know.

    What is added inside a section is left to the settings that are made of it.
    """
    adding = (o for o in _parsed(overrides) if o.is_add() or o.is_force_add())
    added = [o.get_key_element().lstrip("+").partition("@")[0] for o in adding]
    new = [key for key in added if "/" not in key and key.partition(".")[0] in cfg]
    known = compose(name) if new else cfg
    for key in new:
        top, dot, _ = key.partition(".")
        if top not in known or (dot and top in CLOSED and OmegaConf.select(known, key) is None):
            raise InputError(f"unknown config key {key!r}; --cfg job prints all keys")


def checked_seeds(values: Any, where: str = "") -> None:
    """InputError for a seed, at any depth, that no generator of random numbers takes."""
    for key, value in values.items() if isinstance(values, Mapping) else ():
        path = f"{where}{key}"
        if (key == "seed" or str(key).endswith("_seed")) and is_number(value) and not 0 <= value < 2**63:
            raise InputError(f"{path} is {value!r}, must be a whole number ≥ 0")
        checked_seeds(value, f"{path}.")


def _parsed(overrides: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(overrides))


def _inside(cfg: DictConfig, override) -> bool:
    """Whether an override changes a value, not a preset."""
    return "." in override.get_key_element() or not isinstance(
        OmegaConf.select(cfg, override.get_key_element().partition("@")[2] or override.get_key_element()), DictConfig
    )
