"""What all commands share: Hydra around a function, and one clear line for a user's mistake."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from functools import wraps

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dlkf.config import config_dir
from dlkf.errors import InputError

MISTAKE, INTERRUPTED = 2, 130


# ``dataset=`` and ``model=`` choose a preset in one command and name a folder in another. Hydra knows a group by
# its folder alone, so the presets lie in folders of other names and the first kind of command says which.
GROUPS = {"simulate": {"dataset": "simulated"}, "train": {"model": "filter"}}


def command(name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make a function of the composed ``conf/<name>.yaml`` a command line program.

    A user's mistake (:class:`InputError`, an unknown key or preset, a malformed override) is one line on
    stderr and exit code 2; Ctrl-C is exit code 130; a fault of ours keeps its traceback.
    """

    def decorate(function: Callable[[DictConfig], None]) -> Callable[[], None]:
        @wraps(function)
        def task(cfg: DictConfig) -> None:
            try:
                for key in sorted(OmegaConf.missing_keys(cfg)):
                    raise InputError(f"{key} is missing; give {key}=…")
                function(cfg)
            except (InputError, OmegaConfBaseException) as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise  # a worker of a sweep must not exit: the sweep reports it
                _refuse(error)

        @wraps(function)
        def main() -> None:
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach us whole instead of Hydra's exit
            sys.argv[1:] = [_with_group(argument, GROUPS.get(name, {})) for argument in sys.argv[1:]]
            try:
                run = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)
                run(task)()
            except (InputError, HydraException, OmegaConfBaseException) as error:
                _refuse(error)
            except KeyboardInterrupt:
                print("dlkf: interrupted", file=sys.stderr)
                sys.exit(INTERRUPTED)

        return main

    return decorate


def _with_group(argument: str, groups: dict[str, str]) -> str:
    key, equals, value = argument.partition("=")
    return f"{groups[key]}@{key}={value}" if equals and key in groups else argument


def _refuse(error: Exception) -> None:
    print(f"dlkf: error: {one_line(error)}", file=sys.stderr)
    sys.exit(MISTAKE)


def one_line(error: Exception) -> str:
    """A message as one line; Hydra's and OmegaConf's lists and hints are folded into it."""
    text = str(error)
    if missing := re.search(r"Could not find '([^']+)'", text):
        options = re.search(r"Available options in '([^']+)':\n((?:\t.*\n?)+)", text)
        hint = f"; available in {options[1]}: {', '.join(options[2].split())}" if options else ""
        return f"unknown preset or config {missing[1]!r}{hint}"
    if unknown := re.search(r"Could not override '([^']+)'|full_key: (\S+)[\s\S]*is not in struct", text):
        return f"unknown config key {unknown[1] or unknown[2]!r}; --cfg job prints all keys"
    if unknown := re.search(r"Key '([^']+)' is not in struct", text):
        return f"unknown config key {unknown[1]!r}; --cfg job prints all keys"
    if missing := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{missing[1]} is missing; give {missing[1]}=…"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    hints = ("full_key:", "object_type=", "reference_type=", "See https")
    lines = [line for line in lines if not line.startswith(hints)]
    return "; ".join(lines) or type(error).__name__
