"""Where the configuration lives, in the wheel or at the top of the repository, and its presets as plain values."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dlkf.base.errors import InputError


def config_dir() -> Path:
    """Absolute path of ``conf/``: the packaged copy if there is one, else the repository's."""
    here = Path(__file__).resolve().parent
    for folder in (here.parent / "conf", here.parents[2] / "conf"):
        if (folder / "train.yaml").is_file():
            return folder
    raise InputError("the configuration folder conf/ is missing from this installation; install dlkf again")


def preset_names(group: str) -> list[str]:
    """Presets of ``conf/<group>``; what several of them share begins with an underscore."""
    return sorted(file.stem for file in (config_dir() / group).glob("[!_]*.yaml"))


def read_preset(group: str, name: str) -> dict[str, Any]:
    """The content of ``conf/<group>/<name>.yaml``, over that of the presets in its list of defaults."""
    own = yaml.safe_load((config_dir() / group / f"{name}.yaml").read_text(encoding="utf-8"))
    values: dict[str, Any] = {}
    for base in own.pop("defaults", ()):
        values = values if base == "_self_" else merge_settings(values, read_preset(group, base))
    return merge_settings(values, own)


def merge_settings(base: Any, over: Any) -> Any:
    """A mapping with the values of another one in their place."""
    if not isinstance(base, Mapping) or not isinstance(over, Mapping):
        return copy.deepcopy(over)
    out = {key: copy.deepcopy(value) for key, value in base.items() if key not in over}
    return out | {key: merge_settings(base.get(key), value) for key, value in over.items()}
