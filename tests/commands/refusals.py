"""What a refusal looks like, and arguments that are fast, for the tests of users' mistakes."""

from __future__ import annotations

from pathlib import Path

DRIVE = "town-3-00001"  # the second of two: nothing of the first may be written either
FAST = {
    "evaluate": ("rate_hz=10", "length_s=60", "outage.first_s=20", "outage.duration_s=20", "injected_bias=null"),
    "navigate": ("rate_hz=10",),
}


def is_refused(ended, *said: str, folder: Path) -> None:
    assert ended.code == 2, ended
    lines = ended.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("dlkf: error: "), ended.err
    assert len(lines[0]) < 500
    for text in said:
        assert text in lines[0], lines[0]
    left = [path.name for path in folder.iterdir() if path.name not in ("town", "mine", "logs")]
    assert left == [], f"left behind: {left}"


SCORED = ("model=mbkf15", "dataset=town", "out=made", *FAST["evaluate"])
SOLVED = ("model=mbkf15", "dataset=town", "out=made", *FAST["navigate"])
TRAINED = ("data=drives", "data.datasets=[town]")


def read_wrong(file: Path) -> list[str]:
    """The lines of a table of mistakes: what is wrong, an arrow, what the error line says."""
    return [line for line in file.read_text().splitlines() if line and not line.startswith("#")]
