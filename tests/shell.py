"""Commands as a user starts them."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

PATIENCE_S = 900.0  # a command takes seconds; what a busy machine makes of it is no fault of its own


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str


def in_shell(folder: Path, command: str, *arguments: object) -> Ended:
    """A command in an interpreter of its own, as a user starts it."""
    done = subprocess.run(
        [sys.executable, "-m", f"dlkf.{command}", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    return Ended(done.returncode, done.stdout, done.stderr)
