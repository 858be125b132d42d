"""What all commands share: Hydra around a function, one clear line for what went wrong, and an exit code."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from dlkf.command.arguments import checked_keys, checked_seeds, checked_types, readable
from dlkf.command.faults import fault
from dlkf.command.help import help_text
from dlkf.config import SWEPT, config_dir
from dlkf.errors import InputError, Terminated

MISTAKE, INTERRUPTED, TERMINATED = 2, 130, 143


# ``dataset=`` and ``model=`` choose a preset in one command and name a folder in another. Hydra knows a group by
# its folder alone, so the presets lie in folders of other names and the first kind of command says which.
GROUPS = {"simulate": {"dataset": "simulated"}, "train": {"model": "filter"}}


def command(
    name: str, arguments: Callable[[list[str]], list[str]] = list
) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make a function of the composed ``conf/<name>.yaml`` a command line program.

    A user's mistake (:class:`InputError`, an unknown key or preset, a malformed override) and a fault of the machine
    (a full disk, a locked store, no GPU) are one line on stderr and exit code 2; Ctrl-C is exit code 130, SIGTERM
    143; a fault of ours keeps its traceback. ``arguments`` may rewrite the command line first. The points of a
    sweep write into folders of their own under ``out``.
    """

    def decorate(function: Callable[[DictConfig], None]) -> Callable[[], None]:
        @wraps(function)
        def task(cfg: DictConfig) -> None:
            hydra_config = HydraConfig.get()
            sweep = hydra_config.mode == RunMode.MULTIRUN
            try:
                for key in sorted(OmegaConf.missing_keys(cfg)):
                    raise InputError(f"{key} is missing; give {key}=…")
                given = list(hydra_config.overrides.task)
                checked_types(name, cfg, given)
                checked_keys(name, cfg, given)
                checked_seeds(OmegaConf.to_container(cfg))
                if sweep and cfg.get("out"):
                    with open_dict(cfg):
                        cfg.out = str(Path(cfg.out) / point(hydra_config))
                function(cfg)
            except Exception as error:
                if sweep or fault(error) is None:
                    raise  # a worker of a sweep must not exit: the sweep reports it
                _refuse(error)

        @wraps(function)
        def main() -> None:
            if {"--help", "-h"} & set(sys.argv[1:]):
                print(help_text(name, GROUPS.get(name, {})))
                return
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach us whole instead of Hydra's exit
            given = [_with_group(argument, GROUPS.get(name, {})) for argument in arguments(sys.argv[1:])]
            sys.argv[1:] = [readable(argument) for argument in given]
            before = signal.signal(signal.SIGTERM, _terminate)
            try:
                run = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)
                run(task)()
            except Exception as error:
                if fault(error) is None:
                    raise
                _refuse(error)
            except KeyboardInterrupt as end:
                terminated = isinstance(end, Terminated)
                print(f"dlkf: {'terminated' if terminated else 'interrupted'}", file=sys.stderr)
                sys.exit(TERMINATED if terminated else INTERRUPTED)
            finally:
                signal.signal(signal.SIGTERM, before)

        return main

    return decorate


def point(hydra_config: DictConfig) -> str:
    """Folder of one point of a sweep: its number and what it changes, as ``0-imu=consumer``."""
    swept = json.loads(os.environ.get(SWEPT, "[]"))
    words = [o for o in hydra_config.overrides.task if not swept or o.partition("=")[0] in swept]
    return f"{hydra_config.job.num}-{','.join(words)}".replace("/", "-")[:100]


def _terminate(*_: object) -> NoReturn:
    raise Terminated


def _with_group(argument: str, groups: dict[str, str]) -> str:
    key, equals, value = argument.partition("=")
    if equals and key == "outage" and value in ("null", "none", "off", "false"):
        return "~outage"  # how Hydra takes a preset out
    return f"{groups[key]}@{key}={value}" if equals and key in groups else argument


def _refuse(error: Exception) -> NoReturn:
    print(f"dlkf: error: {fault(error)}", file=sys.stderr)
    sys.exit(MISTAKE)
