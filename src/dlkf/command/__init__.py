"""What all commands share: Hydra around a function, one clear line for what went wrong, and an exit code."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

import dlkf
from dlkf.base.config import config_dir
from dlkf.base.errors import InputError, Terminated
from dlkf.base.files import resolve_place
from dlkf.base.own_process import print_any_letter
from dlkf.base.settings import Settings, settings_from
from dlkf.command import sweeps
from dlkf.command.arguments import (
    check_choices,
    check_options,
    check_out,
    check_presets,
    check_seeds,
    move_options_first,
    quote_argument,
    with_near_key,
)
from dlkf.command.composing import to_plain
from dlkf.command.faults import describe_fault
from dlkf.command.help import help_text

MISTAKE, INTERRUPTED, UNREAD, TERMINATED = 2, 130, 141, 143
stopped_by: list[int] = []  # signals that came while a command ran


# ``dataset=`` and ``model=`` choose a preset in one command and name a folder in another. Hydra identifies a group by
# its folder alone, so the presets lie in folders of other names and the first type of command says which.
GROUPS = {"simulate": {"dataset": "simulated"}, "train": {"model": "filter"}}


def command(
    name: str, settings: type[Settings] | None = None, arguments: Callable[[list[str]], list[str]] = list
) -> Callable[[Callable[[Any], None]], Callable[[], None]]:
    """Make a function of the composed ``conf/<name>.yaml``, as ``settings`` or plain values, a command line program.

    A user's mistake (:class:`InputError`, an unknown key or preset, a malformed override) and a fault of the machine
    (a full disk, a locked store, no GPU) are one line on stderr and exit code 2; Ctrl-C is exit code 130, SIGTERM
    143, a reader of the output that has gone 141; a fault of ours keeps its traceback. ``arguments`` may rewrite the
    command line first. The points of a sweep write into folders of their own under ``out``, and those that fail leave
    the others alone.
    """

    def decorate(function: Callable[[Any], None]) -> Callable[[], None]:
        @wraps(function)
        def task(cfg: DictConfig) -> None:
            hydra_config = HydraConfig.get()
            sweep = hydra_config.mode == RunMode.MULTIRUN
            try:
                for key in sorted(OmegaConf.missing_keys(cfg)):
                    raise InputError(f"{key} is missing; give {key}=…")
                if sweep and cfg.get("out"):
                    with open_dict(cfg):
                        cfg.out = str(resolve_place(cfg.out) / sweeps.job_folder(hydra_config))
                check_seeds(OmegaConf.to_container(cfg))
                values = to_plain(cfg)
                check_out(values)
                function(values if settings is None else settings_from(settings, values, ""))
            except Exception as error:
                if sweep and not stopped_by:
                    sweeps.record_failure(error, hydra_config)
                else:
                    _end(error, name)

        @wraps(function)
        def main() -> None:
            print_any_letter()
            if {"--help", "-h"} & set(sys.argv[1:]):
                print_help(name)
                return
            if "--version" in sys.argv[1:]:
                print(f"dlkf {dlkf.__version__}")
                return
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors reach us whole instead of Hydra's exit
            stopped_by.clear()
            # SIGINT is ignored by what a shell started in the background, and stays so
            heeded = [n for n in (signal.SIGTERM, signal.SIGINT) if signal.getsignal(n) is not signal.SIG_IGN]
            before = {number: signal.signal(number, _stop) for number in heeded}
            try:
                words = move_options_first(arguments(sys.argv[1:]))
                given = [with_group(argument, GROUPS.get(name, {})) for argument in words]
                check_choices(given)
                sys.argv[1:] = [quote_argument(argument) for argument in given]
                check_options(sys.argv[1:])
                check_presets(given)
                with sweeps.collect_job_failures():
                    run = hydra.main(version_base="1.3", config_path=str(config_dir()), config_name=name)
                    run(task)()
            except (Exception, KeyboardInterrupt) as error:
                _end(error, name)
            finally:
                for number, handler in before.items():
                    signal.signal(number, handler)

        return main

    return decorate


def print_help(name: str) -> None:
    """The page of a command."""
    try:
        print(help_text(name, GROUPS.get(name, {})), flush=True)
    except BrokenPipeError as error:
        _end(error, name)


def list_typed_words(*keys: str) -> list[str]:
    """What was typed for these keys or for parts of them: ``imu=consumer``, ``imu.gyro.noise_density=1e-4``."""
    words = HydraConfig.get().overrides.task
    return [word for word in words if word.partition("=")[0].lstrip("+").split(".")[0] in keys]


def repeat_command(name: str) -> list[str]:
    """The command line that composes once more what Hydra composed here, for a point of a sweep too."""
    config = HydraConfig.get()
    folders = [s.path for s in config.runtime.config_sources if s.provider == "command-line"]
    given = [word for folder in folders for word in ("--config-dir", folder)]
    return [sys.executable, "-m", f"dlkf.{name}", *given, *config.overrides.task]


def _end(error: BaseException, name: str) -> NoReturn:
    """One line and an exit code for a stop, a mistake, or a fault of the machine; a fault of ours goes on up.

    A reader written in C makes an error of its own of an interrupt in a call back to Python: the signal counts.
    """
    if stopped_by or isinstance(error, KeyboardInterrupt):
        terminated = signal.SIGTERM in stopped_by or isinstance(error, Terminated)
        print(f"dlkf: {'terminated' if terminated else 'interrupted'}", file=sys.stderr)
        sys.exit(TERMINATED if terminated else INTERRUPTED)
    if isinstance(error, BrokenPipeError):  # as in ``dlkf … | head``: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nor what is still to be flushed
        sys.exit(UNREAD)
    if (said := describe_fault(error, name)) is None:
        raise error
    print(f"dlkf: error: {with_near_key(said, name)}", file=sys.stderr)
    sys.exit(MISTAKE)


def _stop(number: int, _: object) -> NoReturn:
    stopped_by.append(number)
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def with_group(argument: str, groups: dict[str, str]) -> str:
    key, equals, value = argument.partition("=")
    if equals and key == "outage" and value in ("null", "none", "off", "false"):
        return "~outage"  # how Hydra takes a preset out
    return f"{groups[key]}@{key}={value}" if equals and key in groups else argument
