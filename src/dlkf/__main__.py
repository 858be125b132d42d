"""``dlkf <command> key=value …``, the same as ``python -m dlkf.<command>``; ``dlkf`` alone lists the commands.

Modules of one's own are found in the current folder, after all that is installed.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import NoReturn

import dlkf
from dlkf.base.errors import did_you_mean
from dlkf.base.own_process import end_at_once, keep_freed_memory, print_any_letter

COMMANDS = {
    "simulate": "simulate drives with an exact reference, as a dataset",
    "ingest": "convert logs to a dataset",
    "doctor": "check a dataset before a filter runs",
    "navigate": "run a filter over whole drives: solution, map, exports",
    "evaluate": "compare filters in GNSS outages: tables, report",
    "export": "write a filter as C code for a vehicle",
    "train": "train a filter and score it against Kalman filters",
    "tune": "fit the noise of a Kalman filter to drives",
    "allan": "identify the noise of an IMU from a log at rest",
    "consistency": "compute NEES and NIS of a filter on simulated drives",
    "compare": "put several evaluations on one page",
    "register": "add a model to the MLflow registry",
    "ui": "open MLflow on the runs of this folder",
}


def program() -> None:
    """:func:`main` as a process of its own, which ends with it."""
    main()
    end_at_once()


def main() -> None:
    """Run a command; 2 for an unknown one, 130 after Ctrl-C, even while the libraries load."""
    print_any_letter()
    word, rest = (sys.argv[1] if len(sys.argv) > 1 else "help"), sys.argv[2:]
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        if word in ("help", "--help", "-h"):
            print(usage())
        elif word in ("--version", "-V", "version"):
            print(f"dlkf {dlkf.__version__}")
        elif word in COMMANDS:
            sys.argv = [sys.argv[0].replace("__main__.py", "dlkf"), *rest]
            os.environ["DLKF_COMMAND"] = f"dlkf {word}"
            if not sys.flags.safe_path and os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # where python -m finds modules too, but before all others
            if {"--help", "-h"} & set(rest) and word != "ui":
                from dlkf.command import print_help  # the command itself loads torch, which takes seconds

                print_help(word)
            else:
                _load(word)()
        else:
            near = did_you_mean(word, COMMANDS) or ";"
            print(f"dlkf: error: unknown command {word!r}{near} known: {', '.join(COMMANDS)}", file=sys.stderr)
            sys.exit(2)
    except KeyboardInterrupt:
        print("dlkf: interrupted", file=sys.stderr)
        sys.exit(130)
    finally:
        signal.signal(signal.SIGTERM, before)


def _load(command: str) -> Callable[[], None]:
    """The function of a command. What is loaded stays, so that to look for garbage in it is a fifth of the time.

    torch's threads wait asleep: spinning, as they do else, they take several times the processor and the time where
    another process wants the core. A training, whose products are larger, is left as it is.
    """
    if command != "train":
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        keep_freed_memory()
    gc.disable()
    try:
        return import_module(f"dlkf.{command}").main
    finally:
        gc.freeze()
        gc.enable()


def _terminate(*_: object) -> NoReturn:
    print("dlkf: terminated", file=sys.stderr)
    sys.exit(143)


def usage() -> str:
    """What there is."""
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name.ljust(width)}  {what}" for name, what in COMMANDS.items())
    return (
        f"dlkf {dlkf.__version__}: Kalman filters for GNSS and IMU, and a learned one\n\n"
        f"usage: dlkf <command> key=value …\n\n{lines}\n\n"
        "dlkf <command> --help shows its settings, --cfg job prints them all with their values."
    )


if __name__ == "__main__":
    program()
