"""Commands as a user starts them."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path

PATIENCE_S = 300.0  # a command takes seconds; what a busy machine makes of it is no fault of its own


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


def start_fork(folder: Path, said: Path, work: Callable[[], object]) -> ForkProcess:
    """A process in ``folder`` that does ``work`` and writes what it says into a file.

    It has all modules that this one has imported: a new interpreter takes ten seconds for those of a training.
    """

    def begin() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
        os.chdir(folder)
        place = os.open(said, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o600)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os.dup2(place, 1), os.dup2(place, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        work()

    process = get_context("fork").Process(target=begin)
    process.start()
    return process


def start_command(folder: Path, said: Path, command: str, *arguments: object) -> ForkProcess:
    """``python -m dlkf.<command> …`` in a fork of this process."""
    main = importlib.import_module(f"dlkf.{command}").main

    def work() -> None:
        sys.argv = [f"dlkf.{command}", *map(str, arguments)]
        main()

    return start_fork(folder, said, work)
