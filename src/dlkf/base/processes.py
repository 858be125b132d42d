"""A label of a process that no later process shares, and whether the process has ended."""

from __future__ import annotations

import os
import platform
from pathlib import Path

MACHINE = platform.node()


def process_label(number: int | None = None) -> str:
    """``machine-number-start`` of a process of this machine, this one by default; no start where there is none."""
    number = os.getpid() if number is None else number
    try:
        state, *rest = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        start = "gone" if state == "Z" else rest[18]  # in ticks since the machine was started
    except OSError:
        start = "gone"
    return f"{MACHINE}-{number}-{start}"


def is_gone(label: str) -> bool:
    """Whether a label is of a process of this machine that has ended; of another machine's nothing is known."""
    machine, _, rest = label.rpartition("-")[0].rpartition("-")
    return machine == MACHINE and rest.isdigit() and process_label(int(rest)) != label
