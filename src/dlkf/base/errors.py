"""A user's mistake, and the end that a signal asks for."""

import difflib
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

PACKAGE = str(Path(__file__).parents[1])
LONGEST_LINE = 200  # letters of a message of another library
CLOSE = 0.7  # difflib's ratio from which on another name is worth naming


class InputError(ValueError):
    """Something the user gave is wrong: the message names what, where (drive, row), and the remedy.

    Commands print it as one line and exit with code 2.
    """


def first_line(error: Exception) -> str:
    """The first line of another library's message, the error's class where that is empty."""
    return (str(error).splitlines() or [type(error).__name__])[0][:LONGEST_LINE]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``; did you mean x?`` where a known name is close to this one, else nothing; the closest has two neighbours
    swapped, of several as close it is the one that begins alike, then the first."""

    def closeness(other: str) -> tuple[float, int]:
        alike = next((k for k, (a, b) in enumerate(zip(other, name)) if a != b), min(len(other), len(name)))
        ratio = difflib.SequenceMatcher(None, other.lower(), name.lower()).ratio()
        return 1.0 if other.lower() in swapped else ratio, alike

    name = str(name)
    small = name.lower()
    swapped = {small[:k] + small[k : k + 2][::-1] + small[k + 2 :] for k in range(len(small))}
    best = max(known, key=closeness, default="")
    return f"; did you mean {best}?" if best and closeness(best)[0] >= CLOSE else ""


def list_some(names: Sequence[str], most: int = 8) -> str:
    """The first of several names, and how many more there are: ``a, b and 5 more``."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def count_calls() -> int:
    """How many calls away the code is that called this package: the ``stacklevel`` of a warning that names its line."""
    frame, calls = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(PACKAGE):
        frame, calls = frame.f_back, calls + 1
    return calls


def no_drives(skipped: Mapping[str, str] | None = None) -> InputError:
    """What is wrong where no drive is left: why the first was ``skipped``, or that there was none."""
    return InputError(next(iter((skipped or {}).values()), "no drives: give a dataset with at least one"))


class Terminated(KeyboardInterrupt):
    """SIGTERM: the command ends as after Ctrl-C, with exit code 143."""
