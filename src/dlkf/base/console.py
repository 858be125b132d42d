"""Output to the user: a console that keeps its lines, a progress bar for work that counts its steps, a warning.

Rich is imported where it draws: rooms that compute take a progress callback from here, and a model that was logged runs
without it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from dlkf.base.files import replace_file

if TYPE_CHECKING:
    from rich.console import Console

ProgressCallback = Callable[[int, int | None], None]  # steps done, steps in all where that is known
LOG = "log.txt"  # beside a report
SAY_EVERY_S = 30.0  # in a file; a terminal has a bar


def no_progress(done: int, total: int | None) -> None:
    """Nobody watches."""


def make_console(width: int = 110) -> Console:
    """A console as wide as the terminal, or so many columns, that keeps its lines."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else width, record=True)


def save_log(console: Console, folder: str | Path) -> None:
    """The lines printed so far, as the folder's ``log.txt``."""
    with replace_file(f"{folder}/{LOG}") as beside:
        beside.write_text(console.export_text(clear=False), encoding="utf-8")


@cache
def warn_once(line: str) -> None:
    """A line on stderr, once a process: something goes on, in another way than it should."""
    print(f"dlkf: warning: {line}", file=sys.stderr, flush=True)


def _lines(title: str) -> ProgressCallback:
    """A line on stderr every ``SAY_EVERY_S``; nothing of work that is done before."""
    began = said = time.monotonic()

    def tell(done: int, total: int | None) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said < SAY_EVERY_S:
            return
        said = now
        of = "" if total is None else f"/{total}"
        left = "" if not (done and total) else f", {(now - began) * (total - done) / done:.0f} s left"
        print(f"{title}: {done}{of} after {now - began:.0f} s{left}", file=sys.stderr, flush=True)

    return tell


@contextmanager
def show_progress(title: str) -> Iterator[ProgressCallback]:
    """A callable (steps done, steps in all) that moves a bar on stderr; it vanishes at the end. In a file: lines."""
    if not sys.stderr.isatty():
        yield _lines(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
