"""Where a result comes from: the command, the version of this program, its commit, the day."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import dlkf


def describe_provenance() -> dict[str, str]:
    """``command``, ``date``, ``version`` and, run from a clone, ``commit`` (with ``+`` where files were changed)."""
    made = {
        "command": command_line(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "version": dlkf.__version__,
    }
    return made | ({"commit": found} if (found := repository_commit()) else {})


def command_line() -> str:
    """What was typed, as a shell takes it."""
    name = os.environ.get("DLKF_COMMAND") or f"python -m dlkf.{Path(sys.argv[0]).stem}"
    return shlex.join([*name.split(), *sys.argv[1:]])


def repository_commit() -> str | None:
    """Commit of the clone that this package runs from, None outside of one."""
    root = Path(dlkf.__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        said = [
            subprocess.run(["git", "-C", str(root), *what], capture_output=True, text=True, timeout=10, check=True)
            for what in (["rev-parse", "--short=10", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        ]
    except (OSError, subprocess.SubprocessError):
        return None
    return said[0].stdout.strip() + ("+" if said[1].stdout.strip() else "")
