"""The blocks of the pages: files to write, commands to run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "RESULTS.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)


class Block(NamedTuple):
    """A fenced block under a heading; ``file`` is what its first comment names, as in ``# mine/imu/shed.yaml``."""

    heading: str
    language: str
    text: str
    file: str | None


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page in their order."""
    text = page.read_text()
    for found in FENCE.finditer(text):
        heads = re.findall(r"^#+ (.+)$", FENCE.sub("", text[: found.start()]), re.M)
        named = re.match(r"(?:# @.*\n)?# ((?:[\w.-]+/)*[\w.-]+\.(?:py|yaml))\n", found[2])
        yield Block(heads[-1] if heads else "", found[1], found[2], named[1] if named else None)


def commands(text: str) -> list[list[str]]:
    """The commands of a shell block as words; variables set in the block are put in, comments left out."""
    values: dict[str, str] = {}
    found = []
    for line in text.replace("\\\n", " ").splitlines():
        for part in line.split(";") if re.match(r"[A-Z]=", line) else [line]:
            if assigned := re.match(r"\s*([A-Z])=(.*)$", part):
                values[assigned[1]] = shlex.split(assigned[2])[0]
                continue
            for name, value in values.items():
                part = part.replace(f"${name}", value)
            if words := shlex.split(part, comments=True):
                found.append(words)
    return found
