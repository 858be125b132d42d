"""The command line before Hydra reads it: ordinary paths and words need no quotes, a number must be one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from dlkf.base.config import config_dir, preset_names
from dlkf.base.documents import read_yaml
from dlkf.base.errors import InputError, did_you_mean
from dlkf.base.files import is_url
from dlkf.base.settings import is_number

SWITCHED_OFF = ("outage", "injected_bias", "smoother", "export")  # where none means null
OF_HYDRA = re.compile(r"(^|[/.])hydra([/.]|$)")  # groups and packages of its own settings
HYDRA_HEADER = re.compile(r"^#\s*@package\s+(_global_\.)?hydra\b", re.MULTILINE)
WITH_VALUE = ("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--package", "-p", "--cfg", "-c")


def check_options(arguments: list[str]) -> None:
    """InputError for an option (``--…``) that Hydra does not have, or a word that it does not take."""

    def refuse(message: str) -> NoReturn:
        raise InputError(f"{message}; settings are key=value, --help names them")

    parser = get_args_parser()
    parser.error = refuse
    parser.parse_args([word for word in arguments if word.startswith("-") or "=" not in word])


def move_options_first(arguments: Sequence[str]) -> list[str]:
    """Options, then settings: Hydra refuses settings on both sides of an option (``dataset=a -m model=b,c``)."""
    after = [False, *(word in WITH_VALUE for word in arguments)]
    settings = ["=" in word and not word.startswith("-") and not value for word, value in zip(arguments, after)]
    return [
        *(word for word, setting in zip(arguments, settings) if not setting),
        *(word for word, setting in zip(arguments, settings) if setting),
    ]


def check_presets(arguments: Sequence[str]) -> None:
    """InputError for a preset of a ``--config-dir`` folder that Hydra could not read, or that names what Hydra calls.

    Such a folder may have come with a dataset. With a preset count those that its list of defaults takes.
    """
    folder = get_args_parser().parse_known_args(list(arguments))[0].config_dir
    for word in arguments if folder else ():
        choice, equals, value = word.lstrip("+").partition("=")
        if equals and not word.startswith("-"):
            for name in value.strip("[]'\"").split(","):
                _check_preset(Path(folder), choice, name.strip("'\" "), set())


def _check_preset(folder: Path, choice: str, name: str, seen: set[Path]) -> None:
    """The preset ``name`` of a choice, ``group`` or ``group@package``, if the folder has it."""
    group, _, package = choice.partition("@")
    file = folder / group / f"{name}.yaml"
    if not group or not name or file in seen or not file.is_file():
        return
    seen.add(file)
    values = read_yaml(file)
    if not isinstance(values, Mapping):
        return
    of_hydra = OF_HYDRA.search(package or group) or HYDRA_HEADER.search(file.read_text(encoding="utf-8"))
    if _names_calls(values if of_hydra else values.get("hydra")):
        raise InputError(f"{file}: names a class or function for Hydra to call; presets of your own must not")
    listed = values.get("defaults")
    for entry in listed if isinstance(listed, list) else ():
        for key, chosen in entry.items() if isinstance(entry, Mapping) else [_split_default(str(entry))]:
            path = re.sub(r"^(override |optional )*", "", str(key))
            inner = path.removeprefix("/") if path.startswith("/") else f"{group}/{path}"
            for one in chosen if isinstance(chosen, list) else [chosen]:
                _check_preset(folder, inner, str(one), seen)


def _split_default(entry: str) -> tuple[str, str]:
    """``folder/name@package`` of a list of defaults as ``folder@package`` and ``name``."""
    path, at, package = entry.partition("@")
    folder, slash, name = path.rpartition("/")
    return f"{folder or slash}{at}{package}", name


def check_choices(arguments: Sequence[str]) -> None:
    """InputError for a preset that is chosen by a number, by nothing, or by a list where one is needed."""
    for word in arguments:
        key, equals, value = word.partition("=")
        group = key.lstrip("+").partition("@")[0]
        if not equals or not group or word.startswith(("-", "~")) or not (config_dir() / group).is_dir():
            continue
        meant = key.lstrip("+").partition("@")[2] or group
        if re.fullmatch(r"null|none|true|false|[-+.\d][\d.e+-]*", value, re.IGNORECASE):
            more = f"; a length in seconds is outage.duration_s={value}" if group == "outage" else ""
            raise InputError(f"{meant}={value}: must be the name of a preset: {', '.join(preset_names(group))}{more}")
        if value.startswith("[") and "," in value and not key.startswith("+"):
            each = value.strip("[]").replace(" ", "")
            raise InputError(f"{meant}={value}: one preset at a time; -m {meant}={each} runs one after the other")


def _names_calls(values: Any) -> bool:
    """Whether a class or function is named for Hydra or for its logging to call."""
    if isinstance(values, Mapping):
        return bool({"_target_", "()"} & set(values)) or any(map(_names_calls, values.values()))
    return isinstance(values, list) and any(map(_names_calls, values))


def quote_argument(argument: str) -> str:
    """An override that Hydra's grammar takes: a value that it does not is quoted, ``~/`` is the home folder.

    ``out=Straße (1)`` → ``out='Straße (1)'``; in a list every word by itself. What is in the grammar stays as it is.
    InputError for the home of a user that is not there.
    """
    key, equals, value = argument.partition("=")
    if not equals or argument.startswith(("-", "~")):
        return argument
    listed = value.startswith("[") and value.endswith("]")
    words = [expand_home(word.strip()) for word in value[1:-1].split(",")] if listed else []
    value = f"[{','.join(words)}]" if "~" in value and listed else expand_home(value)
    if value.lower() == "none" and key in SWITCHED_OFF:
        value = "null"
    if _parses(f"{key}={value}"):
        return f"{key}={value}"
    if listed:
        inside = ",".join(word if _parses(f"{key}={word}") else _quote(word) for word in words)
        if _parses(f"{key}=[{inside}]"):
            return f"{key}=[{inside}]"
    quoted = f"{key}={_quote(value)}"
    return quoted if _parses(quoted) else argument


def expand_home(path: str) -> str:
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


def _quote(value: str) -> str:
    return "'" + value.replace("'", "\\'") + "'"


def check_seeds(values: Any, where: str = "") -> None:
    """InputError for a seed, at any depth, that no generator of random numbers takes."""
    for key, value in values.items() if isinstance(values, Mapping) else ():
        path = f"{where}{key}"
        if (key == "seed" or str(key).endswith("_seed")) and is_number(value) and not 0 <= value < 2**63:
            raise InputError(f"{path} is {value!r}, must be a whole number ≥ 0")
        check_seeds(value, f"{path}.")


def check_out(values: Mapping[str, Any]) -> None:
    """InputError for an ``out`` that is what the command reads, lies in its dataset, or would take it away."""
    out = values.get("out")
    if not isinstance(out, str) or not out or is_url(out):
        return
    place = Path(out).expanduser().resolve()
    for key in ("dataset", "source"):
        read = values.get(key)
        for name in read if isinstance(read, list) else [read]:
            if not isinstance(name, str) or not name or is_url(name):
                continue
            folder = Path(name).expanduser().resolve()
            if place == folder:
                raise InputError(f"out={out} is the {key} itself; give another folder")
            if key == "dataset" and folder in place.parents:
                raise InputError(f"out={out} lies in the dataset {name}; give a folder outside it")
            if values.get("overwrite") and place in folder.parents:
                raise InputError(f"out={out} holds the {key} {name}, which overwrite=true would remove")


def with_near_key(line: str, command: str) -> str:
    """A line about an unknown key with the key of the command that is meant, where one is close."""
    if not (unknown := re.match(r"unknown config key '([^']+)'; ", line)) or GlobalHydra.instance().is_initialized():
        return line  # within a command: a key that was added on purpose
    from dlkf.command.composing import compose_command

    key, rest = unknown[1], line[unknown.end() :]
    if (command, key) == ("evaluate", "smoother"):
        return f"{line[: unknown.end()]}smoother belongs to navigate; a smoothed filter here is model=<filter>_rts"
    if (config_dir() / key).is_dir():
        return f"{line[: unknown.end()]}a preset is chosen with a plus: +{key}=…; {rest}"
    known = list(_paths(compose_command(command, resolve=False)))
    if key in known:
        return f"{key}: has no such key; one that its settings take is added as +{key}.<key>=…; {rest}"
    below = [path for path in known if path.endswith(f".{key}")]
    near = f"; did you mean {' or '.join(below[:3])}?" if below else did_you_mean(key, known) or ";"
    return f"{line[: unknown.end() - 2]}{near} {rest}"


def _paths(values: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """All keys, with those above them."""
    for key, value in values.items():
        yield above + str(key)
        if isinstance(value, Mapping):
            yield from _paths(value, f"{above}{key}.")
