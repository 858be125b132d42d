"""What may be typed next: keys of a command as it stands on the line, however deep, presets, and values of switches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from dlkf.command import GROUPS, with_group
from dlkf.command.arguments import readable
from dlkf.command.composing import composed
from dlkf.command.help import presets_of
from dlkf.config import config_dir

ADDS = ("++", "+", "~")  # before a key, to Hydra


def completed(command: str, word: str, before: Sequence[str]) -> list[str]:
    """Whole words that begin with ``word``; ``before``: the words between the command and it, whose presets count.

    ``imu`` is both a group and a mapping, so it gives ``imu=`` and ``imu.``.
    """
    sign = next((s for s in ADDS if word.startswith(s)), "")
    key, equals, _ = word.removeprefix(sign).partition("=")
    groups = _groups(command)
    if equals and (config_dir() / (folder := groups.get(key, key))).is_dir():
        found = [f"{key}={name}" for name in presets_of(folder, command)]
    else:
        path = key.split(".") if equals else key.split(".")[:-1]
        values = _at(_settings(command, before), path)
        found = [f"{key}={v}" for v in _values(values)] if equals else _keys(values, ".".join(path), groups)
        if not equals and len(path) == 0 and sign:
            found += [f"{p.name}=" for p in config_dir().iterdir() if presets_of(p.name, command)]
    return sorted(f"{sign}{w}" for w in set(found) if w.startswith(word.removeprefix(sign)))


def _settings(command: str, before: Sequence[str]) -> Mapping[str, Any]:
    """The command's configuration with the words so far; without them where they do not fit together (yet)."""
    for tried in (before, ()):
        try:
            words = [readable(with_group(w, GROUPS.get(command, {}))) for w in tried if "=" in w or w.startswith("~")]
            return composed(command, *words, resolve=False)
        except Exception:  # whatever Hydra says of a line that is not finished
            continue
    return {}


def _groups(command: str) -> dict[str, str]:
    """Key → folder of ``conf/`` whose files it takes."""
    content = yaml.safe_load((config_dir() / f"{command}.yaml").read_text(encoding="utf-8"))
    names = [name for entry in content.get("defaults", []) if isinstance(entry, dict) for name in entry]
    pairs = [name.partition("@") for name in names if not name.startswith("override")]
    return {shown or folder: folder for folder, _, shown in pairs}


def _at(values: Any, path: Sequence[str]) -> Any:
    for part in path:
        values = values.get(part) if isinstance(values, Mapping) else None
    return values


def _keys(values: Any, above: str, groups: Mapping[str, str]) -> list[str]:
    found = []
    for name, value in values.items() if isinstance(values, Mapping) else ():
        key = f"{above}.{name}" if above else str(name)
        nested = isinstance(value, Mapping) and value
        found += [f"{key}."] if nested else []
        found += [f"{key}="] if not nested or key in groups else []
    return found + [f"{g}=" for g in groups if not above]


def _values(value: Any) -> list[str]:
    """Both of a switch; else what stands there now, where that is one word."""
    if isinstance(value, bool):
        return ["false", "true"]
    return [] if value in (None, "", "???") or isinstance(value, (Mapping, list)) else [str(value)]
